"""The charts of the report. Each function draws one chart onto the given axes."""

from __future__ import annotations

from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.image import AxesImage
from matplotlib.ticker import EngFormatter, MaxNLocator
from numpy.typing import NDArray

from splatam_core.evaluation.report.theme import Theme
from splatam_core.evaluation.results import Evaluation, Sample, TrajectoryEvaluation
from splatam_core.evaluation.trajectory import TrajectoryError
from splatam_core.runs.frame_records import STAGES
from splatam_core.types import Status

ERROR_COLORS = LinearSegmentedColormap.from_list('error', ['#1769e0', '#7a5bd6', '#d6409f', '#e5484d'])
DEPTH_COLORS = matplotlib.colormaps['viridis'].with_extremes(bad='#d5d9de')
DIFFERENCE_COLORS = matplotlib.colormaps['magma'].with_extremes(bad='#d5d9de')
COLOR_DIFFERENCE_LIMIT = 0.25
"""Colour difference at the top of its colour scale; colours are in [0, 1]."""

FloatImage = NDArray[np.floating]


def seconds(evaluation: Evaluation, stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Convert stamps to seconds since the run's first frame."""
    run = evaluation.run
    first = min([*run.trajectory.stamps_ns[:1], *run.lost_ns[:1]], default=0)
    return (np.asarray(stamps_ns, dtype=np.int64) - first) * 1e-9


@dataclass(frozen=True, slots=True)
class Projection:
    """A direction to view a path from.

    Attributes:
        title: title of the chart.
        axes: the coordinates drawn to the right and upwards.
        labels: labels of the two axes.
        flip: True if the vertical axis grows downwards.
    """

    title: str
    axes: tuple[int, int]
    labels: tuple[str, str]
    flip: bool = False


ABOVE = Projection('Path from above', (0, 2), ('x, right (m)', 'z, forward (m)'))
SIDE = Projection('Path from the side', (2, 1), ('z, forward (m)', 'y, down (m)'), flip=True)


def path_view(ax: Axes, evaluation: Evaluation, theme: Theme, projection: Projection = ABOVE) -> LineCollection | None:
    """Draw the path from one side. Returns the line coloured by the error; None without ground truth."""
    shown = list(projection.axes)
    centres = evaluation.run.trajectory.T_world_cam[:, :3, 3]
    colored = None
    if evaluation.trajectory is not None:
        _, true_centres = _ground_truth_during_run(evaluation, evaluation.trajectory)
        _line(ax, true_centres[:, shown], theme.ground_truth, 1.6, 'ground truth')
        colored = _error_line(ax, evaluation, evaluation.trajectory.error, shown)
    else:
        _line(ax, centres[:, shown], theme.estimate, 1.8, 'estimate')
    if len(centres):
        ax.plot(*centres[0, shown], 'o', ms=7, mfc=theme.card, mec=theme.ink, mew=1.4, label='start', zorder=4)
        ax.plot(*centres[-1, shown], 's', ms=6, color=theme.ink, label='end', zorder=4)
        ax.legend(loc='best')
    ax.set(title=projection.title, xlabel=projection.labels[0], ylabel=projection.labels[1])
    ax.set_aspect('equal', adjustable='datalim')
    ax.margins(0.08)
    ax.xaxis.set_major_locator(MaxNLocator(5))
    if projection.flip:
        ax.invert_yaxis()
    return colored


def _error_line(ax: Axes, evaluation: Evaluation, error: TrajectoryError, shown: list[int]) -> LineCollection:
    points = error.estimate_m[:, shown]
    connected = _connected(evaluation, error.stamps_ns)
    pieces = np.stack([points[:-1], points[1:]], axis=1)[connected]  # [K, 2, 2]
    values_cm = (error.errors_m[:-1] + error.errors_m[1:])[connected] * 50
    norm = Normalize(0, max(1e-3, float(error.errors_m.max()) * 100))
    line = LineCollection(list(pieces), array=values_cm, cmap=ERROR_COLORS, norm=norm, linewidths=2.2, capstyle='round')
    ax.add_collection(line)
    return line


def coordinates_over_time(axes: NDArray[np.object_], evaluation: Evaluation, theme: Theme) -> None:
    """Draw x, y and z of the camera over time, one below the other."""
    run = evaluation.run
    stamps_s, centres = seconds(evaluation, run.trajectory.stamps_ns), run.trajectory.T_world_cam[:, :3, 3]
    for axis, (ax, name) in enumerate(zip(axes, ('x, right (m)', 'y, down (m)', 'z, forward (m)'))):
        if evaluation.trajectory is not None:
            true_s, true_m = _ground_truth_during_run(evaluation, evaluation.trajectory)
            ax.plot(true_s, true_m[:, axis], color=theme.ground_truth, lw=3, label='ground truth')
        curve = _with_gaps(evaluation, run.trajectory.stamps_ns, stamps_s, centres[:, axis])
        ax.plot(*curve, color=theme.estimate, lw=1.3, label='estimate', marker='.' if len(centres) == 1 else None)
        _mark_lost(ax, evaluation, theme)
        ax.set_ylabel(name)
        ax.yaxis.set_major_locator(MaxNLocator(4))
        ax.tick_params(labelbottom=axis == 2)
    axes[0].set_title('Path over time')
    axes[0].legend(loc='best', ncol=3)
    axes[-1].set_xlabel('time (s)')


def position_error(ax: Axes, evaluation: Evaluation, theme: Theme) -> None:
    """Draw the distance to the ground truth over time."""
    ax.set(title='Distance to the ground truth', xlabel='time (s)', ylabel='cm')
    if evaluation.trajectory is None:
        _note(ax, 'no ground truth to compare with', theme)
        return
    error = evaluation.trajectory.error
    stamps_s = seconds(evaluation, error.stamps_ns)
    stamps_s, errors_cm = _with_gaps(evaluation, error.stamps_ns, stamps_s, error.errors_m * 100)
    ax.fill_between(stamps_s, errors_cm, color=theme.estimate, alpha=0.15, lw=0)
    ax.plot(stamps_s, errors_cm, color=theme.estimate, lw=1.3)
    ax.axhline(error.rmse_m * 100, color=theme.ink, lw=1, ls=(0, (4, 3)), label=f'RMSE {error.rmse_m * 100:.2f} cm')
    _mark_lost(ax, evaluation, theme)
    ax.set_ylim(bottom=0)
    ax.legend(loc='best')


def image_scores(ax_psnr: Axes, ax_depth: Axes, evaluation: Evaluation, theme: Theme) -> None:
    """Draw PSNR and depth L1 of every scored frame."""
    ax_psnr.set(title='Final map against each frame', ylabel='PSNR (dB)')
    ax_depth.set(xlabel='time (s)', ylabel='depth L1 (cm)')
    if evaluation.images is None:
        _note(ax_psnr, 'no frames or no map to compare', theme)
        _note(ax_depth, '', theme)
        return
    scored = [(frame.stamp_ns, frame.scores.psnr_db, frame.scores.depth_l1_m) for frame in evaluation.images.frames]
    known = [(stamp, psnr, depth) for stamp, psnr, depth in scored if psnr is not None and depth is not None]
    stamps_s = seconds(evaluation, np.array([stamp for stamp, _, _ in known], dtype=np.int64))
    psnr_db, depth_cm = [psnr for _, psnr, _ in known], [depth * 100 for _, _, depth in known]
    _curve_with_mean(ax_psnr, stamps_s, psnr_db, (theme.estimate, theme.ink), '.1f')
    _curve_with_mean(ax_depth, stamps_s, depth_cm, (theme.pink, theme.ink), '.2f')
    ax_depth.set_ylim(bottom=0)
    ax_psnr.tick_params(labelbottom=False)


def stage_times(ax: Axes, evaluation: Evaluation, theme: Theme) -> None:
    """Draw the wall time of each frame, stacked by stage."""
    ax.set(title='Time per frame', xlabel='frame', ylabel='ms')
    records = evaluation.run.frames
    if not records:
        _note(ax, 'no times recorded', theme)
        return
    stage_colors = {'track': theme.estimate, 'densify': theme.green, 'keyframes': theme.orange, 'map': theme.violet}
    if any(record.timings.graph for record in records):
        stage_colors['graph'] = theme.pink
    stages = [stage for stage in STAGES if stage in stage_colors]
    times_ms = np.array([[getattr(record.timings, stage) for record in records] for stage in stages])
    medians = np.median(times_ms, axis=1)
    edges, until_last = np.arange(len(records) + 1) - 0.5, np.concatenate([times_ms, times_ms[:, -1:]], axis=1)
    ax.stackplot(
        edges, until_last, colors=[stage_colors[stage] for stage in stages], lw=0, alpha=0.85,
        labels=[f'{stage}  {median:.0f} ms' for stage, median in zip(stages, medians)], step='post',
    )  # fmt: skip
    ax.set_xlim(-0.5, len(records) - 0.5)
    total_ms = times_ms.sum(axis=0)
    top_ms = max(1e-3, min(1.35 * float(np.percentile(total_ms, 99)), 2.5 * float(np.percentile(total_ms, 95))))
    ax.set_ylim(0, top_ms)
    if total_ms.max() > top_ms:
        slowest = f'slowest {total_ms.max():.0f} ms'
        ax.text(1, 1.01, slowest, transform=ax.transAxes, ha='right', va='bottom', color=theme.muted)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    handles, labels = ax.get_legend_handles_labels()
    ax.legend(handles[::-1], labels[::-1], loc='upper left', ncol=2, title='median', title_fontsize=8)


def map_size(ax: Axes, evaluation: Evaluation, theme: Theme) -> None:
    """Draw the number of Gaussians after each frame, with keyframes, uncertain and lost frames marked."""
    ax.set(title='Gaussians', xlabel='frame')
    records = evaluation.run.frames
    if not records:
        _note(ax, 'not recorded', theme)
        return
    count = np.array([record.num_gaussians for record in records])
    ax.fill_between(np.arange(len(records)), count, color=theme.estimate, alpha=0.15, lw=0)
    ax.plot(count, color=theme.estimate, lw=1.3)
    keyframes = [index for index, record in enumerate(records) if record.is_keyframe]
    ax.plot(keyframes, count[keyframes], '.', ms=4, color=theme.ink, label=f'{len(keyframes)} keyframes')
    for status, color in ((Status.UNCERTAIN, theme.orange), (Status.LOST, theme.lost)):
        for index in (index for index, record in enumerate(records) if record.status is status):
            ax.axvline(index, color=color, lw=0.8, alpha=0.5)
    ax.set_ylim(bottom=0)
    ax.yaxis.set_major_formatter(EngFormatter(sep=''))
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.legend(loc='lower right')


@dataclass(frozen=True, slots=True, eq=False)
class Panels:
    """The images of one sample and their colour scales.

    Attributes:
        reading_m: [H, W] depth readings; NaN = none.
        rendered_m: [H, W] rendered depth; NaN = none.
        rgb_difference: [H, W] absolute colour difference, mean over the channels.
        depth_difference_cm: [H, W] absolute depth difference; NaN = no reading.
        depth_norm: colour scale of both depth images.
        depth_difference_norm: colour scale of the depth difference.
    """

    reading_m: FloatImage
    rendered_m: FloatImage
    rgb_difference: FloatImage
    depth_difference_cm: FloatImage
    depth_norm: Normalize
    depth_difference_norm: Normalize

    @classmethod
    def of(cls, sample: Sample) -> Panels:
        """Compute the images of a sample."""
        reading = np.where(sample.reading_m > 0, sample.reading_m, np.nan)
        rendered = np.where(sample.depth_m > 0, sample.depth_m, np.nan)
        difference_cm = np.abs(sample.depth_m - reading) * 100
        rgb_difference = np.abs(sample.rgb - sample.frame.rgb / 255).mean(axis=2)
        limits = _depth_norm(reading, rendered), Normalize(0, _difference_limit_cm(difference_cm))
        return cls(reading, rendered, rgb_difference, difference_cm, *limits)


def sample_images(axes: NDArray[np.object_], sample: Sample) -> tuple[AxesImage, AxesImage, AxesImage]:
    """Draw one frame onto six axes: colour, its render, their difference; depth, its render, their difference.

    Returns:
        The images that need a colour bar: colour difference, depth, depth difference.
    """
    panels = Panels.of(sample)
    axes[0].imshow(sample.frame.rgb)
    axes[1].imshow(sample.rgb)
    color = axes[2].imshow(panels.rgb_difference, cmap=DIFFERENCE_COLORS, norm=Normalize(0, COLOR_DIFFERENCE_LIMIT))
    axes[3].imshow(panels.reading_m, cmap=DEPTH_COLORS, norm=panels.depth_norm)
    depth = axes[4].imshow(panels.rendered_m, cmap=DEPTH_COLORS, norm=panels.depth_norm)
    difference = axes[5].imshow(panels.depth_difference_cm, cmap=DIFFERENCE_COLORS, norm=panels.depth_difference_norm)
    for ax in axes:
        ax.set(xticks=[], yticks=[])
        ax.spines[:].set_visible(False)
    return color, depth, difference


def _depth_norm(reading: FloatImage, rendered: FloatImage) -> Normalize:
    values = reading[np.isfinite(reading)] if np.isfinite(reading).any() else rendered[np.isfinite(rendered)]
    return Normalize(*np.percentile(values, [1, 99])) if values.size else Normalize(0, 1)


def _difference_limit_cm(difference_cm: FloatImage) -> float:
    """Return the top of the colour scale: a round number that covers 95 % of the pixels, at least 5 cm."""
    known = difference_cm[np.isfinite(difference_cm)]
    needed = float(np.percentile(known, 95)) if known.size else 0.0
    return next((limit for limit in (5.0, 10.0, 20.0, 50.0, 100.0) if needed <= limit), 200.0)


def _ground_truth_during_run(
    evaluation: Evaluation, trajectory: TrajectoryEvaluation
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return time in seconds [N] and camera centres [N, 3] of the ground truth between the run's first and last pose."""
    stamps_ns, run_ns = trajectory.ground_truth.stamps_ns, evaluation.run.trajectory.stamps_ns
    during = (stamps_ns >= run_ns[0]) & (stamps_ns <= run_ns[-1])
    return seconds(evaluation, stamps_ns[during]), trajectory.ground_truth.T_world_cam[during, :3, 3]


def _connected(evaluation: Evaluation, stamps_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return [N - 1] bool: True if no frame was lost between one stamp and the next."""
    before = np.searchsorted(np.array(evaluation.run.lost_ns, dtype=np.int64), stamps_ns)
    return before[1:] == before[:-1]


def _with_gaps(
    evaluation: Evaluation, stamps_ns: NDArray[np.int64], x: NDArray[np.float64], y: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Insert NaN into a curve wherever frames were lost, so that it is drawn with gaps."""
    gaps = np.flatnonzero(~_connected(evaluation, stamps_ns)) + 1
    return np.insert(x, gaps, np.nan), np.insert(y, gaps, np.nan)


def _mark_lost(ax: Axes, evaluation: Evaluation, theme: Theme) -> None:
    uncertain_ns = [frame.stamp_ns for frame in evaluation.run.frames if frame.status is Status.UNCERTAIN]
    for label, stamps_ns, color in (('uncertain', uncertain_ns, theme.orange), ('lost', evaluation.run.lost_ns, theme.lost)):
        for index, stamp_s in enumerate(seconds(evaluation, np.array(stamps_ns, dtype=np.int64))):
            ax.axvline(stamp_s, color=color, lw=0.8, alpha=0.5, label=label if index == 0 else None, zorder=0)


def _line(ax: Axes, points: NDArray[np.float64], color: str, width: float, label: str) -> None:
    ax.plot(points[:, 0], points[:, 1], color=color, lw=width, label=label, solid_capstyle='round')


def _curve_with_mean(ax: Axes, x: NDArray[np.float64], y: list[float], colors: tuple[str, str], digits: str) -> None:
    """Draw a curve and its mean, in the two colours."""
    mean = float(np.mean(y)) if y else float('nan')
    ax.plot(x, y, color=colors[0], lw=1.2, marker='.' if len(y) < 40 else None, ms=4)
    ax.axhline(mean, color=colors[1], lw=1, ls=(0, (4, 3)), label=f'mean {mean:{digits}}')
    ax.legend(loc='best')


def _note(ax: Axes, text: str, theme: Theme) -> None:
    ax.text(0.5, 0.5, text, transform=ax.transAxes, ha='center', va='center', color=theme.muted)
    ax.set(xticks=[], yticks=[])
    ax.grid(False)
