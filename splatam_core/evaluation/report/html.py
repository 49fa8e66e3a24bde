"""``report.html``: the results of a run on one page, without other files or a network, for light and dark screens."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from splatam_core.atomic_io import replace_text
from splatam_core.config import flat_values, settings
from splatam_core.evaluation.report import plots
from splatam_core.evaluation.report.descriptions import BY_NAME, DESCRIPTIONS
from splatam_core.evaluation.report.picture import headline, number_text, subtitle
from splatam_core.evaluation.report.tables import environment
from splatam_core.evaluation.report.theme import DARK, LIGHT, Theme
from splatam_core.evaluation.results import Evaluation, Sample
from splatam_core.runs import provenance
from splatam_core.runs.layout import VIEWER_PICTURE
from splatam_core.runs.metrics import Metrics

TEMPLATE = 'page.html'
JPEG_QUALITY = 88
MAX_PICTURE_BYTES = 1 << 24
Draw = Callable[[Figure, Evaluation, Theme], None]


@dataclass(frozen=True, slots=True)
class Chart:
    """A chart, drawn once for light and once for dark screens, as ``data:`` addresses of SVG images."""

    name: str
    light: str
    dark: str


@dataclass(frozen=True, slots=True)
class Picture:
    """An image with its caption, as a ``data:`` address."""

    caption: str
    address: str


@dataclass(frozen=True, slots=True)
class SampleRow:
    """The images of one sample frame and their heading."""

    heading: str
    pictures: tuple[Picture, ...]


@dataclass(frozen=True, slots=True)
class Number:
    """A row of the table of all numbers. The value is an en dash if it is not known, and the note may say why."""

    name: str
    label: str
    value: str
    unit: str
    meaning: str
    note: str


@dataclass(frozen=True, slots=True)
class SettingRow:
    """A row of the table of settings."""

    name: str
    value: str
    help: str
    is_changed: bool


def write_html(evaluation: Evaluation, path: Path) -> None:
    """Write the page of a run. An existing page is replaced only when the new one is complete."""
    replace_text(path, html_report(evaluation))


def html_report(evaluation: Evaluation) -> str:
    """Return the page as text."""
    metrics = evaluation.metrics
    return environment().get_template(TEMPLATE).render(
        title=evaluation.run.path.resolve().name,
        subtitle=subtitle(evaluation),
        opening=_opening(evaluation.run.path / VIEWER_PICTURE),
        light=asdict(LIGHT),
        dark=asdict(DARK),
        headline=headline(evaluation),
        notes={BY_NAME[name].label if name in BY_NAME else name: why for name, why in metrics.notes.items()},
        paths=_chart(evaluation, 'paths', _draw_paths, (11.5, 4.0)),
        over_time=_chart(evaluation, 'path over time', _draw_over_time, (11.5, 3.4)),
        samples=list(_samples(evaluation)),
        scores=_chart(evaluation, 'scores of each frame', _draw_scores, (11.5, 3.2)),
        stages=_chart(evaluation, 'time per frame and map size', _draw_stages, (11.5, 3.4)),
        timings=metrics.timings_ms,
        groups=dict(_number_groups(metrics)),
        settings=list(_settings(evaluation)),
        provenance=_provenance(evaluation),
    )  # fmt: skip


def _opening(path: Path) -> str | None:
    """Returns the address of the picture of the viewer; None if there is none."""
    if not path.is_file() or not 0 < path.stat().st_size <= MAX_PICTURE_BYTES:
        return None
    image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR)
    return None if image is None else _jpeg(np.asarray(image[:, :, ::-1], np.uint8))


# --- charts ---


def _chart(evaluation: Evaluation, name: str, draw: Draw, size_in: tuple[float, float]) -> Chart:
    light, dark = (_figure(evaluation, draw, size_in, theme) for theme in (LIGHT, DARK))
    light_address = _svg(light, LIGHT)  # lays the axes out, which takes most of the time
    _place_alike(dark, light)
    return Chart(name, light_address, _svg(dark, DARK))


def _figure(evaluation: Evaluation, draw: Draw, size_in: tuple[float, float], theme: Theme) -> Figure:
    with matplotlib.rc_context(theme.style()):
        figure = Figure(figsize=size_in, facecolor='none', layout='constrained')
        FigureCanvasAgg(figure)
        draw(figure, evaluation, theme)
    return figure


def _place_alike(figure: Figure, laid_out: Figure) -> None:
    figure.set_layout_engine('none')
    for axes, model in zip(figure.axes, laid_out.axes, strict=True):
        axes.set_position(model.get_position(original=True))


def _svg(figure: Figure, theme: Theme) -> str:
    """Returns the ``data:`` address of a figure's SVG; the same figure gives the same text."""
    buffer = io.BytesIO()
    with matplotlib.rc_context({**theme.style(), 'svg.hashsalt': 'report'}):
        FigureCanvasSVG(figure).print_svg(buffer, metadata={'Date': None, 'Creator': None})  # savefig would draw everything twice
    return data_address('image/svg+xml', buffer.getvalue())


def _draw_paths(figure: Figure, evaluation: Evaluation, theme: Theme) -> None:
    paths, right = figure.subfigures(1, 2, squeeze=False, width_ratios=[2.2, 1])[0]
    above, side = paths.subplots(1, 2)
    line = plots.path_view(above, evaluation, theme, plots.ABOVE)
    plots.path_view(side, evaluation, theme, plots.SIDE)
    if side.get_legend() is not None:
        side.get_legend().remove()
    if line is not None:
        bar = paths.colorbar(line, ax=[above, side], fraction=0.03, pad=0.02, label='distance to the ground truth (cm)')
        bar.outline.set_visible(False)
    plots.position_error(right.subplots(), evaluation, theme)


def _draw_over_time(figure: Figure, evaluation: Evaluation, theme: Theme) -> None:
    plots.coordinates_over_time(figure.subplots(3, 1, sharex=True), evaluation, theme)


def _draw_scores(figure: Figure, evaluation: Evaluation, theme: Theme) -> None:
    psnr, depth = figure.subplots(1, 2)
    plots.image_scores(psnr, depth, evaluation, theme)
    psnr.tick_params(labelbottom=True)
    psnr.set_xlabel('time (s)' if evaluation.images else '')


def _draw_stages(figure: Figure, evaluation: Evaluation, theme: Theme) -> None:
    times, size = figure.subplots(1, 2)
    plots.stage_times(times, evaluation, theme)
    plots.map_size(size, evaluation, theme)


# --- pictures ---


def _samples(evaluation: Evaluation) -> Iterator[SampleRow]:
    for sample in evaluation.images.samples if evaluation.images else ():
        time_s = plots.seconds(evaluation, np.array([sample.frame.stamp_ns]))[0]
        yield _sample_row(sample, f'{sample.title} frame, at {time_s:.2f} s')
    for sample in evaluation.novel.samples if evaluation.novel else ():
        holes = ', with holes' if sample.scores.has_holes else ''
        yield _sample_row(sample, f'{sample.title} novel view{holes}')


def _sample_row(sample: Sample, title: str) -> SampleRow:
    scores = sample.scores.scores
    known = []
    if scores.psnr_db is not None:
        known = [f'{number_text(scores.psnr_db, 1, 1)} dB', f'depth L1 {number_text(scores.depth_l1_m, 100, 1)} cm']
    return SampleRow(' · '.join([title, *known]), tuple(_pictures(sample)))


def _pictures(sample: Sample) -> Iterator[Picture]:
    panels, gray = plots.Panels.of(sample), matplotlib.colormaps['gray']
    depth_norm, depth_difference_norm = panels.depth_norm, panels.depth_difference_norm
    color_limit, colors = plots.COLOR_DIFFERENCE_LIMIT, plots.DIFFERENCE_COLORS
    depth_caption = f'depth, {depth_norm.vmin:.2f} to {depth_norm.vmax:.2f} m'
    difference_caption = f'difference, 0 to {depth_difference_norm.vmax:g} cm'
    yield Picture('colour', _jpeg(sample.frame.rgb))
    yield Picture('rendered', _jpeg(np.rint(sample.rgb * 255).astype(np.uint8)))
    yield Picture(f'difference, 0 to {color_limit:g}', _png(panels.rgb_difference, colors, Normalize(0, color_limit)))
    yield Picture('silhouette, 0 to 1', _png(sample.silhouette, gray, Normalize(0, 1)))
    yield Picture(depth_caption, _png(panels.reading_m, plots.DEPTH_COLORS, depth_norm))
    yield Picture('rendered depth', _png(panels.rendered_m, plots.DEPTH_COLORS, depth_norm))
    yield Picture(difference_caption, _png(panels.depth_difference_cm, colors, depth_difference_norm))


def _jpeg(rgb: NDArray[np.uint8]) -> str:
    _, data = cv2.imencode('.jpg', np.ascontiguousarray(rgb[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return data_address('image/jpeg', data.tobytes())


def _png(values: NDArray[np.floating], colors: Colormap, norm: Normalize) -> str:
    """Colour an image [H, W]; NaN gets the colour map's colour for missing values."""
    rgb = np.asarray(colors(norm(np.ma.masked_invalid(values)), bytes=True))[..., :3]
    _, data = cv2.imencode('.png', np.ascontiguousarray(rgb[..., ::-1]))
    return data_address('image/png', data.tobytes())


def data_address(kind: str, data: bytes) -> str:
    """Return an address that contains what it leads to."""
    return f'data:{kind};base64,{base64.b64encode(data).decode("ascii")}'


# --- tables ---


def _number_groups(metrics: Metrics) -> Iterator[tuple[str, list[Number]]]:
    """Yield heading and rows of each group in which at least one number is known."""
    values = metrics.values()
    for heading, descriptions in DESCRIPTIONS.items():
        if all(values[description.name] is None for description in descriptions):
            continue
        yield (
            heading,
            [
                Number(
                    name=description.name,
                    label=description.label,
                    value=description.text(metrics),
                    unit=description.unit if values[description.name] is not None else '',
                    meaning=description.meaning,
                    note=metrics.notes.get(description.name, ''),
                )
                for description in descriptions
            ],
        )


def _settings(evaluation: Evaluation) -> Iterator[SettingRow]:
    values = flat_values(evaluation.run.config)
    for setting in settings():
        value = values[setting.name]
        yield SettingRow(setting.name, f'{value} {setting.unit or ""}'.rstrip(), setting.help, value != setting.default)


def _provenance(evaluation: Evaluation) -> dict[str, str]:
    """Return what the run was made from and with, by name."""
    run = evaluation.run
    camera = run.camera
    return {
        'program': run.description.program,
        'source': run.description.source.path if run.description.source else 'live topics',
        'camera': f'{camera.width}x{camera.height}, f {camera.fx:.1f} {camera.fy:.1f}' if camera else 'not known',
        'commit': run.commit or 'not known',
        **{f'machine: {name}': str(value) for name, value in run.machine.items()},
        **{f'version: {name}': str(value or 'not installed') for name, value in run.versions.items()},
        'report drawn by commit': provenance.commit() or 'not known',
    }
