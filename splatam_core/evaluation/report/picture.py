"""``report.png``: the results of a run in one picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure
from matplotlib.text import Text

from splatam_core.atomic_io import replaced
from splatam_core.evaluation.report import plots
from splatam_core.evaluation.report.theme import LIGHT
from splatam_core.evaluation.results import Evaluation, Sample

DPI = 110
WIDTH_IN = 17.0
HEADER_IN, PATHS_IN, CURVES_IN = 1.75, 4.6, 3.5
COLUMNS = ('colour', 'render', 'difference', 'depth', 'rendered depth', 'difference')


def write_report(evaluation: Evaluation, path: Path) -> None:
    """Draw the report of a run. An existing picture is replaced only when the new one is complete."""
    with matplotlib.rc_context(LIGHT.style()):
        figure = draw_report(evaluation)
        with replaced(path) as temporary:
            FigureCanvasAgg(figure).print_png(temporary)  # savefig would draw everything twice


def draw_report(evaluation: Evaluation) -> Figure:
    """Draw the report as a figure: headline numbers, path, sample frames, curves."""
    samples = evaluation.images.samples if evaluation.images else ()
    samples_in = _samples_height_in(samples)
    heights = [HEADER_IN, PATHS_IN, *([samples_in] if samples else []), CURVES_IN]
    figure = Figure(figsize=(WIDTH_IN, sum(heights)), dpi=DPI, facecolor=LIGHT.card, layout='constrained')
    FigureCanvasAgg(figure)
    rows = figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
    _draw_header(rows[0], evaluation)
    _draw_paths(rows[1], evaluation)
    if samples:
        _draw_samples(rows[2], evaluation, samples)
    _draw_curves(rows[-1], evaluation)
    return figure


def _draw_header(figure: SubFigure, evaluation: Evaluation) -> None:
    figure.text(0.012, 0.86, _without_math(evaluation.run.path.resolve().name), fontsize=20, fontweight='bold', va='center')
    figure.text(0.012, 0.64, _without_math(subtitle(evaluation)), fontsize=10, color=LIGHT.muted, va='center')
    numbers = headline(evaluation)
    for index, number in enumerate(numbers):
        x = 0.012 + index * (0.98 / len(numbers))
        value = figure.text(x, 0.28, number.value, fontsize=19, fontweight='bold', va='baseline')
        figure.text(x, 0.08, number.name, fontsize=9.5, color=LIGHT.muted, va='baseline')
        _text_after(figure, value, f' {number.unit}')


def _text_after(figure: SubFigure, text: Text, following: str) -> None:
    """Write smaller text directly after another text."""
    box = text.get_window_extent().transformed(figure.transSubfigure.inverted())
    figure.text(box.x1, text.get_position()[1], following, fontsize=10, color=LIGHT.muted, va='baseline')


def subtitle(evaluation: Evaluation) -> str:
    """Return one line that says what was run."""
    run = evaluation.run
    source = run.description.source
    parts = [
        source.path if source else 'live topics',
        f'preset {run.description.preset or "none"}',
        f'{run.camera.width}x{run.camera.height}' if run.camera else '',
        f'{run.config.rasterizer} rasterizer' if run.config.rasterizer != 'auto' else '',
        run.description.program,
        f'commit {run.commit[:10]}{"-dirty" if run.commit.endswith("-dirty") else ""}' if run.commit else '',
    ]
    return '   ·   '.join(part for part in parts if part)


def _without_math(text: str) -> str:
    """Escape the sign that starts mathematics in matplotlib."""
    return text.replace('$', r'\$')


@dataclass(frozen=True, slots=True)
class Headline:
    """One of the most important numbers, as text. The value is an en dash if it is not known."""

    value: str
    unit: str
    name: str


def headline(evaluation: Evaluation) -> list[Headline]:
    """Return the most important numbers of a run."""
    m = evaluation.metrics
    every = f', 1 in {m.evaluated_every} frames' if m.evaluated_every and m.evaluated_every > 1 else ''
    return [
        Headline(number_text(m.ate_rmse_m, 100, 2), 'cm', 'ATE RMSE'),
        Headline(number_text(m.psnr_db, 1, 2), 'dB', f'PSNR{every}'),
        Headline(number_text(m.ssim, 1, 3), '', 'SSIM'),
        Headline(number_text(m.depth_l1_m, 100, 2), 'cm', 'depth L1'),
        Headline(f'{m.tracked}', f'of {m.frames}', f'tracked, {m.uncertain} uncertain' if m.uncertain else 'frames tracked'),
        Headline(number_text(m.fps, 1, 2), 'fps', 'without decoding'),
        Headline('\u2013' if m.num_gaussians is None else f'{m.num_gaussians:,}', '', 'Gaussians'),
        Headline(number_text(m.peak_rss_mb, 1 / 1024, 2), 'GiB', 'peak memory'),
    ]


def number_text(value: float | None, factor: float, decimals: int) -> str:
    """Format a number after a change of unit. Returns an en dash if it is not known."""
    return '\u2013' if value is None else f'{value * factor:.{decimals}f}'


def _draw_paths(figure: SubFigure, evaluation: Evaluation) -> None:
    grid = figure.add_gridspec(3, 3, width_ratios=[1.05, 1.2, 1.0])
    above = figure.add_subplot(grid[:, 0])
    line = plots.path_view(above, evaluation, LIGHT)
    if line is not None:
        bar = figure.colorbar(line, ax=above, fraction=0.035, pad=0.02, label='estimate: distance to the ground truth (cm)')
        bar.outline.set_visible(False)
    over_time = [figure.add_subplot(grid[0, 1])]
    over_time += [figure.add_subplot(grid[row, 1], sharex=over_time[0]) for row in (1, 2)]
    plots.coordinates_over_time(np.array(over_time), evaluation, LIGHT)
    plots.position_error(figure.add_subplot(grid[:, 2]), evaluation, LIGHT)


def _samples_height_in(samples: tuple[Sample, ...]) -> float:
    if not samples:
        return 0.0
    camera = samples[0].frame.camera
    return 0.55 + len(samples) * (0.1 + WIDTH_IN / 7 * camera.height / camera.width)


def _draw_samples(figure: SubFigure, evaluation: Evaluation, samples: tuple[Sample, ...]) -> None:
    axes = figure.subplots(len(samples), 6, squeeze=False)
    for row, sample in zip(axes, samples):
        color, depth, difference = plots.sample_images(row, sample)
        scores = sample.scores.scores
        time_s = plots.seconds(evaluation, np.array([sample.frame.stamp_ns]))[0]
        psnr, depth_l1 = number_text(scores.psnr_db, 1, 1), number_text(scores.depth_l1_m, 100, 1)
        label = f'{sample.title}, at {time_s:.2f} s\n{psnr} dB   {depth_l1} cm'
        row[0].set_ylabel(label, color=LIGHT.ink, linespacing=1.5)
        for image, ax, unit in ((color, row[2], ''), (depth, row[4], 'm'), (difference, row[5], 'cm')):
            bar = figure.colorbar(image, cax=ax.inset_axes([1.015, 0, 0.035, 1]))
            bar.ax.set_title(unit, fontsize=7.5, fontweight='normal', color=LIGHT.muted, loc='left', pad=3)
            bar.outline.set_visible(False)
            bar.ax.tick_params(labelsize=7.5)
    for ax, name in zip(axes[0], COLUMNS):
        ax.set_title(name)


def _draw_curves(figure: SubFigure, evaluation: Evaluation) -> None:
    grid = figure.add_gridspec(2, 3)
    psnr = figure.add_subplot(grid[0, 0])
    plots.image_scores(psnr, figure.add_subplot(grid[1, 0], sharex=psnr), evaluation, LIGHT)
    plots.stage_times(figure.add_subplot(grid[:, 1]), evaluation, LIGHT)
    plots.map_size(figure.add_subplot(grid[:, 2]), evaluation, LIGHT)
