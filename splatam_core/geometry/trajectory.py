"""Camera trajectories: poses over time, their interpolation, and their text form.

The text form is the TUM format, ``stamp tx ty tz qx qy qz qw`` per line, camera to world, stamps in seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatam_core.errors import DatasetError
from splatam_core.geometry import se3

MAX_GROUND_TRUTH_GAP_NS = 500_000_000
"""A stamp between two true poses further apart than this has no true pose: frames there are not scored."""

STAMP_ROUNDING_NS = 1_000_000
"""A stamp this close to a true pose has that pose, even outside the trajectory's span: files round their stamps."""


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


def stamp_text(stamp_ns: int) -> str:
    """Returns seconds with nine decimals, which is exact."""
    return f'{stamp_ns // 1_000_000_000}.{stamp_ns % 1_000_000_000:09d}'


def stamp_from_text(text: str) -> int:
    """Returns the nanoseconds of a decimal number of seconds, exactly.

    Raises:
        ValueError: the text is not a finite decimal number.
    """
    try:
        return int((Decimal(text) * 1_000_000_000).to_integral_value())
    except (InvalidOperation, OverflowError):
        raise ValueError(f"'{text}' is not a number of seconds") from None


def pose_line(stamp_ns: int, T_world_cam: NDArray[np.float64]) -> str:
    """Returns one line of a TUM trajectory, without a newline."""
    q = se3.quaternion_from_rotation(T_world_cam[:3, :3])
    numbers = [*T_world_cam[:3, 3], q[1], q[2], q[3], q[0]]
    return ' '.join([stamp_text(stamp_ns), *(f'{number:.9f}' for number in numbers)])


def read_trajectory(path: Path) -> Trajectory:
    """Reads a TUM trajectory; lines that start with ``#`` are comments.

    Raises:
        DatasetError: the file cannot be read, a line is not eight numbers, or the stamps do not increase.
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
