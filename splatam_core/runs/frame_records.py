"""One frame of a run: its line in ``trajectory.txt`` and its row in ``frames.csv``, written and read."""

from __future__ import annotations

import csv
import logging
import math
from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from splatam_core.atomic_io import open_regular
from splatam_core.errors import one_line
from splatam_core.geometry.trajectory import Trajectory, pose_line, stamp_from_text, stamp_text, trajectory_from_rows
from splatam_core.types import FrameResult, PoseCovariance, StageTimings, Status

_log = logging.getLogger(__name__)

STAGES = tuple(entry.name for entry in fields(StageTimings))
_FIRST_STAGES = tuple(stage for stage in STAGES if stage != 'graph')  # 0.1.0 knew these
LOST = '# lost '
"""Begins the line of a lost frame in ``trajectory.txt``; for other programs the line is a comment."""
AXES = 'x', 'y', 'z', 'rx', 'ry', 'rz'
UPPER = tuple((row, column) for row in range(6) for column in range(row, 6))
"""The entries of a symmetric [6, 6] matrix that are written."""
CSV_HEADER = [
    'stamp', 'status', 'is_keyframe', 'num_gaussians', 'visible_fraction', 'inlier_fraction', 'process_ms', 'decode_ms',
    *(f'{stage}_ms' for stage in _FIRST_STAGES), 'reason',
    'num_held', 'drift_position_m', 'drift_rotation_rad', *(f'cov_{AXES[row]}_{AXES[column]}' for row, column in UPPER),
    'is_relocalised', 'graph_ms',
]  # fmt: skip
"""Columns are only ever added at the end: a folder of an earlier version can then be continued."""


@dataclass(frozen=True, slots=True)
class FrameRecord:
    """One frame of a run, as in ``frames.csv``.

    Attributes:
        stamp_ns: the frame's stamp.
        status: initialized, tracked, uncertain or lost.
        is_keyframe: True if the frame was kept for mapping.
        num_gaussians: size of the map after the frame.
        visible_fraction: see ``FrameResult``.
        inlier_fraction: see ``FrameResult``.
        process_ms: wall time in SLAM.
        decode_ms: wall time to read and decode the frame; None where another thread did that during SLAM.
        timings: wall time of each stage.
        reason: why the frame is uncertain or lost; empty otherwise.
        covariance: see ``FrameResult``.
        num_held: see ``FrameResult``.
        is_relocalised: see ``FrameResult``.
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
    covariance: PoseCovariance | None = None
    num_held: int = 0
    is_relocalised: bool = False

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
            covariance=result.covariance,
            num_held=result.num_held,
            is_relocalised=result.is_relocalised,
        )

    def csv_row(self) -> list[str]:
        """Returns the cells below ``CSV_HEADER``."""
        times_ms = [getattr(self.timings, stage) for stage in _FIRST_STAGES]
        return [
            stamp_text(self.stamp_ns), self.status.value, str(int(self.is_keyframe)), str(self.num_gaussians),
            f'{self.visible_fraction:.4f}', f'{self.inlier_fraction:.4f}', f'{self.process_ms:.3f}',
            '' if self.decode_ms is None else f'{self.decode_ms:.3f}', *(f'{time_ms:.3f}' for time_ms in times_ms),
            self.reason, str(self.num_held), *_covariance_cells(self.covariance), str(int(self.is_relocalised)),
            f'{self.timings.graph:.3f}',
        ]  # fmt: skip


def _covariance_cells(covariance: PoseCovariance | None) -> list[str]:
    """Returns the cells of a covariance, the sum of both kinds of error; empty where there is none."""
    if covariance is None:
        return [''] * (2 + len(UPPER))
    entries = [covariance.total[entry] for entry in UPPER]
    return [f'{number:.6g}' for number in (covariance.drift_position_m, covariance.drift_rotation_rad, *entries)]


def trajectory_line(result: FrameResult) -> str:
    """Returns a frame's line in ``trajectory.txt``, without its newline."""
    if result.T_world_cam is None:
        return LOST + stamp_text(result.stamp_ns)
    return pose_line(result.stamp_ns, result.T_world_cam)


def complete_lines(path: Path) -> list[str]:
    """Returns the lines of a file that is written line by line. A last line that a crash cut off is left out, with a warning.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is no text.
    """
    with open_regular(path) as file:
        text = file.read().decode('utf-8')
    whole = text.rstrip('\0')  # after a power cut a file may end in zeros
    end = whole.rfind('\n') + 1
    if end < len(text):
        _log.warning('%s: its last line is incomplete and left out: was the writer stopped by force?', path)
    return whole[:end].split('\n')[:-1]


def is_frame(line: str) -> bool:
    """Returns True if a line of a ``trajectory.txt`` is a frame, tracked or lost."""
    return line.startswith(LOST) or bool(line.strip() and not line.lstrip().startswith('#'))


def read_poses(lines: Iterable[str], name: str) -> Trajectory:
    """Returns the poses in the lines of a ``trajectory.txt``.

    Raises:
        DatasetError: the stamps do not increase.
        ValueError: a line is no pose.
    """
    rows = []
    for number, line in enumerate(lines, 1):
        if line.strip() and not line.lstrip().startswith('#'):
            try:
                stamp, *values = line.split()
                row = _stamp(stamp), [_number(value) for value in values]
                if len(row[1]) != 7 or not any(row[1][3:]):
                    raise ValueError
            except ValueError:
                raise ValueError(
                    f"{name}:{number}: expected 'stamp tx ty tz qx qy qz qw' with a non-zero quaternion, got '{one_line(line)}'"
                ) from None
            rows.append(row)
    return trajectory_from_rows(rows, name)


def read_lost(lines: Iterable[str]) -> tuple[int, ...]:
    """Returns the stamps (ns) of the lost frames in the lines of a ``trajectory.txt``.

    Raises:
        ValueError: a stamp is no number of seconds.
    """
    return tuple(_stamp(line.removeprefix(LOST)) for line in lines if line.startswith(LOST))


def read_frame_records(path: Path) -> tuple[FrameRecord, ...]:
    """Reads a ``frames.csv``; returns no records where there is no such file.

    Raises:
        OSError: the file cannot be read.
        csv.Error, KeyError, TypeError, ValueError: a column is missing, or a cell has no value of its column.
    """
    if not path.exists():
        return ()
    lines = (f'{line}\n' for line in complete_lines(path))
    return tuple(_frame_record(row) for row in csv.DictReader(lines))


def _stamp(text: str) -> int:
    stamp_ns = stamp_from_text(text)
    if abs(stamp_ns) >= 2**63:
        raise ValueError(f"'{text}' is no stamp: its nanoseconds need more than 64 bits")
    return stamp_ns


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"'{text}' is not finite")
    return value


def _frame_record(row: dict[str, str]) -> FrameRecord:
    return FrameRecord(
        stamp_ns=_stamp(row['stamp']),
        status=Status(row['status']),
        is_keyframe=row['is_keyframe'] == '1',
        num_gaussians=int(row['num_gaussians']),
        visible_fraction=_number(row.get('visible_fraction') or row['sure_fraction']),  # the column's name in 0.1.0
        inlier_fraction=_number(row['inlier_fraction']),
        process_ms=_number(row['process_ms']),
        decode_ms=_number(row['decode_ms']) if row['decode_ms'] else None,
        timings=StageTimings(**{stage: _number(row.get(f'{stage}_ms') or '0') for stage in STAGES}),
        reason=row['reason'],
        covariance=_covariance(row),
        num_held=int(row.get('num_held') or 0),
        is_relocalised=row.get('is_relocalised') == '1',
    )


def _covariance(row: dict[str, str]) -> PoseCovariance | None:
    """Returns the covariance in a row; None where there is none, as in folders of 0.1.0."""
    if not row.get('drift_position_m'):
        return None
    drift_m, drift_rad = _number(row['drift_position_m']), _number(row['drift_rotation_rad'])
    total = np.zeros((6, 6))
    for i, k in UPPER:
        total[i, k] = total[k, i] = _number(row[f'cov_{AXES[i]}_{AXES[k]}'])
    return PoseCovariance(total - np.diag(np.repeat([drift_m**2, drift_rad**2], 3)), drift_m, drift_rad)
