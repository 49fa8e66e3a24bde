"""Scoring a finished run: its trajectory against the truth, its map against the images."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splatam_core.datasets.base import Sequence
from splatam_core.errors import FrameError, RunFolderError
from splatam_core.evaluation.images import FrameScores, ViewScorer, mean_scores
from splatam_core.evaluation.metrics import Metrics
from splatam_core.evaluation.trajectory import TrajectoryError, trajectory_error, transformed
from splatam_core.ply import read_ply
from splatam_core.rasterizer import make_rasterizer
from splatam_core.run_folder import MAP, RunRecord
from splatam_core.trajectory import stamp_text
from splatam_core.types import RgbdFrame, Trajectory

Progress = Callable[[range], Iterable[int]]


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """One frame beside its render, to look at.

    Attributes:
        title: which one it is.
        frame: what the camera saw.
        reading_m: [H, W] float32, its depth where that counts; 0 elsewhere.
        rgb: [H, W, 3] float32 in [0, 1], rendered.
        depth_m: [H, W] float32, rendered; 0 = none.
        scores: how well the two match.
    """

    title: str
    frame: RgbdFrame
    reading_m: NDArray[np.float32]
    rgb: NDArray[np.float32]
    depth_m: NDArray[np.float32]
    scores: FrameScores


@dataclass(frozen=True, slots=True, eq=False)
class ImageEvaluation:
    """The map's renders against the frames.

    Attributes:
        every: every n-th frame was scored.
        frames: the scores, in order of time.
        samples: some of the frames, from the worst match to the best.
    """

    every: int
    frames: tuple[FrameScores, ...]
    samples: tuple[Sample, ...]


@dataclass(frozen=True, slots=True, eq=False)
class TruthEvaluation:
    """The trajectory against the truth.

    Attributes:
        error: of the tracked frames.
        truth: all of it, brought into the run's world.
    """

    error: TrajectoryError
    truth: Trajectory


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """Everything the report shows.

    Attributes:
        run: the run that was scored.
        metrics: all its numbers.
        truth: None where there is no truth.
        images: None where there are no frames or no map.
    """

    run: RunRecord
    metrics: Metrics
    truth: TruthEvaluation | None
    images: ImageEvaluation | None


def combine(run: RunRecord, truth: TruthEvaluation | None, images: ImageEvaluation | None) -> Evaluation:
    """The run's numbers with those of the truth and of the images filled in; without one, its numbers stay."""
    metrics = run.metrics()
    if truth is not None:
        metrics = replace(metrics, ate_rmse_m=truth.error.rmse_m, ate_frames=len(truth.error.stamps_ns))
    if images is not None:
        scores = asdict(mean_scores(images.frames))
        metrics = replace(metrics, **scores, evaluated_every=images.every, evaluated_frames=len(images.frames))
    return Evaluation(run, metrics, truth, images)


def score_trajectory(run: RunRecord, truth: Trajectory) -> TruthEvaluation:
    """Score a run's trajectory.

    Raises:
        RunFolderError: too few tracked frames have a truth at their stamp.
    """
    error = trajectory_error(run.trajectory, truth)
    return TruthEvaluation(error, transformed(truth, error.T_estimate_truth))


def score_images(run: RunRecord, sequence: Sequence, every: int, progress: Progress) -> ImageEvaluation:
    """Render a run's map at its poses and compare with the frames that have the same stamps.

    Args:
        run: the run.
        sequence: where its frames are; others may lie between them.
        every: score every n-th frame of the run only.
        progress: wraps the loop over the sequence, to show how far it is.

    Raises:
        RunFolderError: the run has no map, or none of its frames is in the sequence.
        MapFileError: the map cannot be read.
        DatasetError: a frame cannot be read.
    """
    if not (run.path / MAP).is_file():
        raise RunFolderError(f'{run.path} has no {MAP}: the run ended before it could be saved')
    rasterizer = make_rasterizer(run.config.rasterizer, run.config.threads)
    scorer = ViewScorer(read_ply(run.path / MAP), rasterizer, run.config.depth)
    poses = _poses_to_score(run, every)
    scored: dict[int, FrameScores] = {}  # by index in the sequence
    for index in progress(range(len(sequence))):
        if len(scored) == len(poses):
            break
        frame = _frame(sequence, index)
        if frame is not None and frame.stamp_ns in poses:
            scored[index] = scorer.score(frame, poses[frame.stamp_ns])
    if poses and not scored:
        raise RunFolderError(_none_found(run, sequence))
    samples = [
        _sample(title, scorer, sequence[index], poses[scores.stamp_ns], scores)
        for title, index, scores in _worst_to_best(scored)
    ]
    return ImageEvaluation(every, tuple(scored.values()), tuple(samples))


def _poses_to_score(run: RunRecord, every: int) -> dict[int, NDArray[np.float64]]:
    """T_world_cam by stamp, of every n-th frame that is tracked."""
    stamps_ns = sorted([*map(int, run.trajectory.stamps_ns), *run.lost_ns])
    chosen = set(stamps_ns[::every])
    poses = zip(map(int, run.trajectory.stamps_ns), run.trajectory.T_world_cam)
    return {stamp_ns: pose for stamp_ns, pose in poses if stamp_ns in chosen}


def _frame(sequence: Sequence, index: int) -> RgbdFrame | None:
    """A frame, or None where its images do not fit the camera: SLAM did not take it either."""
    try:
        return sequence[index]
    except FrameError:
        return None


def _worst_to_best(scored: dict[int, FrameScores]) -> list[tuple[str, int, FrameScores]]:
    ranked = sorted(
        ((index, frame) for index, frame in scored.items() if frame.scores.psnr_db is not None),
        key=lambda item: item[1].scores.psnr_db,
    )
    places = {0: 'worst', len(ranked) // 2: 'median', len(ranked) - 1: 'best'}
    return [(places[place], *ranked[place]) for place in sorted(places) if 0 <= place < len(ranked)]


def _sample(
    title: str, scorer: ViewScorer, frame: RgbdFrame, T_world_cam: NDArray[np.float64], scores: FrameScores
) -> Sample:
    render = scorer.render(frame, T_world_cam)
    rgb = render.rgb.clamp(0, 1).permute(1, 2, 0).numpy()
    return Sample(title, frame, scorer.view(frame).depth.numpy(), rgb, render.depth().numpy(), scores)


def _none_found(run: RunRecord, sequence: Sequence) -> str:
    return (
        f'none of the {len(run.trajectory)} tracked frames is in {sequence.name}: the run starts at '
        f'{stamp_text(int(run.trajectory.stamps_ns[0]))} s, the recording at {stamp_text(sequence[0].stamp_ns)} s; '
        'is it the recording the run was made from?'
    )
