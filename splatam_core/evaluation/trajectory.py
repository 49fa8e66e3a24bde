"""How far an estimated trajectory is from the truth: the absolute trajectory error (ATE).

Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012, section IV-B. Two points are
settled here: the truth is interpolated at the frame's stamp rather than taken from the nearest sample, and the
alignment is rigid: a depth camera knows its scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatam_core.errors import RunFolderError
from splatam_core.trajectory import stamp_text
from splatam_core.types import Trajectory

MAX_TRUTH_GAP_NS = 500_000_000
"""Between two truth poses further apart than this a position would be a guess: such frames are not scored."""

STAMP_ROUNDING_NS = 1_000_000
"""A frame this close to a truth pose is at it, even outside the truth's span: files round their stamps."""

MIN_POSES = 3
"""Two poses can always be laid onto each other: their error says nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class TrajectoryError:
    """The absolute trajectory error of the frames that have a truth, N of them.

    Attributes:
        rmse_m: root of the mean squared distance of the camera centres after alignment.
        stamps_ns: [N] int64.
        estimate_m: [N, 3] estimated camera centres, in the estimate's world.
        truth_m: [N, 3] true camera centres at the same stamps, brought into the estimate's world.
        errors_m: [N] their distances.
        T_estimate_truth: [4, 4] the rigid motion that brings the truth into the estimate's world.
    """

    rmse_m: float
    stamps_ns: NDArray[np.int64]
    estimate_m: NDArray[np.float64]
    truth_m: NDArray[np.float64]
    errors_m: NDArray[np.float64]
    T_estimate_truth: NDArray[np.float64]


def trajectory_error(estimate: Trajectory, truth: Trajectory) -> TrajectoryError:
    """Score a trajectory.

    Args:
        estimate: online poses of the tracked frames, camera to world.
        truth: true poses in any world frame, at any stamps of the same clock.

    Raises:
        RunFolderError: fewer than three poses have a truth at their stamp.
    """
    centres, known = interpolate_centres(truth, estimate.stamps_ns)
    if known.sum() < MIN_POSES:
        raise RunFolderError(_too_few(estimate, truth, int(known.sum())))
    estimate_m, true_m = estimate.T_world_cam[known, :3, 3], centres[known]
    T = align(true_m, estimate_m)
    truth_m = true_m @ T[:3, :3].T + T[:3, 3]
    errors_m = np.linalg.norm(estimate_m - truth_m, axis=1)
    rmse_m = float(np.sqrt(np.mean(errors_m**2)))
    return TrajectoryError(rmse_m, estimate.stamps_ns[known], estimate_m, truth_m, errors_m, T)


def interpolate_centres(
    truth: Trajectory, stamps_ns: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """True camera centres at some stamps, linear in between.

    Args:
        truth: N poses.
        stamps_ns: [M] int64.

    Returns:
        centres_m [M, 3], and [M] whether each is known: inside the truth's span and in no gap of it.
    """
    if len(truth) == 0:
        return np.zeros((len(stamps_ns), 3)), np.zeros(len(stamps_ns), dtype=bool)
    # Seconds since the truth's start: 64-bit floats hold those, not epoch nanoseconds, to the last digit.
    truth_s, at_s = ((stamps - truth.stamps_ns[0]) * 1e-9 for stamps in (truth.stamps_ns, stamps_ns))
    centres = np.stack([np.interp(at_s, truth_s, truth.T_world_cam[:, axis, 3]) for axis in range(3)], axis=1)
    after = np.searchsorted(truth.stamps_ns, stamps_ns)  # first truth pose not before the stamp
    last = len(truth) - 1
    above, below = truth.stamps_ns[np.minimum(after, last)], truth.stamps_ns[np.clip(after - 1, 0, last)]
    inside = (stamps_ns >= truth.stamps_ns[0]) & (stamps_ns <= truth.stamps_ns[-1])
    nearest_ns = np.minimum(np.abs(above - stamps_ns), np.abs(stamps_ns - below))
    return centres, (inside & (above - below <= MAX_TRUTH_GAP_NS)) | (nearest_ns <= STAMP_ROUNDING_NS)


def align(source: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rigid motion that brings points onto others with the least squared distance.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991,
    equations 40 to 42, with the scale held at one.

    Args:
        source: [N, 3].
        target: [N, 3], where each should go.

    Returns:
        T_target_source, [4, 4]. Where the points leave it open (all on one line, say), one of the best.
    """
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    covariance = (target - mean_target).T @ (source - mean_source)
    U, _, V_t = np.linalg.svd(covariance)
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(V_t))])
    T = np.eye(4)
    T[:3, :3] = U @ mirror @ V_t
    T[:3, 3] = mean_target - T[:3, :3] @ mean_source
    return T


def transformed(trajectory: Trajectory, T_new_old: NDArray[np.float64]) -> Trajectory:
    """The same trajectory seen from another world frame."""
    return Trajectory(trajectory.stamps_ns, T_new_old @ trajectory.T_world_cam)


def _too_few(estimate: Trajectory, truth: Trajectory, found: int) -> str:
    return (
        f'{found} of {len(estimate)} tracked frames have a true pose at their stamp, at least {MIN_POSES} are needed: '
        f'the frames span {_span(estimate)}, the truth {_span(truth)}; are they of the same recording and clock?'
    )


def _span(trajectory: Trajectory) -> str:
    if len(trajectory) == 0:
        return 'nothing'
    return f'{stamp_text(int(trajectory.stamps_ns[0]))} to {stamp_text(int(trajectory.stamps_ns[-1]))} s'
