"""Scoring a finished run: its trajectory against the truth, its map against the images and against a test split."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splatam_core.datasets.base import Sequence, frame_or_none
from splatam_core.errors import RunFolderError
from splatam_core.evaluation.images import FrameScores, ViewScorer, mean_original_scores, mean_scores
from splatam_core.evaluation.similarity import LPIPS_MIN_SIDE, MIN_SIDE, Lpips, load_lpips
from splatam_core.evaluation.trajectory import (
    RelativePoseError,
    TrajectoryError,
    align_poses,
    relative_pose_errors,
    splatam_ate_mean_m,
    trajectory_error,
    transformed,
)
from splatam_core.geometry.trajectory import Trajectory, interpolate_poses, stamp_text
from splatam_core.rasterizer import rasterizer_for
from splatam_core.runs.metrics import Metrics
from splatam_core.runs.record import RunRecord
from splatam_core.types import RgbdFrame

Progress = Callable[[range], Iterable[int]]
Pose = NDArray[np.float64]
ALIGNMENTS = ('trajectory', 'first')


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """One frame beside its render, to look at.

    Attributes:
        title: which one it is.
        frame: what the camera saw.
        reading_m: [H, W] float32, its depth where that counts; 0 elsewhere.
        rgb: [H, W, 3] float32 in [0, 1], rendered.
        depth_m: [H, W] float32, rendered; 0 = none.
        silhouette: [H, W] float32 in [0, 1], rendered.
        scores: how well the two match.
    """

    title: str
    frame: RgbdFrame
    reading_m: NDArray[np.float32]
    rgb: NDArray[np.float32]
    depth_m: NDArray[np.float32]
    silhouette: NDArray[np.float32]
    scores: FrameScores


@dataclass(frozen=True, slots=True, eq=False)
class ImageEvaluation:
    """The map's renders against the frames.

    Attributes:
        every: every n-th frame was scored.
        frames: their scores, in order of time.
        held_out: the scores of all frames that the map was not made of.
        samples: some of the frames, from the worst match to the best, and the median held-out one.
        notes: why a score is missing, by its name.
    """

    every: int
    frames: tuple[FrameScores, ...]
    held_out: tuple[FrameScores, ...]
    samples: tuple[Sample, ...]
    notes: Mapping[str, str]


@dataclass(frozen=True, slots=True, eq=False)
class NovelViews:
    """The map's renders at the true poses of a test split.

    Attributes:
        alignment: how the truth was brought into the map's world: by the run's whole ``trajectory``, or by its
            ``first`` pose, as the original does.
        frames: the scores of the views without holes.
        with_holes: of those that see more unmapped surface than the protocol lets pass.
        samples: some of the views, from the worst match to the best.
    """

    alignment: str
    frames: tuple[FrameScores, ...]
    with_holes: tuple[FrameScores, ...]
    samples: tuple[Sample, ...]


@dataclass(frozen=True, slots=True, eq=False)
class TruthEvaluation:
    """The trajectory against the truth.

    Attributes:
        error: of the tracked frames.
        per_frame: relative pose error from frame to frame.
        per_second: the same over one second.
        splatam_ate_mean_m: what the original prints as "ATE RMSE".
        truth: all of it, brought into the run's world.
    """

    error: TrajectoryError
    per_frame: RelativePoseError
    per_second: RelativePoseError
    splatam_ate_mean_m: float
    truth: Trajectory


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """Everything the report shows.

    Attributes:
        run: the run that was scored.
        metrics: all its numbers.
        truth: None where there is no truth.
        images: None where there are no frames or no map.
        novel: None where no test split was rendered.
    """

    run: RunRecord
    metrics: Metrics
    truth: TruthEvaluation | None
    images: ImageEvaluation | None
    novel: NovelViews | None = None


def combine(
    run: RunRecord, truth: TruthEvaluation | None, images: ImageEvaluation | None, novel: NovelViews | None = None
) -> Evaluation:
    """The run's numbers with those of truth, images and novel views filled in; without one, its numbers stay."""
    metrics = run.metrics()
    if truth is not None:
        metrics = _with_truth(metrics, truth)
    if images is not None:
        metrics = _with_images(metrics, images)
    if novel is not None:
        metrics = _with_novel_views(metrics, novel)
    return Evaluation(run, metrics, truth, images, novel)


def _with_truth(metrics: Metrics, truth: TruthEvaluation) -> Metrics:
    return replace(
        metrics,
        ate_rmse_m=truth.error.rmse_m,
        ate_frames=len(truth.error.stamps_ns),
        splatam_ate_mean_m=truth.splatam_ate_mean_m,
        rpe_trans_frame_m=truth.per_frame.translation_rmse_m,
        rpe_rot_frame_deg=truth.per_frame.rotation_rmse_deg,
        rpe_frame_pairs=truth.per_frame.pairs,
        rpe_trans_1s_m=truth.per_second.translation_rmse_m,
        rpe_rot_1s_deg=truth.per_second.rotation_rmse_deg,
        rpe_1s_pairs=truth.per_second.pairs,
    )


def _with_images(metrics: Metrics, images: ImageEvaluation) -> Metrics:
    return replace(
        metrics,
        **asdict(mean_scores(images.frames)),
        evaluated_every=images.every,
        evaluated_frames=len(images.frames),
        splatam=mean_original_scores(images.frames),
        heldout_frames=len(images.held_out) or None,
        heldout=mean_scores(images.held_out),
        notes=dict(images.notes),
    )


def _with_novel_views(metrics: Metrics, novel: NovelViews) -> Metrics:
    return replace(
        metrics,
        novel_alignment=novel.alignment,
        novel_frames=len(novel.frames),
        novel=mean_scores(novel.frames),
        novel_holes_frames=len(novel.with_holes),
        novel_holes=mean_scores(novel.with_holes),
        splatam_novel=mean_original_scores(novel.frames),
    )


def score_trajectory(run: RunRecord, truth: Trajectory) -> TruthEvaluation:
    """Score a run's trajectory.

    Raises:
        RunFolderError: too few tracked frames have a truth at their stamp.
    """
    error = trajectory_error(run.trajectory, truth)
    per_frame, per_second = relative_pose_errors(run.trajectory, truth, run.lost_ns)
    original_m = splatam_ate_mean_m(run.trajectory, truth)
    return TruthEvaluation(error, per_frame, per_second, original_m, transformed(truth, error.T_estimate_truth))


def score_images(run: RunRecord, sequence: Sequence, every: int, progress: Progress) -> ImageEvaluation:
    """Render a run's map at its poses and compare with the frames that have the same stamps.

    Args:
        run: the run.
        sequence: where its frames are; others may lie between them.
        every: score every n-th frame of the run only, and those held out of the map.
        progress: wraps the loop over the sequence, to show how far it is.

    Raises:
        RunFolderError: the run has no map, or none of its frames is in the sequence.
        MapFileError: the map cannot be read.
        DatasetError: a frame cannot be read.
    """
    lpips = load_lpips()
    scorer = make_scorer(run, lpips)
    chosen, held_out = _stamps_to_score(run, every)
    poses = {stamp_ns: pose for stamp_ns, pose in run.poses().items() if stamp_ns in chosen | held_out}
    scored: dict[int, FrameScores] = {}  # by index in the sequence
    for index in progress(range(len(sequence))):
        if len(scored) == len(poses):
            break
        frame = frame_or_none(sequence, index)
        if frame is not None and frame.stamp_ns in poses:
            scored[index] = scorer.score(frame, poses[frame.stamp_ns])
    if poses and not scored:
        raise RunFolderError(_none_found(run, sequence))

    def sample(title: str, index: int) -> Sample:
        frame = sequence[index]
        return _sample(title, scorer, frame, poses[frame.stamp_ns], scored[index])

    of_all = {index: frame for index, frame in scored.items() if frame.stamp_ns in chosen}
    of_held_out = {index: frame for index, frame in scored.items() if frame.stamp_ns in held_out}
    samples = [sample(title, index) for title, index in _worst_to_best(of_all)]
    samples += [sample(f'{title} held out', i) for title, i in _worst_to_best(of_held_out) if title == 'median']
    notes = _notes(sequence, lpips) if scored else {}
    return ImageEvaluation(every, tuple(of_all.values()), tuple(of_held_out.values()), tuple(samples), notes)


def score_novel_views(run: RunRecord, truth: Trajectory, test: Sequence, alignment: str, progress: Progress) -> NovelViews:
    """Render a run's map at the true poses of a test split and compare with what was seen there.

    Args:
        run: the run, made from the train split.
        truth: the train split's true poses.
        test: the test split; its true poses are in the same world.
        alignment: ``trajectory`` brings the truth into the map by all tracked poses that have a truth (their mean
            rotation, then their mean centre); ``first`` by the first of them alone, as the original does.
        progress: wraps the loop over the test split.

    Raises:
        RunFolderError: the run has no map, too few of its frames have a truth, or the test split has none.
    """
    T_map_truth = _T_map_truth(run, truth, alignment)
    test_truth = test.ground_truth()
    if test_truth is None:
        raise RunFolderError(f'{test.name} has no true poses: novel views are rendered at those')
    scorer, scored, poses = make_scorer(run, load_lpips()), {}, {}
    for index in progress(range(len(test))):
        frame = frame_or_none(test, index)
        if frame is None:
            continue
        (pose,), (known,) = interpolate_poses(test_truth, np.array([frame.stamp_ns]))
        if known:
            poses[index] = T_map_truth @ pose
            scored[index] = scorer.score(frame, poses[index])
    if not scored:
        raise RunFolderError(f'{test.name}: not one of its {len(test)} frames has a true pose at its stamp')
    samples = [_sample(title, scorer, test[i], poses[i], scored[i]) for title, i in _worst_to_best(scored)]
    frames, with_holes = (tuple(f for f in scored.values() if f.has_holes is is_so) for is_so in (False, True))
    return NovelViews(alignment, frames, with_holes, tuple(samples))


def _T_map_truth(run: RunRecord, truth: Trajectory, alignment: str) -> Pose:
    poses, known = interpolate_poses(truth, run.trajectory.stamps_ns)
    if not known.any():
        raise RunFolderError(f'none of the {len(run.trajectory)} tracked frames has a true pose at its stamp')
    last = None if alignment == 'trajectory' else 1
    return align_poses(poses[known][:last], run.trajectory.T_world_cam[known][:last])


def make_scorer(run: RunRecord, lpips: Lpips | str) -> ViewScorer:
    """What renders a run's map and compares.

    Raises:
        RunFolderError: the run has no map.
        MapFileError: the map cannot be read.
    """
    rasterizer, device = rasterizer_for(run.config)
    gaussians = run.read_map().to(device)
    return ViewScorer(gaussians, rasterizer, run.config.depth, lpips if isinstance(lpips, Lpips) else None)


def _stamps_to_score(run: RunRecord, every: int) -> tuple[set[int], set[int]]:
    """Stamps of every n-th frame, and of all that were held out of the map; lost ones are among them."""
    stamps_ns = run.stamps_ns()
    is_held_out = run.config.mapping.is_held_out
    return set(stamps_ns[::every]), {stamp_ns for index, stamp_ns in enumerate(stamps_ns) if is_held_out(index)}


def _notes(sequence: Sequence, lpips: Lpips | str) -> dict[str, str]:
    """Why a score is null in every frame."""
    camera, notes = sequence.camera, {}
    size = f'these are {camera.width}x{camera.height}'
    if min(camera.width, camera.height) < MIN_SIDE:
        notes['ms_ssim'] = f'needs images of at least {MIN_SIDE} pixels on the short side; {size}'
    if isinstance(lpips, str):
        notes['lpips'] = lpips
    elif min(camera.width, camera.height) < LPIPS_MIN_SIDE:
        notes['lpips'] = f'needs images of at least {LPIPS_MIN_SIDE} pixels on the short side; {size}'
    return notes


def _worst_to_best(scored: Mapping[int, FrameScores]) -> list[tuple[str, int]]:
    """Title and index of some views, by their PSNR."""
    ranked = sorted(
        (index for index, frame in scored.items() if frame.scores.psnr_db is not None),
        key=lambda index: scored[index].scores.psnr_db,
    )
    places = {0: 'worst', len(ranked) // 2: 'median', len(ranked) - 1: 'best'}
    return [(places[place], ranked[place]) for place in sorted(places) if 0 <= place < len(ranked)]


def _sample(title: str, scorer: ViewScorer, frame: RgbdFrame, T_world_cam: Pose, scores: FrameScores) -> Sample:
    render = scorer.render(frame, T_world_cam)
    rgb, reading_m = render.rgb.clamp(0, 1).permute(1, 2, 0), scorer.view(frame).depth
    images = (image.numpy(force=True) for image in (reading_m, rgb, render.depth(), render.silhouette))
    return Sample(title, frame, *images, scores)


def _none_found(run: RunRecord, sequence: Sequence) -> str:
    return (
        f'none of the {len(run.trajectory)} tracked frames is in {sequence.name}: the run starts at '
        f'{stamp_text(int(run.trajectory.stamps_ns[0]))} s, the recording at {stamp_text(sequence[0].stamp_ns)} s; '
        'is it the recording the run was made from?'
    )
