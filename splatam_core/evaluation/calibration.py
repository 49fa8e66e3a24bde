"""Whether the covariances of a trajectory are true: errors of relative poses, in standard deviations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatam_core.geometry import se3
from splatam_core.geometry.trajectory import Trajectory, interpolate_poses
from splatam_core.types import PoseCovariance

Matrix = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class TruthNoise:
    """How far the ground truth itself may be off: standard deviations along and about each axis, of a relative pose."""

    position_m: float = 0.0
    rotation_rad: float = 0.0


def normalized_errors(
    estimate: Trajectory, ground_truth: Trajectory, covariances: Mapping[int, PoseCovariance], *,
    step: int = 10, noise: TruthNoise = TruthNoise(),
) -> Matrix:  # fmt: skip
    """Computes ``sqrt(e^T S^-1 e / 6)`` of the poses of frames relative to those a number of frames before.

    The covariance S is the sum of those of both frames relative to the map, of what the drift has grown by in between, and of
    the ground truth's noise. For true covariances the median is 0.95.

    Args:
        estimate: the poses.
        ground_truth: true poses, in any world.
        covariances: of the poses, by stamp; frames without one are left out.
        step: number of poses from the first frame of a pair to the second.
        noise: of the ground truth.

    Returns:
        [K] one number for each pair with ground truth.
    """
    true_poses, known = interpolate_poses(ground_truth, estimate.stamps_ns)
    stamps_ns = estimate.stamps_ns.tolist()
    of_truth = np.diag(np.repeat([noise.position_m**2, noise.rotation_rad**2], 3))
    found = []
    for i in range(len(stamps_ns) - step):
        k = i + step
        first, second = covariances.get(stamps_ns[i]), covariances.get(stamps_ns[k])
        if first is None or second is None or not (known[i] and known[k]):
            continue
        T_i, T_k = estimate.T_world_cam[i], estimate.T_world_cam[k]
        T_k_i = se3.inverse(T_k) @ T_i
        error = se3.log(T_k_i @ se3.inverse(true_poses[i]) @ true_poses[k])
        J = adjoint(T_k_i)
        S = J @ in_camera(first.relative, T_i) @ J.T + in_camera(second.relative, T_k) + _growth(first, second) + of_truth
        found.append(np.sqrt(error @ np.linalg.solve(S, error) / 6))
    return np.array(found)


def in_camera(covariance: Matrix, T_world_cam: Matrix) -> Matrix:
    """Returns a [6, 6] covariance in world axes as that of a twist in the camera's axes."""
    turn = np.kron(np.eye(2), T_world_cam[:3, :3].T)
    return turn @ covariance @ turn.T


def adjoint(T: Matrix) -> Matrix:
    """Returns [6, 6] with ``exp(adjoint(T) @ twist) == T @ exp(twist) @ T^-1``."""
    R = T[:3, :3]
    return np.block([[R, se3.skew(T[:3, 3]) @ R], [np.zeros((3, 3)), R]])


def _growth(first: PoseCovariance, second: PoseCovariance) -> Matrix:
    """Returns the [6, 6] covariance by which the drift has grown; it is the same in all axes."""
    position = second.drift_position_m**2 - first.drift_position_m**2
    rotation = second.drift_rotation_rad**2 - first.drift_rotation_rad**2
    return np.diag(np.repeat(np.maximum([position, rotation], 0.0), 3))
