"""Trajectories as files: the TUM format, ``stamp tx ty tz qx qy qz qw``, camera to world."""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatam_core import se3
from splatam_core.errors import DatasetError
from splatam_core.types import Trajectory


def stamp_text(stamp_ns: int) -> str:
    """Seconds with nine decimals; no nanosecond is lost."""
    return f'{stamp_ns // 1_000_000_000}.{stamp_ns % 1_000_000_000:09d}'


def stamp_from_text(text: str) -> int:
    """Nanoseconds of a decimal number of seconds, exactly.

    Raises:
        ValueError: the text is not a finite decimal number.
    """
    try:
        return int((Decimal(text) * 1_000_000_000).to_integral_value())
    except (InvalidOperation, OverflowError):
        raise ValueError(f"'{text}' is not a number of seconds") from None


def pose_line(stamp_ns: int, T_world_cam: NDArray[np.float64]) -> str:
    """One line of a TUM trajectory, without its newline."""
    q = se3.quaternion_from_rotation(T_world_cam[:3, :3])
    numbers = [*T_world_cam[:3, 3], q[1], q[2], q[3], q[0]]
    return ' '.join([stamp_text(stamp_ns), *(f'{number:.9f}' for number in numbers)])


def read_trajectory(path: Path) -> Trajectory:
    """Read a TUM trajectory; lines that start with ``#`` are comments.

    Raises:
        DatasetError: the file cannot be read, or a line is not eight numbers in increasing time.
    """
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f'{path}: cannot be read: {error}') from None
    rows = [
        _parse_line(path, number, line)
        for number, line in enumerate(lines, 1)
        if line.strip() and not line.lstrip().startswith('#')
    ]
    return trajectory_from_rows(rows, str(path))


def _parse_line(path: Path, number: int, line: str) -> tuple[int, list[float]]:
    fields = line.replace(',', ' ').split()
    try:
        stamp_ns, values = stamp_from_text(fields[0]), [float(field) for field in fields[1:]]
        if len(values) != 7 or not np.isfinite(values).all() or not any(values[3:]):
            raise ValueError
    except ValueError:
        raise DatasetError(
            f"{path}:{number}: expected 'stamp tx ty tz qx qy qz qw' with a non-zero quaternion, got '{line.strip()}'"
        ) from None
    return stamp_ns, values


def trajectory_from_rows(rows: Sequence[tuple[int, Sequence[float]]], name: str) -> Trajectory:
    """A trajectory from (stamp_ns, [tx ty tz qx qy qz qw]) rows.

    Raises:
        DatasetError: the stamps do not increase.
    """
    stamps = np.array([stamp for stamp, _ in rows], dtype=np.int64)
    if (np.diff(stamps) <= 0).any():
        at = int(np.argmax(np.diff(stamps) <= 0)) + 1
        raise DatasetError(f'{name}: stamps must increase, but pose {at + 1} at {stamp_text(int(stamps[at]))} does not')
    values = np.array([value for _, value in rows], dtype=np.float64).reshape(-1, 7)
    return Trajectory(stamps, se3.compose(values[:, [6, 3, 4, 5]], values[:, :3]))
