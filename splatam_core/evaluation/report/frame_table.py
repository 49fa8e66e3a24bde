"""``scores.csv``: what each frame scored, one line a view."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

from splatam_core.atomic_io import replaced
from splatam_core.evaluation.images import FrameScores
from splatam_core.evaluation.score import Evaluation
from splatam_core.geometry.trajectory import stamp_text
from splatam_core.runs.metrics import ImageScores, OriginalScores

KINDS = ('frame', 'held out', 'novel')
SCORES = (*ImageScores.__dataclass_fields__, *(f'splatam_{name}' for name in OriginalScores.__dataclass_fields__))
HEADER = ('stamp', 'kind', 'position_error_m', 'hole_share', 'has_holes', *SCORES)


def write_frame_table(evaluation: Evaluation, path: Path) -> None:
    """Write the table of a run; one that is there is replaced once the new one is complete.

    Columns: the stamp in seconds; the kind of view, ``frame``, ``held out`` of the map, or ``novel``; the distance of
    its camera centre to the truth after alignment; the share of its pixels that have a reading and see no map, and
    whether that is too much for the novel-view protocol; then the scores of ``metrics.json``. What is not known is empty.
    """
    with replaced(path) as temporary, temporary.open('w', newline='', encoding='utf-8') as file:
        writer = csv.writer(file, lineterminator='\n')
        writer.writerow(HEADER)
        writer.writerows(_rows(evaluation))


def _rows(evaluation: Evaluation) -> Iterator[list[str]]:
    errors_m: dict[int, float] = {}
    if evaluation.truth is not None:
        error = evaluation.truth.error
        errors_m = dict(zip(error.stamps_ns.tolist(), error.errors_m.tolist()))
    frame, held_out, novel = KINDS
    if evaluation.images is not None:
        apart = {view.stamp_ns for view in evaluation.images.held_out}
        views = {view.stamp_ns: view for view in (*evaluation.images.frames, *evaluation.images.held_out)}
        for stamp_ns, view in sorted(views.items()):
            yield _row(view, held_out if stamp_ns in apart else frame, errors_m.get(stamp_ns))
    if evaluation.novel is not None:
        for view in sorted((*evaluation.novel.frames, *evaluation.novel.with_holes), key=lambda view: view.stamp_ns):
            yield _row(view, novel, None)


def _row(view: FrameScores, kind: str, error_m: float | None) -> list[str]:
    values = [error_m, view.hole_share, int(view.has_holes), *asdict(view.scores).values(), *asdict(view.original).values()]
    return [stamp_text(view.stamp_ns), kind, *('' if value is None else f'{value:.6g}' for value in values)]
