"""Scores a finished run: its trajectory against the ground truth, its map against the frames and against a test split."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from splatam_core.datasets.base import Sequence, frame_or_none
from splatam_core.errors import RunFolderError
from splatam_core.evaluation.images import FrameScores, ViewScorer
from splatam_core.evaluation.lpips import MIN_SIDE as LPIPS_MIN_SIDE
from splatam_core.evaluation.lpips import Lpips, load_lpips
from splatam_core.evaluation.results import ImageEvaluation, NovelViews, Sample, TrajectoryEvaluation
from splatam_core.evaluation.similarity import MIN_SIDE
from splatam_core.evaluation.trajectory import (
    TrajectoryError,
    align_poses,
    has_enough_poses,
    relative_pose_errors,
    splatam_ate_mean_m,
    trajectory_error,
    transformed,
)
from splatam_core.geometry.trajectory import Trajectory, interpolate_poses, stamp_text
from splatam_core.rasterizer import rasterizer_for
from splatam_core.runs.record import RunRecord
from splatam_core.types import RgbdFrame

Progress = Callable[[range], Iterable[int]]
Pose = NDArray[np.float64]


def score_trajectory(run: RunRecord, ground_truth: Trajectory) -> TrajectoryEvaluation:
    """Score a run's trajectory.

    Args:
        run: the run.
        ground_truth: true poses in any world frame, at any stamps of the same clock.

    Raises:
        RunFolderError: too few frames with a pose have ground truth at their stamp.
    """
    error = trajectory_error(run.trajectory, ground_truth)
    per_frame, per_second = relative_pose_errors(run.trajectory, ground_truth, run.lost_ns)
    return TrajectoryEvaluation(
        error=error,
        tracked=_tracked_error(run, ground_truth),
        per_frame=per_frame,
        per_second=per_second,
        splatam_ate_mean_m=splatam_ate_mean_m(run.trajectory, ground_truth),
        final=None if run.final is None else trajectory_error(run.final, ground_truth),
        ground_truth=transformed(ground_truth, error.T_estimate_ground_truth),
    )


def _tracked_error(run: RunRecord, ground_truth: Trajectory) -> TrajectoryError | None:
    """Returns the error of the tracked frames alone; None where there are too few for one."""
    tracked = run.tracked_trajectory()
    return trajectory_error(tracked, ground_truth) if has_enough_poses(tracked, ground_truth) else None


def score_images(run: RunRecord, sequence: Sequence, every: int, progress: Progress) -> ImageEvaluation:
    """Render a run's map at the run's poses and compare the renders with the frames of the same stamps.

    Args:
        run: the run.
        sequence: a recording that contains the run's frames, and possibly others between them.
        every: score every n-th frame of the run. All frames held out of the map are scored in any case.
        progress: wraps the loop over the sequence, to display progress.

    Raises:
        RunFolderError: the run has no map, or none of its frames is in the sequence.
        MapFileError: the map cannot be read.
        DatasetError: a frame cannot be read.
    """
    lpips = load_lpips()
    scorer = make_scorer(run, lpips)
    chosen, held_out = _stamps_to_score(run, every)
    poses = {stamp_ns: pose for stamp_ns, pose in run.poses().items() if stamp_ns in chosen | held_out}
    scored = _score_at_stamps(scorer, sequence, poses, progress)
    if poses and not scored:
        raise RunFolderError(_no_common_frame(run, sequence))

    def sample(title: str, index: int) -> Sample:
        frame = sequence[index]
        return _sample(title, scorer, frame, poses[frame.stamp_ns], scored[index])

    of_all = {index: frame for index, frame in scored.items() if frame.stamp_ns in chosen}
    of_held_out = {index: frame for index, frame in scored.items() if frame.stamp_ns in held_out}
    samples = [sample(title, index) for title, index in _worst_median_best(of_all)]
    samples += [sample(f'{title} held out', index) for title, index in _worst_median_best(of_held_out) if title == 'median']
    return ImageEvaluation(
        every=every,
        frames=tuple(of_all.values()),
        held_out=tuple(of_held_out.values()),
        samples=tuple(samples),
        notes=_notes(sequence, lpips) if scored else {},
    )


def _score_at_stamps(
    scorer: ViewScorer, sequence: Sequence, poses: Mapping[int, Pose], progress: Progress
) -> dict[int, FrameScores]:
    """Score the frames whose stamps have a pose. Returns the scores by the frame's index in the sequence."""
    scored: dict[int, FrameScores] = {}
    for index in progress(range(len(sequence))):
        if len(scored) == len(poses):
            break
        frame = frame_or_none(sequence, index)
        if frame is not None and frame.stamp_ns in poses:
            scored[index] = scorer.score(frame, poses[frame.stamp_ns])
    return scored


def score_novel_views(run: RunRecord, ground_truth: Trajectory, test: Sequence, alignment: str, progress: Progress) -> NovelViews:
    """Render a run's map at the true poses of a test split and compare the renders with the frames taken there.

    Args:
        run: the run, made from the train split.
        ground_truth: the true poses of the train split.
        test: the test split; its true poses are in the same world.
        alignment: what aligns the ground truth to the map's world: ``trajectory``, all poses that have ground
            truth (their mean rotation, then their mean translation); or ``first``, only the first of them, as in the
            original.
        progress: wraps the loop over the test split, to display progress.

    Raises:
        RunFolderError: the run has no map, too few of its frames have ground truth, or the test split has none.
        MapFileError: the map cannot be read.
        DatasetError: a frame cannot be read.
    """
    T_map_ground_truth = _T_map_ground_truth(run, ground_truth, alignment)
    true_poses = test.ground_truth()
    if true_poses is None:
        raise RunFolderError(f'{test.name} has no ground truth: novel views are rendered at true poses')
    scorer = make_scorer(run, load_lpips())
    scored: dict[int, FrameScores] = {}  # by index in the test split
    poses: dict[int, Pose] = {}
    for index in progress(range(len(test))):
        frame = frame_or_none(test, index)
        if frame is None:
            continue
        (pose,), (known,) = interpolate_poses(true_poses, np.array([frame.stamp_ns]))
        if known:
            poses[index] = T_map_ground_truth @ pose
            scored[index] = scorer.score(frame, poses[index])
    if not scored:
        raise RunFolderError(f'{test.name}: none of its {len(test)} frames has ground truth at its stamp')
    samples = [_sample(title, scorer, test[index], poses[index], scored[index]) for title, index in _worst_median_best(scored)]
    return NovelViews(
        alignment=alignment,
        frames=tuple(frame for frame in scored.values() if not frame.has_holes),
        with_holes=tuple(frame for frame in scored.values() if frame.has_holes),
        samples=tuple(samples),
    )


def _T_map_ground_truth(run: RunRecord, ground_truth: Trajectory, alignment: str) -> Pose:
    trajectory = run.in_final_map()
    poses, known = interpolate_poses(ground_truth, trajectory.stamps_ns)
    if not known.any():
        raise RunFolderError(f'none of the {len(trajectory)} frames with a pose has ground truth at its stamp')
    count = None if alignment == 'trajectory' else 1
    return align_poses(poses[known][:count], trajectory.T_world_cam[known][:count])


def make_scorer(run: RunRecord, lpips: Lpips | str) -> ViewScorer:
    """Load a run's map into a scorer.

    Args:
        run: the run.
        lpips: what ``load_lpips`` returned; with a message, LPIPS is skipped.

    Raises:
        RunFolderError: the run has no map.
        MapFileError: the map cannot be read.
    """
    rasterizer, device = rasterizer_for(run.config)
    gaussians = run.read_map().to(device)
    return ViewScorer(gaussians, rasterizer, run.config.depth, lpips.to(device) if isinstance(lpips, Lpips) else None)


def _stamps_to_score(run: RunRecord, every: int) -> tuple[set[int], set[int]]:
    """Return the stamps of every n-th frame, and of all frames held out of the map. Both include lost frames."""
    stamps_ns = run.stamps_ns()
    is_held_out = run.config.mapping.is_held_out
    return set(stamps_ns[::every]), {stamp_ns for index, stamp_ns in enumerate(stamps_ns) if is_held_out(index)}


def _notes(sequence: Sequence, lpips: Lpips | str) -> dict[str, str]:
    """Return why a score is missing for every frame, by the score's name."""
    camera = sequence.camera
    size = f'these are {camera.width}x{camera.height}'
    notes: dict[str, str] = {}
    if min(camera.width, camera.height) < MIN_SIDE:
        notes['ms_ssim'] = f'needs images of at least {MIN_SIDE} pixels on the short side; {size}'
    if isinstance(lpips, str):
        notes['lpips'] = lpips
    elif min(camera.width, camera.height) < LPIPS_MIN_SIDE:
        notes['lpips'] = f'needs images of at least {LPIPS_MIN_SIDE} pixels on the short side; {size}'
    return notes


def _worst_median_best(scored: Mapping[int, FrameScores]) -> list[tuple[str, int]]:
    """Return title and index of the views with the worst, the median and the best PSNR; fewer if there are fewer views."""
    psnr_db = {index: frame.scores.psnr_db for index, frame in scored.items() if frame.scores.psnr_db is not None}
    ranked = sorted(psnr_db, key=lambda index: psnr_db[index])
    places = {0: 'worst', len(ranked) // 2: 'median', len(ranked) - 1: 'best'}
    return [(places[place], ranked[place]) for place in sorted(places) if 0 <= place < len(ranked)]


def _sample(title: str, scorer: ViewScorer, frame: RgbdFrame, T_world_cam: Pose, scores: FrameScores) -> Sample:
    render = scorer.render(frame, T_world_cam)
    return Sample(
        title=title,
        frame=frame,
        reading_m=scorer.view(frame).depth.numpy(force=True),
        rgb=render.rgb.clamp(0, 1).permute(1, 2, 0).numpy(force=True),
        depth_m=render.depth().numpy(force=True),
        silhouette=render.silhouette.numpy(force=True),
        scores=scores,
    )


def _no_common_frame(run: RunRecord, sequence: Sequence) -> str:
    return (
        f'none of the {len(run.trajectory)} frames with a pose is in {sequence.name}: the run starts at '
        f'{stamp_text(int(run.trajectory.stamps_ns[0]))} s, the recording at {stamp_text(sequence[0].stamp_ns)} s; '
        'is it the recording that the run was made from?'
    )
