"""``report.png``: one picture that says how a run went."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure

from splatam_core.atomic_io import replaced
from splatam_core.evaluation.report import plots
from splatam_core.evaluation.score import Evaluation, Sample

DPI = 110
WIDTH_IN = 17.0
HEADER_IN, PATHS_IN, CURVES_IN = 1.75, 4.6, 3.5
STYLE = {
    'font.family': 'DejaVu Sans',
    'font.size': 9,
    'text.color': plots.INK,
    'axes.edgecolor': plots.TRUTH,
    'axes.labelcolor': plots.MUTED,
    'axes.titlecolor': plots.INK,
    'axes.titlesize': 11,
    'axes.titleweight': 'bold',
    'axes.titlelocation': 'left',
    'axes.titlepad': 8,
    'axes.grid': True,
    'axes.axisbelow': True,
    'axes.spines.top': False,
    'axes.spines.right': False,
    'grid.color': plots.FAINT,
    'grid.linewidth': 0.8,
    'xtick.color': plots.MUTED,
    'ytick.color': plots.MUTED,
    'legend.frameon': True,
    'legend.framealpha': 0.85,
    'legend.edgecolor': 'none',
    'legend.fontsize': 8.5,
}
COLUMNS = ('colour', 'render', 'difference', 'depth', 'rendered depth', 'difference')


def write_report(evaluation: Evaluation, path: Path) -> None:
    """Draw the report of a run; a picture that is there is replaced once the new one is complete."""
    with matplotlib.rc_context(STYLE):
        figure = draw_report(evaluation)
        with replaced(path) as temporary:
            figure.savefig(temporary, format='png', dpi=DPI)


def draw_report(evaluation: Evaluation) -> Figure:
    """The report as a figure: headline numbers, path, sample frames, curves."""
    samples = evaluation.images.samples if evaluation.images else ()
    samples_in = _samples_height_in(samples)
    heights = [HEADER_IN, PATHS_IN, *([samples_in] if samples else []), CURVES_IN]
    figure = Figure(figsize=(WIDTH_IN, sum(heights)), facecolor='white', layout='constrained')
    FigureCanvasAgg(figure)
    rows = list(figure.subfigures(len(heights), 1, height_ratios=heights))
    _draw_header(rows[0], evaluation)
    _draw_paths(rows[1], evaluation)
    if samples:
        _draw_samples(rows[2], evaluation, samples)
    _draw_curves(rows[-1], evaluation)
    return figure


def _draw_header(figure: SubFigure, evaluation: Evaluation) -> None:
    figure.text(0.012, 0.86, _plain(evaluation.run.path.resolve().name), fontsize=20, fontweight='bold', va='center')
    figure.text(0.012, 0.64, _plain(subtitle(evaluation)), fontsize=10, color=plots.MUTED, va='center')
    tiles = headline(evaluation)
    for index, (value, unit, name) in enumerate(tiles):
        x = 0.012 + index * (0.98 / len(tiles))
        number = figure.text(x, 0.28, value, fontsize=19, fontweight='bold', va='baseline')
        figure.text(x, 0.08, name, fontsize=9.5, color=plots.MUTED, va='baseline')
        _text_after(figure, number, f' {unit}')


def _text_after(figure: SubFigure, text: matplotlib.text.Text, following: str) -> None:
    """Put smaller text right behind another."""
    box = text.get_window_extent().transformed(figure.transSubfigure.inverted())
    figure.text(box.x1, text.get_position()[1], following, fontsize=10, color=plots.MUTED, va='baseline')


def subtitle(evaluation: Evaluation) -> str:
    """What was run, on one line."""
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


def _plain(text: str) -> str:
    """Without what matplotlib would take for mathematics."""
    return text.replace('$', r'\$')


def headline(evaluation: Evaluation) -> list[tuple[str, str, str]]:
    """The numbers to see first: (value, unit, name) of the headline numbers; an en dash where one is not known."""
    m = evaluation.metrics
    every = f', 1 in {m.evaluated_every} frames' if m.evaluated_every and m.evaluated_every > 1 else ''
    return [
        (_digits(m.ate_rmse_m, 100, 2), 'cm', 'ATE RMSE'),
        (_digits(m.psnr_db, 1, 2), 'dB', f'PSNR{every}'),
        (_digits(m.ssim, 1, 3), '', 'SSIM'),
        (_digits(m.depth_l1_m, 100, 2), 'cm', 'depth L1'),
        (f'{m.tracked}', f'of {m.frames}', 'frames tracked'),
        (_digits(m.fps, 1, 2), 'fps', 'without decoding'),
        ('\u2013' if m.num_gaussians is None else f'{m.num_gaussians:,}', '', 'Gaussians'),
        (_digits(m.peak_rss_mb, 1 / 1024, 2), 'GiB', 'peak memory'),
    ]


def _digits(value: float | None, factor: float, decimals: int) -> str:
    return '\u2013' if value is None else f'{value * factor:.{decimals}f}'


def _draw_paths(figure: SubFigure, evaluation: Evaluation) -> None:
    grid = figure.add_gridspec(3, 3, width_ratios=[1.05, 1.2, 1.0])
    above = figure.add_subplot(grid[:, 0])
    line = plots.path_view(above, evaluation)
    if line is not None:
        bar = figure.colorbar(line, ax=above, fraction=0.035, pad=0.02, label='estimate: distance to the truth (cm)')
        bar.outline.set_visible(False)
    over_time = [figure.add_subplot(grid[0, 1])]
    over_time += [figure.add_subplot(grid[row, 1], sharex=over_time[0]) for row in (1, 2)]
    plots.coordinates_over_time(np.array(over_time), evaluation)
    plots.position_error(figure.add_subplot(grid[:, 2]), evaluation)


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
        label = f'{sample.title}, at {time_s:.2f} s\n{scores.psnr_db:.1f} dB   {scores.depth_l1_m * 100:.1f} cm'
        row[0].set_ylabel(label, color=plots.INK, linespacing=1.5)
        for image, ax, unit in ((color, row[2], ''), (depth, row[4], 'm'), (difference, row[5], 'cm')):
            bar = figure.colorbar(image, cax=ax.inset_axes([1.015, 0, 0.035, 1]))
            bar.ax.set_title(unit, fontsize=7.5, fontweight='normal', color=plots.MUTED, loc='left', pad=3)
            bar.outline.set_visible(False)
            bar.ax.tick_params(labelsize=7.5)
    for ax, name in zip(axes[0], COLUMNS):
        ax.set_title(name)


def _draw_curves(figure: SubFigure, evaluation: Evaluation) -> None:
    grid = figure.add_gridspec(2, 3)
    psnr = figure.add_subplot(grid[0, 0])
    plots.image_scores(psnr, figure.add_subplot(grid[1, 0], sharex=psnr), evaluation)
    plots.stage_times(figure.add_subplot(grid[:, 1]), evaluation)
    plots.map_size(figure.add_subplot(grid[:, 2]), evaluation)
