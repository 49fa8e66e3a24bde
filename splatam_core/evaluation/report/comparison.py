"""The comparison of several runs: tables, and a picture."""

from __future__ import annotations

import io
import json
import os
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import quote

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator

from splatam_core.config import flat_values
from splatam_core.evaluation.report.descriptions import BY_NAME, Description
from splatam_core.evaluation.report.html import data_address
from splatam_core.evaluation.report.tables import UNKNOWN, Table, page
from splatam_core.evaluation.report.theme import LIGHT
from splatam_core.runs.layout import PAGE
from splatam_core.runs.metrics import Metrics
from splatam_core.runs.record import RunRecord

COLUMNS = (
    'ate_rmse_m', 'rpe_trans_frame_m', 'rpe_trans_1s_m', 'psnr_db', 'ssim', 'ms_ssim', 'lpips', 'depth_l1_m',
    'heldout_psnr_db', 'heldout_depth_l1_m', 'novel_psnr_db', 'novel_depth_l1_m', 'splatam_ate_mean_m',
    'splatam_psnr_db', 'splatam_ms_ssim', 'splatam_depth_l1_m', 'fps', 'num_gaussians', 'peak_rss_mb',
)  # fmt: skip
"""Numbers in the table. A column that is empty for all runs is left out."""

PREFIXES = {'heldout_': 'held out: ', 'novel_': 'novel: ', 'splatam_': 'as original: '}
BARS = ('ate_rmse_m', 'psnr_db', 'depth_l1_m', 'fps', 'num_gaussians', 'peak_rss_mb')
COLORS = ('#1769e0', '#d6409f', '#30a46c', '#f5a524', '#8e4ec6', '#00a2c7', '#e5484d', '#6b7480')


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """A run with the label that distinguishes it from the others."""

    label: str
    record: RunRecord
    metrics: Metrics


def comparison_table(runs: Sequence[RunRecord]) -> Table:
    """Return a table with one run per line. Columns that are empty for all runs are left out."""
    labelled = _labelled(runs)
    commits = {run.commit or 'unknown' for run in runs}
    sources = {_source(run) for run in runs}
    columns = [
        ('run', [run.label for run in labelled]),
        *([('source', [_source(run) for run in runs])] if len(sources) > 1 else []),
        *([('commit', [(run.commit or 'unknown')[:10] for run in runs])] if len(commits) > 1 else []),
        ('preset', [_preset(run) for run in runs]),
        ('tracked', [f'{run.metrics.tracked}/{run.metrics.frames}' for run in labelled]),
    ]
    for name in COLUMNS:
        cells = [BY_NAME[name].text(run.metrics) for run in labelled]
        if any(cell != UNKNOWN for cell in cells):
            columns.append((_heading(BY_NAME[name]), cells))
    return _table('Every run', columns)


def summary_table(runs: Sequence[RunRecord]) -> Table | None:
    """Return a table with one line for all runs that differ in their seed only: median, smallest and largest value.

    Returns:
        None if no two runs have the same recording and settings.
    """
    groups: dict[tuple[str, str], list[_Run]] = {}
    for run in _labelled(runs):
        groups.setdefault((_source(run.record), _settings_but_seed(run.record)), []).append(run)
    if all(len(group) == 1 for group in groups.values()):
        return None
    firsts = [group[0].record for group in groups.values()]
    columns = [
        ('preset', [_preset(record) for record in firsts]),
        *([('source', [_source(record) for record in firsts])] if len({source for source, _ in groups}) > 1 else []),
        ('runs', [str(len(group)) for group in groups.values()]),
        ('tracked', ['/'.join(str(sum(values)) for values in _counts(group)) for group in groups.values()]),
    ]
    for name in COLUMNS:
        cells = [_spread(BY_NAME[name], group) for group in groups.values()]
        if any(cell != UNKNOWN for cell in cells):
            columns.append((_heading(BY_NAME[name]), cells))
    return _table('Median over seeds (smallest to largest)', columns)


def _counts(runs: Sequence[_Run]) -> Iterator[tuple[int, ...]]:
    return zip(*((run.metrics.tracked, run.metrics.frames) for run in runs))


def _spread(description: Description, runs: Sequence[_Run]) -> str:
    values = [value for run in runs if (value := run.metrics.values()[description.name]) is not None]
    if not values:
        return UNKNOWN
    middle, low, high = (description.form_of(value) for value in (statistics.median(values), min(values), max(values)))
    return middle if low == high else f'{middle} ({low} to {high})'


def _settings_but_seed(run: RunRecord) -> str:
    return json.dumps({name: value for name, value in flat_values(run.config).items() if name != 'seed'}, default=str)


def _table(title: str, columns: Sequence[tuple[str, Sequence[str]]]) -> Table:
    return Table(title, [heading for heading, _ in columns], list(zip(*(cells for _, cells in columns))))


def comparison_page(runs: Sequence[RunRecord], beside: Path) -> str:
    """Return tables and picture of the runs as a page.

    Args:
        runs: the runs.
        beside: the page's folder; links lead from there to the runs' reports.
    """
    every = comparison_table(runs)
    pages = {run.label: run.record.path / PAGE for run in _labelled(runs)}
    links = {label: quote(os.path.relpath(path, beside)) for label, path in pages.items() if path.is_file()}
    tables = [table for table in (summary_table(runs), replace(every, links=links)) if table is not None]
    buffer = io.BytesIO()
    draw_comparison(runs).savefig(buffer, format='png', dpi=120)
    return page('Comparison', in_common(runs), tables, data_address('image/png', buffer.getvalue()))


def in_common(runs: Sequence[RunRecord]) -> str:
    """Return what the runs have in common: recording, commit and machine, as far as it is one."""
    commits = {run.commit or 'unknown' for run in runs}
    sources = {_source(run) for run in runs}
    machines = sorted({_machine(run) for run in runs})
    parts = [
        *(sources if len(sources) == 1 else []),
        *(f'commit {c[:18]}' for c in commits if len(commits) == 1),
        *machines,
    ]
    return '; '.join(parts)


def _preset(run: RunRecord) -> str:
    return run.description.preset or 'none'


def _machine(run: RunRecord) -> str:
    machine = run.machine
    return f'{machine.get("processor", "unknown processor")}, {machine.get("cores", "?")} cores'


def _source(run: RunRecord) -> str:
    source = run.description.source
    return 'live topics' if source is None else source.path


def _labelled(runs: Sequence[RunRecord]) -> list[_Run]:
    """Label each run with its folder's name, or with the folder's path if two runs have the same name."""
    names = [run.path.resolve().name for run in runs]
    labels = [name if names.count(name) == 1 else str(run.path) for name, run in zip(names, runs)]
    return [_Run(label, run, run.metrics()) for label, run in zip(labels, runs)]


def _heading(description: Description) -> str:
    prefix = next((words for name, words in PREFIXES.items() if description.name.startswith(name)), '')
    label = prefix + description.label.removesuffix(' as the original')
    return f'{label} {description.unit}'.rstrip()


def draw_comparison(runs: Sequence[RunRecord]) -> Figure:
    """Draw bars of the most important numbers; below them the paths from above, time per frame and map size."""
    labelled = _labelled(runs)
    bars_in = 0.75 + 0.28 * len(labelled)
    with matplotlib.rc_context(LIGHT.style()):
        figure = Figure(figsize=(15, bars_in + 4.6), facecolor=LIGHT.card, layout='constrained')
        FigureCanvasAgg(figure)
        above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=[bars_in, 4.6])[:, 0]
        shown = [name for name in BARS if any(run.metrics.values()[name] is not None for run in labelled)]
        for index, (ax, name) in enumerate(zip(above.subplots(1, len(shown), squeeze=False)[0], shown)):
            _bars(ax, labelled, BY_NAME[name], with_labels=index == 0)
        path, times, size = below.subplots(1, 3)
        _paths(path, labelled)
        _times(times, labelled)
        _sizes(size, labelled)
    return figure


def _color(index: int) -> str:
    return COLORS[index % len(COLORS)]


def _bars(ax: Axes, runs: Sequence[_Run], description: Description, with_labels: bool) -> None:
    values = [run.metrics.values()[description.name] for run in runs]
    shown = [0.0 if value is None else value * description.factor for value in values]
    bars = ax.barh(range(len(runs)), shown, color=[_color(index) for index in range(len(runs))], height=0.7)
    ax.bar_label(bars, [description.text(run.metrics) for run in runs], padding=4, color=LIGHT.ink, fontsize=9)
    ax.set_yticks(range(len(runs)), [run.label for run in runs] if with_labels else [''] * len(runs))
    ax.set(title=f'{description.label} {description.unit}'.rstrip(), xticks=[])
    ax.set_xlim(0, 1.35 * max([*shown, 1e-9]))
    ax.invert_yaxis()
    ax.grid(False)
    ax.spines[['bottom', 'left']].set_visible(False)
    ax.tick_params(left=False, labelcolor=LIGHT.ink)


def _paths(ax: Axes, runs: Sequence[_Run]) -> None:
    for index, run in enumerate(runs):
        centres = run.record.trajectory.T_world_cam[:, :3, 3]
        ax.plot(centres[:, 0], centres[:, 2], color=_color(index), lw=1.5, label=run.label, alpha=0.85)
    ax.set(title='Paths from above', xlabel='x, right (m)', ylabel='z, forward (m)')
    ax.set_aspect('equal', adjustable='datalim')
    ax.legend(loc='best')


def _times(ax: Axes, runs: Sequence[_Run]) -> None:
    for index, run in enumerate(runs):
        ax.plot([frame.process_ms for frame in run.record.frames], color=_color(index), lw=1.0, alpha=0.85)
    ax.set(title='Time per frame', xlabel='frame', ylabel='ms')
    if any(run.record.frames for run in runs):
        ax.set_yscale('log')
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))


def _sizes(ax: Axes, runs: Sequence[_Run]) -> None:
    for index, run in enumerate(runs):
        ax.plot([frame.num_gaussians for frame in run.record.frames], color=_color(index), lw=1.5)
    ax.set(title='Gaussians', xlabel='frame')
    ax.set_ylim(bottom=0)
    ax.yaxis.set_major_formatter(EngFormatter(sep=''))
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
