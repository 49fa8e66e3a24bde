"""Camera trajectories: poses over time, their interpolation, and their text form.

The text form is the TUM format, ``stamp tx ty tz qx qy qz qw`` per line, camera to world, stamps in seconds.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatam_core.errors import DatasetError
from splatam_core.geometry import se3
from splatam_core.geometry.stamps import SECONDS, StampUnit, guess_unit, stamp_number, stamp_text, stray_stamps
from splatam_core.geometry.stamps import stamp_from_text as stamp_from_text
from splatam_core.geometry.table_heading import named_columns
from splatam_core.text_files import read_text

MAX_GROUND_TRUTH_GAP_NS = 500_000_000
"""A stamp between two true poses further apart than this has no true pose: frames there are not scored."""

STAMP_ROUNDING_NS = 1_000_000
"""A stamp this close to a true pose has that pose, even outside the trajectory's span: files round their stamps."""

QUATERNION_LENGTHS = (1e-6, 1e6)
"""A quaternion that is shorter or longer states no rotation."""

LARGEST_POSITION_M = 1e9

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Camera poses over time.

    Attributes:
        stamps_ns: [N] int64, increasing.
        T_world_cam: [N, 4, 4] float64, camera to world.
    """

    stamps_ns: NDArray[np.int64]
    T_world_cam: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.stamps_ns)


def interpolate_poses(truth: Trajectory, stamps_ns: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Interpolates true poses: centres linearly, rotations at constant angular speed.

    Args:
        truth: N true poses.
        stamps_ns: [M] int64.

    Returns:
        T_world_cam [M, 4, 4], and [M] whether each is known: inside the trajectory's span and not in a gap.
    """
    centres, known = interpolate_centres(truth, stamps_ns)
    poses = np.tile(np.eye(4), (len(stamps_ns), 1, 1))
    for index in np.flatnonzero(known):
        poses[index, :3, :3] = _interpolated_rotation(truth, int(stamps_ns[index]))
        poses[index, :3, 3] = centres[index]
    return poses, known


def interpolate_centres(truth: Trajectory, stamps_ns: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Interpolates true camera centres linearly.

    Args:
        truth: N true poses.
        stamps_ns: [M] int64.

    Returns:
        centres_m [M, 3], and [M] whether each is known: inside the trajectory's span and not in a gap.
    """
    if len(truth) == 0:
        return np.zeros((len(stamps_ns), 3)), np.zeros(len(stamps_ns), dtype=bool)
    # Seconds since the first pose: as 64-bit floats they are exact enough, nanoseconds since the epoch are not.
    truth_s, at_s = ((stamps - truth.stamps_ns[0]) * 1e-9 for stamps in (truth.stamps_ns, stamps_ns))
    centres = np.stack([np.interp(at_s, truth_s, truth.T_world_cam[:, axis, 3]) for axis in range(3)], axis=1)
    after = np.searchsorted(truth.stamps_ns, stamps_ns)  # first true pose not before the stamp
    last = len(truth) - 1
    above, below = truth.stamps_ns[np.minimum(after, last)], truth.stamps_ns[np.clip(after - 1, 0, last)]
    inside = (stamps_ns >= truth.stamps_ns[0]) & (stamps_ns <= truth.stamps_ns[-1])
    nearest_ns = np.minimum(np.abs(above - stamps_ns), np.abs(stamps_ns - below))
    return centres, (inside & (above - below <= MAX_GROUND_TRUTH_GAP_NS)) | (nearest_ns <= STAMP_ROUNDING_NS)


def _interpolated_rotation(truth: Trajectory, stamp_ns: int) -> NDArray[np.float64]:
    after = min(int(np.searchsorted(truth.stamps_ns, stamp_ns)), len(truth) - 1)
    before = max(0, after - 1)
    R_before, R_after = truth.T_world_cam[before, :3, :3], truth.T_world_cam[after, :3, :3]
    interval_ns = int(truth.stamps_ns[after] - truth.stamps_ns[before])
    share = float(np.clip((stamp_ns - int(truth.stamps_ns[before])) / interval_ns, 0, 1)) if interval_ns else 0.0
    turn = np.zeros(6)
    turn[3:] = share * se3.rotation_vector(R_before.T @ R_after)
    return R_before @ se3.exp(turn)[:3, :3]


def pose_line(stamp_ns: int, T_world_cam: NDArray[np.float64]) -> str:
    """Returns one line of a TUM trajectory, without a newline."""
    q = se3.quaternion_from_rotation(T_world_cam[:3, :3])
    numbers = [*T_world_cam[:3, 3], q[1], q[2], q[3], q[0]]
    return ' '.join([stamp_text(stamp_ns), *(f'{number:.9f}' for number in numbers)])


def read_trajectory(path: Path) -> Trajectory:
    """Reads a TUM trajectory whose every line must be a pose; lines that start with ``#`` are comments.

    Raises:
        DatasetError: the file cannot be read, a line is no pose, or the stamps do not increase.
    """
    rows = []
    for line in _lines(path):
        if line.pose is None or not line.pose.is_known:
            raise DatasetError(line.fault(path))
        try:
            rows.append((SECONDS.stamp_ns(line.pose.stamp), line.pose.values))
        except ValueError as error:
            raise DatasetError(f'{path}:{line.number}: {error}') from None
    return trajectory_from_rows(rows, str(path))


def read_ground_truth(path: Path) -> Trajectory:
    """Reads a TUM trajectory of true poses.

    Poses that are unknown (NaN, infinite, or without rotation), lines that are no pose, further poses of the same stamp, and
    single poses with a wrong stamp are left out, and counted in a warning. Stamps may be milliseconds, microseconds or
    nanoseconds, and a heading may name the columns in another order; a warning says so.

    Raises:
        DatasetError: the file cannot be read, more than a tenth of the lines are no poses, no pose is known, or the stamps do
            not increase.
    """
    lines = _lines(path, is_table=True)
    poses = [line.pose for line in lines if line.pose is not None]
    faulty = [line for line in lines if line.pose is None]
    if too_many(len(faulty), len(lines)):
        raise DatasetError(faulty[0].fault(path))
    known = [pose for pose in poses if pose.is_known]
    if poses and not known:
        raise DatasetError(f'{path}: none of its {len(poses)} poses is known: each holds NaN, infinity or no rotation')
    stamped = _rows(path, known)
    is_stray = stray_stamps(np.array([stamp_ns for stamp_ns, _ in stamped], np.int64))
    rows = [row for row, stray in zip(stamped, is_stray, strict=True) if not stray]
    counts = {
        'no poses': len(faulty), 'unknown': len(poses) - len(known), 'of a stamp that is there already': len(known) - len(stamped),
        'with a stamp that contradicts those around it': len(stamped) - len(rows),
    }  # fmt: skip
    left_out = [f'{count} {why}' for why, count in counts.items() if count]
    if left_out:
        _log.warning('%s: of %d lines with poses these are left out: %s', path, len(lines), ', '.join(left_out))
    return trajectory_from_rows(rows, str(path))


def too_many(faults: int, total: int) -> bool:
    """Returns True if so many of the files or lines of a recording are faulty that it cannot be used: more than a tenth.

    One fault is never too many, unless there is nothing else.
    """
    return faults > 0 and (faults == total or faults > max(1, total // 10))


def warn_of_unit(unit: StampUnit, name: object) -> None:
    """Says so if stamps are no seconds."""
    if unit is not SECONDS:
        _log.warning('%s: stamps look like %s, and are read as such', name, unit.name)


def _rows(path: Path, poses: Sequence[_StatedPose]) -> list[tuple[int, Sequence[float]]]:
    """Returns (stamp_ns, [tx ty tz qx qy qz qw]) of the first pose of each stamp."""
    unit = guess_unit([pose.stamp for pose in poses])
    warn_of_unit(unit, path)
    rows: list[tuple[int, Sequence[float]]] = []
    for pose in poses:
        try:
            stamp_ns = unit.stamp_ns(pose.stamp)
        except ValueError as error:
            raise DatasetError(f'{path}: {error}') from None
        if not rows or stamp_ns != rows[-1][0]:
            rows.append((stamp_ns, pose.values))
    return rows


@dataclass(frozen=True, slots=True)
class _StatedPose:
    """The numbers of a line.

    Attributes:
        stamp: as in the file.
        values: tx ty tz qx qy qz qw.
    """

    stamp: Decimal
    values: list[float]

    @property
    def is_known(self) -> bool:
        """False if the numbers mark an unknown pose."""
        return is_pose(self.values[:3], self.values[3:])


@dataclass(frozen=True, slots=True)
class _Line:
    """A line that is no comment.

    Attributes:
        number: from 1.
        text: the line.
        pose: None if there are no eight numbers in it.
    """

    number: int
    text: str
    pose: _StatedPose | None

    def fault(self, path: Path) -> str:
        """Returns what is wrong with a line that is no known pose."""
        shown = self.text.strip()[:200]
        return f"{path}:{self.number}: expected 'stamp tx ty tz qx qy qz qw' with a non-zero quaternion, got '{shown}'"


def _lines(path: Path, *, is_table: bool = False) -> list[_Line]:
    """Returns the lines of a trajectory that are no comments.

    Args:
        path: the file.
        is_table: True if a heading may name the columns, in any order; it is no line of the trajectory then.
    """
    text = read_text(path, DatasetError)
    lines = (text.replace(';', ',') if is_table else text).splitlines()
    columns = named_columns(lines) if is_table else None
    heading = 0 if columns is None else columns.line
    numbered = [(number, line) for number, line in enumerate(lines, 1) if line.strip() and not line.lstrip().startswith('#')]
    first = next((line for number, line in numbered if number != heading), '')
    if columns is None or (columns.are_in_order and _stated_pose(first) is not None):
        return [_Line(number, line, _stated_pose(line)) for number, line in numbered]
    _log.warning('%s: columns are read as line %d names them', path, heading)
    fields = [(number, line, columns.fields(line)) for number, line in numbered if number != heading]
    return [_Line(number, line, _stated_pose(' '.join(found))) for number, line, found in fields]


def _stated_pose(line: str) -> _StatedPose | None:
    fields = line.replace(',', ' ').split()
    if len(fields) != 8 and line.count(',') == 7:
        fields = [field.strip() or 'nan' for field in line.split(',')]  # a table with empty cells
    if len(fields) != 8:
        return None
    try:
        return _StatedPose(stamp_number(fields[0]), [_value(field) for field in fields[1:]])
    except ValueError:
        return None


def _value(text: str) -> float:
    return float('nan') if text.lower() in ('none', 'null', 'na', 'n/a', '-') else float(text)


def is_pose(position: Sequence[float], quaternion: Sequence[float]) -> bool:
    """Returns False for an unknown pose: it holds NaN, infinity or impossible numbers, or its quaternion has no length."""
    shortest, longest = QUATERNION_LENGTHS
    is_near = all(abs(value) <= LARGEST_POSITION_M for value in position)
    return is_near and all(abs(value) <= longest for value in quaternion) and any(abs(value) >= shortest for value in quaternion)


def trajectory_from_rows(rows: Sequence[tuple[int, Sequence[float]]], name: str) -> Trajectory:
    """Returns a trajectory of (stamp_ns, [tx ty tz qx qy qz qw]) rows. name: the source, for errors.

    Raises:
        DatasetError: the stamps do not increase.
    """
    stamps = np.array([stamp for stamp, _ in rows], dtype=np.int64)
    if (np.diff(stamps) <= 0).any():
        at = int(np.argmax(np.diff(stamps) <= 0)) + 1
        raise DatasetError(f'{name}: stamps must increase, but pose {at + 1} at {stamp_text(int(stamps[at]))} does not')
    values = np.array([value for _, value in rows], dtype=np.float64).reshape(-1, 7)
    return Trajectory(stamps, se3.compose(values[:, [6, 3, 4, 5]], values[:, :3]))
