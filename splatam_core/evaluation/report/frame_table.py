"""``scores.csv``: the scores of each frame, one line per view."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from splatam_core.atomic_io import replaced
from splatam_core.evaluation.images import FrameScores
from splatam_core.evaluation.results import Evaluation
from splatam_core.geometry.trajectory import stamp_text
from splatam_core.runs.metrics import ImageScores, OriginalScores

KINDS = ('frame', 'held out', 'novel')
SCORES = (*ImageScores.__dataclass_fields__, *(f'splatam_{name}' for name in OriginalScores.__dataclass_fields__))
HEADER = ('stamp', 'kind', 'position_error_m', 'hole_share', 'has_holes', *SCORES)


def write_frame_table(evaluation: Evaluation, path: Path) -> None:
    """Write the table of a run. An existing file is replaced only when the new one is complete.

    The columns are: the stamp in seconds; the kind of view (``frame``, ``held out`` of the map, or ``novel``); the
    distance of its camera centre to the ground truth after alignment; the share of its pixels that have a reading but
    see no map; 1 if that share exceeds the limit of the novel-view protocol, else 0; then the scores of
    ``metrics.json``. Unknown values are empty.
    """
    with replaced(path) as temporary, temporary.open('w', newline='', encoding='utf-8') as file:
        writer = csv.writer(file, lineterminator='\n')
        writer.writerow(HEADER)
        writer.writerows(_rows(evaluation))


def _rows(evaluation: Evaluation) -> Iterator[list[str]]:
    errors_m: dict[int, float] = {}
    if evaluation.trajectory is not None:
        error = evaluation.trajectory.error
        errors_m = dict(zip(error.stamps_ns.tolist(), error.errors_m.tolist()))
    frame, held_out, novel = KINDS
    if evaluation.images is not None:
        held_out_ns = {view.stamp_ns for view in evaluation.images.held_out}
        views = {view.stamp_ns: view for view in (*evaluation.images.frames, *evaluation.images.held_out)}
        for stamp_ns, view in sorted(views.items()):
            yield _row(view, held_out if stamp_ns in held_out_ns else frame, errors_m.get(stamp_ns))
    if evaluation.novel is not None:
        for view in sorted((*evaluation.novel.frames, *evaluation.novel.with_holes), key=lambda view: view.stamp_ns):
            yield _row(view, novel, None)


def _row(view: FrameScores, kind: str, error_m: float | None) -> list[str]:
    values = [error_m, view.hole_share, int(view.has_holes), *asdict(view.scores).values(), *asdict(view.original).values()]
    return [stamp_text(view.stamp_ns), kind, *('' if value is None else f'{value:.6g}' for value in values)]
