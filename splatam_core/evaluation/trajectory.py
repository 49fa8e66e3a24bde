"""Absolute (ATE) and relative (RPE) pose errors of an estimated trajectory against the ground truth.

Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012, section IV. The paper leaves two choices
open. Here the ground truth is interpolated at the frame's stamp instead of taken from the nearest sample, and the
alignment is rigid, without scale, because a depth camera measures scale. ``splatam_ate_mean_m`` is the number that
SplaTAM's own evaluation prints as ATE.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatam_core.errors import RunFolderError
from splatam_core.geometry import se3
from splatam_core.geometry.trajectory import (
    Trajectory,
    interpolate_centres,
    interpolate_poses,
    stamp_text,
)
from splatam_core.types import PoseCovariance

Indices = NDArray[np.intp]

ONE_SECOND_NS = 1_000_000_000

INTERVAL_TOLERANCE_NS = 20_000_000
"""Tolerance of the interval between two frames one second apart. At 30 Hz the nearest frame is within 17 ms."""

FALSE_M, FALSE_DEVIATIONS = 0.1, 3.0

MIN_POSES = 3
"""Fewer poses can always be aligned without error, so their ATE has no meaning."""


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryError:
    """The absolute trajectory error over the N frames that have ground truth.

    Attributes:
        rmse_m: root mean squared distance of the camera centres after alignment.
        stamps_ns: [N] int64 stamps of the frames.
        estimate_m: [N, 3] estimated camera centres, in the estimate's world.
        ground_truth_m: [N, 3] true camera centres at the same stamps, aligned to the estimate's world.
        errors_m: [N] distances between the two.
        T_estimate_ground_truth: [4, 4] the rigid alignment from the ground truth's world to the estimate's.
    """

    rmse_m: float
    stamps_ns: NDArray[np.int64]
    estimate_m: NDArray[np.float64]
    ground_truth_m: NDArray[np.float64]
    errors_m: NDArray[np.float64]
    T_estimate_ground_truth: NDArray[np.float64]


def trajectory_error(estimate: Trajectory, ground_truth: Trajectory) -> TrajectoryError:
    """Compute the absolute trajectory error.

    Args:
        estimate: online poses, camera to world.
        ground_truth: true poses in any world frame, at any stamps of the same clock.

    Raises:
        RunFolderError: fewer than three frames have ground truth at their stamp.
    """
    centres, known = interpolate_centres(ground_truth, estimate.stamps_ns)
    if known.sum() < MIN_POSES:
        raise RunFolderError(_too_few(estimate, ground_truth, int(known.sum())))
    estimate_m, true_m = estimate.T_world_cam[known, :3, 3], centres[known]
    T = align(true_m, estimate_m)
    aligned_m = true_m @ T[:3, :3].T + T[:3, 3]
    errors_m = np.linalg.norm(estimate_m - aligned_m, axis=1)
    return TrajectoryError(
        rmse_m=_rms(errors_m),
        stamps_ns=estimate.stamps_ns[known],
        estimate_m=estimate_m,
        ground_truth_m=aligned_m,
        errors_m=errors_m,
        T_estimate_ground_truth=T,
    )


def has_enough_poses(estimate: Trajectory, ground_truth: Trajectory) -> bool:
    """Returns whether enough frames have ground truth for a trajectory error."""
    _, known = interpolate_centres(ground_truth, estimate.stamps_ns)
    return int(known.sum()) >= MIN_POSES


def falsely_tracked(error: TrajectoryError, covariances: Mapping[int, PoseCovariance]) -> NDArray[np.bool_]:
    """Returns [N] which tracked frames are farther from the ground truth than 10 cm and than three standard deviations.

    Args:
        error: of the tracked frames, and of no others.
        covariances: of their poses, by stamp; a frame without one may be 10 cm off.
    """
    limits_m = [
        max(FALSE_M, FALSE_DEVIATIONS * float(np.sqrt(np.trace(covariances[stamp_ns].total[:3, :3]))))
        if stamp_ns in covariances
        else FALSE_M
        for stamp_ns in map(int, error.stamps_ns)
    ]
    return error.errors_m > np.array(limits_m)


@dataclass(frozen=True, slots=True)
class RelativePoseError:
    """The relative pose error over pairs of frames a fixed time apart.

    Attributes:
        translation_rmse_m: root mean squared translation error of the motion; None if there is no pair.
        rotation_rmse_deg: root mean squared rotation error of the motion; None if there is no pair.
        pairs: number of pairs of frames.
    """

    translation_rmse_m: float | None
    rotation_rmse_deg: float | None
    pairs: int


def relative_pose_errors(
    estimate: Trajectory, ground_truth: Trajectory, lost_ns: Collection[int] = ()
) -> tuple[RelativePoseError, RelativePoseError]:
    """Compute the relative pose error from each frame to the next, and over one second.

    Sturm et al., equation 2: ``(Q_i^-1 Q_j)^-1 (P_i^-1 P_j)`` with true poses Q and estimated poses P, without alignment.
    For the first error, frame j is the next frame with a pose; pairs with a lost frame between them are skipped. For the
    second, frame j is the frame nearest to one second later; pairs more than 20 ms off are skipped.

    Args:
        estimate: online poses.
        ground_truth: true poses, in any world frame.
        lost_ns: stamps of the lost frames.

    Returns:
        The error from frame to frame, and the error over one second.
    """
    true_poses, known = interpolate_poses(ground_truth, estimate.stamps_ns)
    stamps_ns, poses, true_poses = estimate.stamps_ns[known], estimate.T_world_cam[known], true_poses[known]
    gaps = np.array(sorted([*lost_ns, *map(int, estimate.stamps_ns[~known])]), dtype=np.int64)
    pairs = _next_frames(stamps_ns, gaps), _a_second_later(stamps_ns)
    per_frame, per_second = (_relative_pose_error(poses, true_poses, *pair) for pair in pairs)
    return per_frame, per_second


def _next_frames(stamps_ns: NDArray[np.int64], gaps_ns: NDArray[np.int64]) -> tuple[Indices, Indices]:
    before = np.searchsorted(gaps_ns, stamps_ns)
    first = np.flatnonzero(before[1:] == before[:-1])
    return first, first + 1


def _a_second_later(stamps_ns: NDArray[np.int64]) -> tuple[Indices, Indices]:
    if len(stamps_ns) == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    wanted = stamps_ns + ONE_SECOND_NS
    after = np.searchsorted(stamps_ns, wanted)
    candidates = np.clip(np.stack([after - 1, after]), 0, len(stamps_ns) - 1)  # [2, N]
    distance = np.abs(stamps_ns[candidates] - wanted)
    nearest = np.where(distance[0] <= distance[1], *candidates)
    first = np.flatnonzero(distance.min(axis=0) <= INTERVAL_TOLERANCE_NS)
    return first, nearest[first]


def _relative_pose_error(
    poses: NDArray[np.float64], true_poses: NDArray[np.float64], first: Indices, second: Indices
) -> RelativePoseError:
    if len(first) == 0:
        return RelativePoseError(None, None, 0)
    motion, true_motion = (se3.inverse(T[first]) @ T[second] for T in (poses, true_poses))
    difference = se3.inverse(true_motion) @ motion  # [K, 4, 4]
    angles = np.array([np.linalg.norm(se3.rotation_vector(R)) for R in difference[:, :3, :3]])
    translations = np.linalg.norm(difference[:, :3, 3], axis=1)
    return RelativePoseError(_rms(translations), float(np.degrees(_rms(angles))), len(first))


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))


def splatam_ate_mean_m(estimate: Trajectory, ground_truth: Trajectory) -> float:
    """Compute the number that SplaTAM's evaluation prints as "ATE RMSE".

    It is a mean, not a root mean square, and is not computed from camera centres. It takes the translation columns of
    the world-to-camera matrices, -R^T c, aligns those of the ground truth rigidly to those of the estimate, and averages
    the distances. The result depends on the origin of the world. Here the first pose with ground truth defines it.

    Raises:
        RunFolderError: fewer than three frames have ground truth at their stamp.
    """
    true_poses, known = interpolate_poses(ground_truth, estimate.stamps_ns)
    if known.sum() < MIN_POSES:
        raise RunFolderError(_too_few(estimate, ground_truth, int(known.sum())))
    poses, true_poses = estimate.T_world_cam[known], true_poses[known]
    true_poses = poses[0] @ se3.inverse(true_poses[0]) @ true_poses
    points, true_points = (se3.inverse(T)[:, :3, 3] for T in (poses, true_poses))
    T = align(true_points, points)
    return float(np.linalg.norm(points - (true_points @ T[:3, :3].T + T[:3, 3]), axis=1).mean())


def align(source: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Find the rigid motion that aligns points to others with the least squared distance.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991,
    equations 40 to 42, with the scale fixed to one.

    Args:
        source: [N, 3] points.
        target: [N, 3] the corresponding points to align to.

    Returns:
        T_target_source, [4, 4]. If several are optimal (for points on a line, for example), one of them.
    """
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    R = _nearest_rotation((target - mean_target).T @ (source - mean_source))
    return _motion(R, mean_target - R @ mean_source)


def align_poses(source: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """Find the rigid motion that aligns poses to others: the mean rotation first, then the mean translation.

    Unlike ``align``, the result is unique for every path, including a straight one and a rotation on the spot.

    Args:
        source: [N, 4, 4] camera to the source's world, N at least 1.
        target: [N, 4, 4] the same cameras to the target's world.

    Returns:
        T_target_source, [4, 4].
    """
    R = _nearest_rotation((target[:, :3, :3] @ np.swapaxes(source[:, :3, :3], 1, 2)).sum(axis=0))
    return _motion(R, (target[:, :3, 3] - source[:, :3, 3] @ R.T).mean(axis=0))


def _nearest_rotation(M: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation R that maximises trace(R^T M)."""
    U, _, V_t = np.linalg.svd(M)
    return U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(V_t))]) @ V_t


def _motion(R: NDArray[np.float64], t: NDArray[np.float64]) -> NDArray[np.float64]:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def transformed(trajectory: Trajectory, T_new_old: NDArray[np.float64]) -> Trajectory:
    """Return the same trajectory in another world frame."""
    return Trajectory(trajectory.stamps_ns, T_new_old @ trajectory.T_world_cam)


def _too_few(estimate: Trajectory, ground_truth: Trajectory, found: int) -> str:
    return (
        f'{found} of {len(estimate)} frames with a pose have ground truth at their stamp, at least {MIN_POSES} are needed: '
        f'the frames span {_span(estimate)}, the ground truth {_span(ground_truth)}; '
        'are they of the same recording and clock?'
    )


def _span(trajectory: Trajectory) -> str:
    if len(trajectory) == 0:
        return 'nothing'
    return f'{stamp_text(int(trajectory.stamps_ns[0]))} to {stamp_text(int(trajectory.stamps_ns[-1]))} s'
