"""One frame of a run: its line in ``trajectory.txt`` and its row in ``frames.csv``, written and read."""

from __future__ import annotations

import csv
from dataclasses import dataclass, fields
from pathlib import Path

from splatam_core.geometry.trajectory import pose_line, stamp_from_text, stamp_text
from splatam_core.types import FrameResult, StageTimings, Status

STAGES = tuple(entry.name for entry in fields(StageTimings))
LOST = '# lost '
"""Begins the line of a lost frame in ``trajectory.txt``; for other programs the line is a comment."""
CSV_HEADER = [
    'stamp', 'status', 'is_keyframe', 'num_gaussians', 'visible_fraction', 'inlier_fraction', 'process_ms', 'decode_ms',
    *(f'{stage}_ms' for stage in STAGES), 'reason',
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class FrameRecord:
    """One frame of a run, as in ``frames.csv``.

    Attributes:
        stamp_ns: the frame's stamp.
        status: initialized, tracked or lost.
        is_keyframe: True if the frame was kept for mapping.
        num_gaussians: size of the map after the frame.
        visible_fraction: see ``FrameResult``.
        inlier_fraction: see ``FrameResult``.
        process_ms: wall time in SLAM.
        decode_ms: wall time to read and decode the frame; None where another thread did that during SLAM.
        timings: wall time of each stage.
        reason: why the frame is lost; empty otherwise.
    """

    stamp_ns: int
    status: Status
    is_keyframe: bool
    num_gaussians: int
    visible_fraction: float
    inlier_fraction: float
    process_ms: float
    decode_ms: float | None
    timings: StageTimings
    reason: str

    @classmethod
    def of(cls, result: FrameResult, process_s: float, decode_s: float | None) -> FrameRecord:
        """Returns the record of a result.

        Args:
            result: of ``Slam.process``.
            process_s: wall time in ``Slam.process``.
            decode_s: wall time to read and decode the frame; None where another thread did that during SLAM.
        """
        return cls(
            stamp_ns=result.stamp_ns,
            status=result.status,
            is_keyframe=result.is_keyframe,
            num_gaussians=result.num_gaussians,
            visible_fraction=result.visible_fraction,
            inlier_fraction=result.inlier_fraction,
            process_ms=process_s * 1e3,
            decode_ms=None if decode_s is None else decode_s * 1e3,
            timings=result.timings,
            reason=result.reason,
        )

    def csv_row(self) -> list[str]:
        """Returns the cells below ``CSV_HEADER``."""
        times_ms = [getattr(self.timings, stage) for stage in STAGES]
        return [
            stamp_text(self.stamp_ns), self.status.value, str(int(self.is_keyframe)), str(self.num_gaussians),
            f'{self.visible_fraction:.4f}', f'{self.inlier_fraction:.4f}', f'{self.process_ms:.3f}',
            '' if self.decode_ms is None else f'{self.decode_ms:.3f}', *(f'{time_ms:.3f}' for time_ms in times_ms),
            self.reason,
        ]  # fmt: skip


def trajectory_line(result: FrameResult) -> str:
    """Returns a frame's line in ``trajectory.txt``, without its newline."""
    if result.T_world_cam is None:
        return LOST + stamp_text(result.stamp_ns)
    return pose_line(result.stamp_ns, result.T_world_cam)


def read_lost(path: Path) -> tuple[int, ...]:
    """Returns the stamps (ns) of the lost frames in a ``trajectory.txt``.

    Raises:
        OSError: the file cannot be read.
        ValueError: a stamp is no number.
    """
    lines = path.read_text().splitlines()
    return tuple(stamp_from_text(line.removeprefix(LOST)) for line in lines if line.startswith(LOST))


def read_frame_records(path: Path) -> tuple[FrameRecord, ...]:
    """Reads a ``frames.csv``; returns no records where there is no such file.

    Raises:
        OSError: the file cannot be read.
        KeyError, TypeError, ValueError: a column is missing, or a cell has no value of its column.
    """
    if not path.exists():
        return ()
    with path.open(newline='') as file:
        return tuple(_frame_record(row) for row in csv.DictReader(file))


def _frame_record(row: dict[str, str]) -> FrameRecord:
    return FrameRecord(
        stamp_ns=stamp_from_text(row['stamp']),
        status=Status(row['status']),
        is_keyframe=row['is_keyframe'] == '1',
        num_gaussians=int(row['num_gaussians']),
        visible_fraction=float(row.get('visible_fraction') or row['sure_fraction']),  # the column's name in 0.1.0
        inlier_fraction=float(row['inlier_fraction']),
        process_ms=float(row['process_ms']),
        decode_ms=float(row['decode_ms']) if row['decode_ms'] else None,
        timings=StageTimings(*(float(row[f'{stage}_ms']) for stage in STAGES)),
        reason=row['reason'],
    )
