"""The result of an evaluation: scores of the trajectory, the images and the novel views, and the metrics they fill."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splatam_core.evaluation.images import FrameScores, mean_original_scores, mean_scores
from splatam_core.evaluation.trajectory import RelativePoseError, TrajectoryError, falsely_tracked
from splatam_core.geometry.trajectory import Trajectory
from splatam_core.runs.metrics import Metrics
from splatam_core.runs.record import RunRecord
from splatam_core.types import RgbdFrame


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryEvaluation:
    """The trajectory against the ground truth.

    Attributes:
        error: the absolute trajectory error of the frames with a pose.
        tracked: that of the tracked frames alone; None where there are too few.
        per_frame: the relative pose error from frame to frame.
        per_second: the relative pose error over one second.
        splatam_ate_mean_m: the number that the original prints as "ATE RMSE".
        final: the absolute trajectory error after all corrections of the keyframe graph; None where it was not saved.
        ground_truth: the whole ground truth, aligned to the run's world.
    """

    error: TrajectoryError
    tracked: TrajectoryError | None
    per_frame: RelativePoseError
    per_second: RelativePoseError
    splatam_ate_mean_m: float
    final: TrajectoryError | None
    ground_truth: Trajectory


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """One frame and its render, for display.

    Attributes:
        title: which frame it is, for example ``worst``.
        frame: the frame.
        reading_m: [H, W] float32, the frame's valid depth readings; 0 = none.
        rgb: [H, W, 3] float32 in [0, 1], rendered colour.
        depth_m: [H, W] float32, rendered depth; 0 = none.
        silhouette: [H, W] float32 in [0, 1], rendered silhouette.
        scores: how well the render matches the frame.
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
    """Renders of the map against the frames.

    Attributes:
        every: every n-th frame was scored.
        frames: their scores, in order of time.
        held_out: the scores of all frames that were kept out of the map.
        samples: the worst, the median and the best of the frames, and the median held-out frame.
        notes: why a score is missing, by its name.
    """

    every: int
    frames: tuple[FrameScores, ...]
    held_out: tuple[FrameScores, ...]
    samples: tuple[Sample, ...]
    notes: Mapping[str, str]


@dataclass(frozen=True, slots=True, eq=False)
class NovelViews:
    """Renders of the map at the true poses of a test split.

    Attributes:
        alignment: what aligned the ground truth to the map's world: ``trajectory``, all poses of the run; or ``first``,
            its first pose, as in the original.
        frames: the scores of the views without holes.
        with_holes: the scores of the views with more holes than the protocol allows.
        samples: the worst, the median and the best of all views.
    """

    alignment: str
    frames: tuple[FrameScores, ...]
    with_holes: tuple[FrameScores, ...]
    samples: tuple[Sample, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """Everything that the report shows.

    Attributes:
        run: the run that was scored.
        metrics: all its numbers.
        trajectory: None without ground truth.
        images: None without frames or without a map.
        novel: None if no test split was scored.
    """

    run: RunRecord
    metrics: Metrics
    trajectory: TrajectoryEvaluation | None
    images: ImageEvaluation | None
    novel: NovelViews | None = None


def combine(
    run: RunRecord,
    trajectory: TrajectoryEvaluation | None,
    images: ImageEvaluation | None,
    novel: NovelViews | None = None,
) -> Evaluation:
    """Fill the run's metrics with the given scores. Numbers of a part that is None keep their values."""
    metrics = run.metrics()
    if trajectory is not None:
        metrics = _with_trajectory(metrics, trajectory, run)
    if images is not None:
        metrics = _with_images(metrics, images)
    if novel is not None:
        metrics = _with_novel_views(metrics, novel)
    return Evaluation(run, metrics, trajectory, images, novel)


def _with_trajectory(metrics: Metrics, trajectory: TrajectoryEvaluation, run: RunRecord) -> Metrics:
    tracked = trajectory.tracked
    return replace(
        metrics,
        ate_rmse_m=trajectory.error.rmse_m,
        ate_final_rmse_m=None if trajectory.final is None else trajectory.final.rmse_m,
        ate_frames=len(trajectory.error.stamps_ns),
        ate_tracked_rmse_m=None if tracked is None else tracked.rmse_m,
        worst_error_m=None if tracked is None else float(tracked.errors_m.max()),
        false_tracked=None if tracked is None else int(falsely_tracked(tracked, run.covariances()).sum()),
        splatam_ate_mean_m=trajectory.splatam_ate_mean_m,
        rpe_trans_frame_m=trajectory.per_frame.translation_rmse_m,
        rpe_rot_frame_deg=trajectory.per_frame.rotation_rmse_deg,
        rpe_frame_pairs=trajectory.per_frame.pairs,
        rpe_trans_1s_m=trajectory.per_second.translation_rmse_m,
        rpe_rot_1s_deg=trajectory.per_second.rotation_rmse_deg,
        rpe_1s_pairs=trajectory.per_second.pairs,
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
