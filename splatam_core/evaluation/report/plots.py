"""The panels of the report: each draws one thing onto axes it is given."""

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

from splatam_core.evaluation.score import Evaluation, Sample, TruthEvaluation
from splatam_core.evaluation.trajectory import TrajectoryError
from splatam_core.runs.frame_records import STAGES
from splatam_core.types import Status

INK, MUTED, FAINT = '#1b1f24', '#6b7480', '#e3e6ea'
ESTIMATE, TRUTH, LOST = '#1769e0', '#9aa2ad', '#e5484d'
STAGE_COLORS = {'track': '#1769e0', 'densify': '#30a46c', 'keyframes': '#f5a524', 'map': '#8e4ec6'}
ERROR_COLORS = LinearSegmentedColormap.from_list('error', ['#1769e0', '#7a5bd6', '#d6409f', '#e5484d'])
DEPTH_COLORS = matplotlib.colormaps['viridis'].with_extremes(bad='#d5d9de')
DIFFERENCE_COLORS = matplotlib.colormaps['magma'].with_extremes(bad='#d5d9de')
COLOR_DIFFERENCE_LIMIT = 0.25

FloatImage = NDArray[np.floating]


def seconds(evaluation: Evaluation, stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Stamps as seconds since the run's first frame."""
    run = evaluation.run
    first = min([*run.trajectory.stamps_ns[:1], *run.lost_ns[:1]], default=0)
    return (np.asarray(stamps_ns, dtype=np.int64) - first) * 1e-9


@dataclass(frozen=True, slots=True)
class Projection:
    """A way to look at a path.

    Attributes:
        title: what it is called.
        axes: which coordinates go right and up.
        labels: theirs.
        flip: whether the upward coordinate grows downwards.
    """

    title: str
    axes: tuple[int, int]
    labels: tuple[str, str]
    flip: bool = False


ABOVE = Projection('Path from above', (0, 2), ('x, right (m)', 'z, forward (m)'))
SIDE = Projection('Path from the side', (2, 1), ('z, forward (m)', 'y, down (m)'), flip=True)


def path_view(ax: Axes, evaluation: Evaluation, projection: Projection = ABOVE) -> LineCollection | None:
    """The path from one side. Returns the error-coloured line where a truth is known."""
    seen = list(projection.axes)
    centres = evaluation.run.trajectory.T_world_cam[:, :3, 3]
    colored = None
    if evaluation.truth is not None:
        _line(ax, _truth_in_span(evaluation, evaluation.truth)[1][:, seen], TRUTH, 1.6, 'truth')
        colored = _error_line(ax, evaluation, evaluation.truth.error, seen)
    else:
        _line(ax, centres[:, seen], ESTIMATE, 1.8, 'estimate')
    if len(centres):
        ax.plot(*centres[0, seen], 'o', ms=7, mfc='white', mec=INK, mew=1.4, label='start', zorder=4)
        ax.plot(*centres[-1, seen], 's', ms=6, color=INK, label='end', zorder=4)
        ax.legend(loc='best')
    ax.set(title=projection.title, xlabel=projection.labels[0], ylabel=projection.labels[1])
    ax.set_aspect('equal', adjustable='datalim')
    ax.margins(0.08)
    ax.xaxis.set_major_locator(MaxNLocator(5))
    if projection.flip:
        ax.invert_yaxis()
    return colored


def _error_line(ax: Axes, evaluation: Evaluation, error: TrajectoryError, seen: list[int]) -> LineCollection:
    points = error.estimate_m[:, seen]
    connected = _connected(evaluation, error.stamps_ns)
    pieces = np.stack([points[:-1], points[1:]], axis=1)[connected]  # [K, 2, 2]
    values_cm = (error.errors_m[:-1] + error.errors_m[1:])[connected] * 50
    norm = Normalize(0, max(1e-3, float(error.errors_m.max()) * 100))
    line = LineCollection(pieces, array=values_cm, cmap=ERROR_COLORS, norm=norm, linewidths=2.2, capstyle='round')
    ax.add_collection(line)
    return line


def coordinates_over_time(axes: NDArray[np.object_], evaluation: Evaluation) -> None:
    """x, y and z of the camera over time, one below the other."""
    run = evaluation.run
    stamps_s, centres = seconds(evaluation, run.trajectory.stamps_ns), run.trajectory.T_world_cam[:, :3, 3]
    for axis, (ax, name) in enumerate(zip(axes, ('x, right (m)', 'y, down (m)', 'z, forward (m)'))):
        if evaluation.truth is not None:
            truth_s, truth_m = _truth_in_span(evaluation, evaluation.truth)
            ax.plot(truth_s, truth_m[:, axis], color=TRUTH, lw=3, label='truth')
        curve = _broken(evaluation, run.trajectory.stamps_ns, stamps_s, centres[:, axis])
        ax.plot(*curve, color=ESTIMATE, lw=1.3, label='estimate', marker='.' if len(centres) == 1 else None)
        _mark_lost(ax, evaluation)
        ax.set_ylabel(name)
        ax.yaxis.set_major_locator(MaxNLocator(4))
        ax.tick_params(labelbottom=axis == 2)
    axes[0].set_title('Path over time')
    axes[0].legend(loc='best', ncol=3)
    axes[-1].set_xlabel('time (s)')


def position_error(ax: Axes, evaluation: Evaluation) -> None:
    """Distance to the truth over time."""
    ax.set(title='Distance to the truth', xlabel='time (s)', ylabel='cm')
    if evaluation.truth is None:
        _note(ax, 'no truth to compare with')
        return
    error = evaluation.truth.error
    stamps_s, errors_cm = _broken(evaluation, error.stamps_ns, seconds(evaluation, error.stamps_ns), error.errors_m * 100)
    ax.fill_between(stamps_s, errors_cm, color=ESTIMATE, alpha=0.15, lw=0)
    ax.plot(stamps_s, errors_cm, color=ESTIMATE, lw=1.3)
    ax.axhline(error.rmse_m * 100, color=INK, lw=1, ls=(0, (4, 3)), label=f'RMSE {error.rmse_m * 100:.2f} cm')
    _mark_lost(ax, evaluation)
    ax.set_ylim(bottom=0)
    ax.legend(loc='best')


def image_scores(ax_psnr: Axes, ax_depth: Axes, evaluation: Evaluation) -> None:
    """PSNR and depth L1 of every scored frame."""
    ax_psnr.set(title='Final map against each frame', ylabel='PSNR (dB)')
    ax_depth.set(xlabel='time (s)', ylabel='depth L1 (cm)')
    if evaluation.images is None:
        _note(ax_psnr, 'no frames or no map to compare')
        _note(ax_depth, '')
        return
    frames = [frame for frame in evaluation.images.frames if frame.scores.psnr_db is not None]
    stamps_s = seconds(evaluation, np.array([frame.stamp_ns for frame in frames], dtype=np.int64))
    _curve_with_mean(ax_psnr, stamps_s, [frame.scores.psnr_db for frame in frames], ESTIMATE, '.1f')
    _curve_with_mean(ax_depth, stamps_s, [frame.scores.depth_l1_m * 100 for frame in frames], '#d6409f', '.2f')
    ax_depth.set_ylim(bottom=0)
    ax_psnr.tick_params(labelbottom=False)


def stage_times(ax: Axes, evaluation: Evaluation) -> None:
    """Wall time of each frame, stacked by stage."""
    ax.set(title='Time per frame', xlabel='frame', ylabel='ms')
    records = evaluation.run.frames
    if not records:
        _note(ax, 'no times recorded')
        return
    stages = [stage for stage in STAGES if stage in STAGE_COLORS]
    times_ms = np.array([[getattr(record.timings, stage) for record in records] for stage in stages])
    medians = np.median(times_ms, axis=1)
    edges, until_last = np.arange(len(records) + 1) - 0.5, np.concatenate([times_ms, times_ms[:, -1:]], axis=1)
    ax.stackplot(
        edges, until_last, colors=[STAGE_COLORS[stage] for stage in stages], lw=0, alpha=0.85,
        labels=[f'{stage}  {median:.0f} ms' for stage, median in zip(stages, medians)], step='post',
    )  # fmt: skip
    ax.set_xlim(-0.5, len(records) - 0.5)
    total_ms = times_ms.sum(axis=0)
    top_ms = max(1e-3, min(1.35 * float(np.percentile(total_ms, 99)), 2.5 * float(np.percentile(total_ms, 95))))
    ax.set_ylim(0, top_ms)
    if total_ms.max() > top_ms:
        ax.text(1, 1.01, f'slowest {total_ms.max():.0f} ms', transform=ax.transAxes, ha='right', va='bottom', color=MUTED)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    handles, labels = ax.get_legend_handles_labels()
    ax.legend(handles[::-1], labels[::-1], loc='upper left', ncol=2, title='median', title_fontsize=8)


def map_size(ax: Axes, evaluation: Evaluation) -> None:
    """Number of Gaussians after each frame, with keyframes and lost frames marked."""
    ax.set(title='Gaussians', xlabel='frame')
    records = evaluation.run.frames
    if not records:
        _note(ax, 'not recorded')
        return
    count = np.array([record.num_gaussians for record in records])
    ax.fill_between(np.arange(len(records)), count, color=ESTIMATE, alpha=0.15, lw=0)
    ax.plot(count, color=ESTIMATE, lw=1.3)
    keyframes = [index for index, record in enumerate(records) if record.is_keyframe]
    ax.plot(keyframes, count[keyframes], '.', ms=4, color=INK, label=f'{len(keyframes)} keyframes')
    for index in (index for index, record in enumerate(records) if record.status is Status.LOST):
        ax.axvline(index, color=LOST, lw=0.8, alpha=0.5)
    ax.set_ylim(bottom=0)
    ax.yaxis.set_major_formatter(EngFormatter(sep=''))
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.legend(loc='lower right')


@dataclass(frozen=True, slots=True, eq=False)
class Panels:
    """The pictures of one sample, and how their values become colours.

    Attributes:
        reading_m: [H, W] depth, NaN = none.
        rendered_m: [H, W] rendered depth, NaN = none.
        rgb_difference: [H, W] mean absolute difference of colour.
        depth_difference_cm: [H, W], NaN = no reading.
        depth_norm: of both depths.
        depth_difference_norm: of their difference.
    """

    reading_m: FloatImage
    rendered_m: FloatImage
    rgb_difference: FloatImage
    depth_difference_cm: FloatImage
    depth_norm: Normalize
    depth_difference_norm: Normalize

    @classmethod
    def of(cls, sample: Sample) -> Panels:
        """Of a sample."""
        reading = np.where(sample.reading_m > 0, sample.reading_m, np.nan)
        rendered = np.where(sample.depth_m > 0, sample.depth_m, np.nan)
        difference_cm = np.abs(sample.depth_m - reading) * 100
        rgb_difference = np.abs(sample.rgb - sample.frame.rgb / 255).mean(axis=2)
        limits = _depth_norm(reading, rendered), Normalize(0, _difference_limit_cm(difference_cm))
        return cls(reading, rendered, rgb_difference, difference_cm, *limits)


def sample_images(axes: NDArray[np.object_], sample: Sample) -> tuple[AxesImage, AxesImage, AxesImage]:
    """One frame: colour, its render, their difference; depth, its render, their difference.

    Returns:
        The images that a colour bar explains: colour difference, depth, depth difference.
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
    """A round number: 5 cm, or more where 95 % of the picture needs it."""
    known = difference_cm[np.isfinite(difference_cm)]
    needed = float(np.percentile(known, 95)) if known.size else 0.0
    return next((limit for limit in (5.0, 10.0, 20.0, 50.0, 100.0) if needed <= limit), 200.0)


def _truth_in_span(evaluation: Evaluation, truth: TruthEvaluation) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Time in seconds [N] and camera centres [N, 3] of the truth while the run lasted."""
    stamps, ours = truth.truth.stamps_ns, evaluation.run.trajectory.stamps_ns
    during = (stamps >= ours[0]) & (stamps <= ours[-1])
    return seconds(evaluation, stamps[during]), truth.truth.T_world_cam[during, :3, 3]


def _connected(evaluation: Evaluation, stamps_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """[N - 1] whether no frame was lost between one stamp and the next."""
    before = np.searchsorted(np.array(evaluation.run.lost_ns, dtype=np.int64), stamps_ns)
    return before[1:] == before[:-1]


def _broken(
    evaluation: Evaluation, stamps_ns: NDArray[np.int64], x: NDArray[np.float64], y: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A curve with a gap wherever frames were lost."""
    gaps = np.flatnonzero(~_connected(evaluation, stamps_ns)) + 1
    return np.insert(x, gaps, np.nan), np.insert(y, gaps, np.nan)


def _mark_lost(ax: Axes, evaluation: Evaluation) -> None:
    for index, stamp_s in enumerate(seconds(evaluation, np.array(evaluation.run.lost_ns, dtype=np.int64))):
        ax.axvline(stamp_s, color=LOST, lw=0.8, alpha=0.5, label='lost' if index == 0 else None, zorder=0)


def _line(ax: Axes, points: NDArray[np.float64], color: str, width: float, label: str) -> None:
    ax.plot(points[:, 0], points[:, 1], color=color, lw=width, label=label, solid_capstyle='round')


def _curve_with_mean(ax: Axes, x: NDArray[np.float64], y: list[float], color: str, digits: str) -> None:
    mean = float(np.mean(y)) if y else float('nan')
    ax.plot(x, y, color=color, lw=1.2, marker='.' if len(y) < 40 else None, ms=4)
    ax.axhline(mean, color=INK, lw=1, ls=(0, (4, 3)), label=f'mean {mean:{digits}}')
    ax.legend(loc='best')


def _note(ax: Axes, text: str) -> None:
    ax.text(0.5, 0.5, text, transform=ax.transAxes, ha='center', va='center', color=MUTED)
    ax.set(xticks=[], yticks=[])
    ax.grid(False)
