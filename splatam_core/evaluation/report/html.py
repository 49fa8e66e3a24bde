"""``picture.html``: a run on one page that needs neither files beside it nor a network, for light and dark screens."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable, Iterator
from html import escape
from pathlib import Path
from string import Template

import cv2
import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from splatam_core.atomic_io import replace_text
from splatam_core.config import SlamConfig, flat_values, settings
from splatam_core.evaluation.report import picture, plots
from splatam_core.evaluation.report.descriptions import BY_NAME, DESCRIPTIONS, Description
from splatam_core.evaluation.score import Evaluation, Sample
from splatam_core.runs import provenance
from splatam_core.runs.metrics import Metrics

TEMPLATE = Path(__file__).with_name('report_template.html')
VARIABLES = {
    plots.INK: '--ink', plots.MUTED: '--muted', plots.FAINT: '--faint', plots.TRUTH: '--truth', plots.LOST: '--lost',
    plots.ESTIMATE: '--estimate', '#ffffff': '--card', '#30a46c': '--green', '#f5a524': '--orange', '#8e4ec6': '--violet',
    '#d6409f': '--pink',
}  # fmt: skip
"""Colours of the charts, and the variables of the page that take their place: they differ between light and dark."""

STYLE = {**picture.STYLE, 'svg.fonttype': 'none', 'axes.titlesize': 11, 'savefig.facecolor': 'none'}
JPEG_QUALITY = 88
Draw = Callable[[Figure, Evaluation], None]


def write_html(evaluation: Evaluation, path: Path) -> None:
    """Write the page of a run; one that is there is replaced once the new one is complete."""
    replace_text(path, html_report(evaluation))


def html_report(evaluation: Evaluation) -> str:
    """The page as a text."""
    run = evaluation.run
    name = run.path.resolve().name
    return Template(TEMPLATE.read_text(encoding='utf-8')).substitute(
        title=escape(name),
        subtitle=escape(picture.subtitle(evaluation)),
        tiles=''.join(_tiles(evaluation)),
        notes=_notes(evaluation.metrics),
        paths=_chart(evaluation, _paths, (11.5, 4.0), 'paths'),
        over_time=_chart(evaluation, _over_time, (11.5, 3.4), 'over time'),
        samples=''.join(_samples(evaluation)) or _nothing('No frames or no map to compare.'),
        scores=_chart(evaluation, _scores, (11.5, 3.2), 'scores'),
        stages=_chart(evaluation, _stages, (11.5, 3.4), 'stages'),
        timings=_timings(evaluation.metrics),
        metrics=''.join(_metrics(evaluation.metrics)),
        config=''.join(_config(run.config)),
        environment=''.join(_environment(evaluation)),
    )


def _tiles(evaluation: Evaluation) -> Iterator[str]:
    for value, unit, name in picture.headline(evaluation):
        yield f'<div class="tile"><b>{escape(value)}</b> <span>{escape(unit)}</span><p>{escape(name)}</p></div>'


def _notes(metrics: Metrics) -> str:
    notes = [(BY_NAME[name].label if name in BY_NAME else name, why) for name, why in metrics.notes.items()]
    items = ''.join(f'<li><b>{escape(label)}</b> is not known: {escape(why)}</li>' for label, why in notes)
    return f'<ul class="notes">{items}</ul>' if items else ''


def _nothing(text: str) -> str:
    return f'<p class="nothing">{escape(text)}</p>'


# --- charts ---


def _chart(evaluation: Evaluation, draw: Draw, size_in: tuple[float, float], name: str) -> str:
    """A figure as SVG that takes its colours from the page."""
    with matplotlib.rc_context({**STYLE, 'svg.hashsalt': name}):  # ids are made of the salt: none occurs twice on a page
        figure = Figure(figsize=size_in, facecolor='none', layout='constrained')
        FigureCanvasAgg(figure)
        draw(figure, evaluation)
        buffer = io.StringIO()
        figure.savefig(buffer, format='svg', metadata={'Date': None, 'Creator': None, 'Format': None, 'Type': None})
    return _for_page(buffer.getvalue(), name)


def _for_page(svg: str, name: str) -> str:
    svg = svg[svg.index('<svg') :]
    svg = re.sub(r'(<svg[^>]*?) width="[^"]*"', r'\1', svg, count=1)
    svg = re.sub(r'(<svg[^>]*?) height="[^"]*"', r'\1', svg, count=1)
    svg = svg.replace('<svg', f'<svg role="img" aria-label="{escape(name)}"', 1)
    for color, variable in VARIABLES.items():
        svg = re.sub(re.escape(color), f'var({variable})', svg, flags=re.IGNORECASE)
    return re.sub(r"'DejaVu Sans'(, [^;\"]*)?", 'inherit-page', svg).replace('inherit-page', 'system-ui, sans-serif')


def _paths(figure: Figure, evaluation: Evaluation) -> None:
    paths, right = figure.subfigures(1, 2, width_ratios=[2.2, 1])
    above, side = paths.subplots(1, 2)
    line = plots.path_view(above, evaluation, plots.ABOVE)
    plots.path_view(side, evaluation, plots.SIDE)
    if side.get_legend() is not None:
        side.get_legend().remove()
    if line is not None:
        bar = paths.colorbar(line, ax=[above, side], fraction=0.03, pad=0.02, label='distance to the truth (cm)')
        bar.outline.set_visible(False)
    plots.position_error(right.subplots(), evaluation)


def _over_time(figure: Figure, evaluation: Evaluation) -> None:
    plots.coordinates_over_time(figure.subplots(3, 1, sharex=True), evaluation)


def _scores(figure: Figure, evaluation: Evaluation) -> None:
    psnr, depth = figure.subplots(1, 2)
    plots.image_scores(psnr, depth, evaluation)
    psnr.tick_params(labelbottom=True)
    psnr.set_xlabel('time (s)' if evaluation.images else '')


def _stages(figure: Figure, evaluation: Evaluation) -> None:
    times, size = figure.subplots(1, 2)
    plots.stage_times(times, evaluation)
    plots.map_size(size, evaluation)


# --- pictures ---


def _samples(evaluation: Evaluation) -> Iterator[str]:
    samples = evaluation.images.samples if evaluation.images else ()
    for sample in samples:
        time_s = plots.seconds(evaluation, np.array([sample.frame.stamp_ns]))[0]
        yield _sample(sample, f'{sample.title} frame, at {time_s:.2f} s')
    for sample in evaluation.novel.samples if evaluation.novel else ():
        holes = ', with holes' if sample.scores.has_holes else ''
        yield _sample(sample, f'{sample.title} novel view{holes}')


def _sample(sample: Sample, title: str) -> str:
    panels, scores = plots.Panels.of(sample), sample.scores.scores
    low, high = panels.depth_norm.vmin, panels.depth_norm.vmax
    pictures = [
        ('colour', _jpeg(sample.frame.rgb)),
        ('rendered', _jpeg(np.uint8(np.rint(sample.rgb * 255)))),
        (f'difference, 0 to {plots.COLOR_DIFFERENCE_LIMIT:g}',
         _colored(panels.rgb_difference, plots.DIFFERENCE_COLORS, Normalize(0, plots.COLOR_DIFFERENCE_LIMIT))),
        ('silhouette, 0 to 1', _colored(sample.silhouette, matplotlib.colormaps['gray'], Normalize(0, 1))),
        (f'depth, {low:.2f} to {high:.2f} m', _colored(panels.reading_m, plots.DEPTH_COLORS, panels.depth_norm)),
        ('rendered depth', _colored(panels.rendered_m, plots.DEPTH_COLORS, panels.depth_norm)),
        (f'difference, 0 to {panels.depth_difference_norm.vmax:g} cm',
         _colored(panels.depth_difference_cm, plots.DIFFERENCE_COLORS, panels.depth_difference_norm)),
    ]  # fmt: skip
    known = [] if scores.psnr_db is None else [f'{scores.psnr_db:.1f} dB', f'depth L1 {scores.depth_l1_m * 100:.1f} cm']
    figures = ''.join(
        f'<figure><img src="{source}" alt="{escape(name)}"><figcaption>{escape(name)}</figcaption></figure>'
        for name, source in pictures
    )
    heading = ' · '.join([title, *known])
    return f'<h3>{escape(heading)}</h3><div class="pictures">{figures}</div>'


def _jpeg(rgb: np.ndarray) -> str:
    _, data = cv2.imencode('.jpg', np.ascontiguousarray(rgb[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return _data_uri('image/jpeg', data.tobytes())


def _colored(values: np.ndarray, colors: matplotlib.colors.Colormap, norm: Normalize) -> str:
    rgb = colors(norm(np.ma.masked_invalid(values)), bytes=True)[..., :3]
    _, data = cv2.imencode('.png', np.ascontiguousarray(rgb[..., ::-1]))
    return _data_uri('image/png', data.tobytes())


def _data_uri(kind: str, data: bytes) -> str:
    return f'data:{kind};base64,{base64.b64encode(data).decode("ascii")}'


# --- tables ---


def _timings(metrics: Metrics) -> str:
    if not metrics.timings_ms:
        return _nothing('No times recorded.')
    rows = ''.join(
        f'<tr><td>{escape(stage)}</td><td class="n">{times.median:.1f}</td><td class="n">{times.p95:.1f}</td></tr>'
        for stage, times in metrics.timings_ms.items()
    )
    head = '<tr><th>stage</th><th class="n">median ms</th><th class="n">95 % below ms</th></tr>'
    return f'<table class="narrow">{head}{rows}</table>'


def _metrics(metrics: Metrics) -> Iterator[str]:
    """The groups of which at least one number is known."""
    for heading, descriptions in DESCRIPTIONS.items():
        if any(metrics.values()[description.name] is not None for description in descriptions):
            yield f'<tr class="group"><th colspan="4">{escape(heading)}</th></tr>'
            yield from (_metric(description, metrics) for description in descriptions)


def _metric(description: Description, metrics: Metrics) -> str:
    is_known = metrics.values()[description.name] is not None
    unit = f' <span>{escape(description.unit)}</span>' if description.unit and is_known else ''
    note = metrics.notes.get(description.name)
    meaning = escape(description.meaning) + (f' <i>Not known: {escape(note)}</i>' if note else '')
    return (
        f'<tr><td>{escape(description.label)}</td><td class="n">{escape(description.text(metrics))}{unit}</td>'
        f'<td>{meaning}</td><td><code>{escape(description.name)}</code></td></tr>'
    )


def _config(config: SlamConfig) -> Iterator[str]:
    values = flat_values(config)
    for setting in settings():
        value = values[setting.name]
        changed = ' class="changed"' if value != setting.default else ''
        unit = f' {setting.unit}' if setting.unit else ''
        yield (
            f'<tr{changed}><td><code>{escape(setting.name)}</code></td><td class="n">{escape(f"{value}{unit}")}</td>'
            f'<td>{escape(setting.help)}</td></tr>'
        )


def _environment(evaluation: Evaluation) -> Iterator[str]:
    run = evaluation.run
    camera = run.camera
    rows = {
        'program': run.description.program,
        'source': run.description.source.path if run.description.source else 'live topics',
        'camera': f'{camera.width}x{camera.height}, f {camera.fx:.1f} {camera.fy:.1f}' if camera else 'not known',
        'commit': run.commit or 'not known',
        **{f'machine: {name}': value for name, value in run.machine.items()},
        **{f'version: {name}': value or 'not installed' for name, value in run.versions.items()},
        'report drawn by commit': provenance.commit() or 'not known',
    }
    for name, value in rows.items():
        yield f'<tr><td>{escape(name)}</td><td>{escape(str(value))}</td></tr>'
