"""What ``nav_msgs/Odometry`` says besides the pose: velocity, and how sure both are.

The tracker gives no covariance. What is stated instead: a pose found from all pixels of a frame has the standard
deviations ``stddev.position`` and ``stddev.orientation`` relative to the map (nominal, parameters), and pixels err
independently, so that a pose that only a share of them supports has a variance larger by one over that share. Drift
of the map itself is not in it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatam_core.geometry import se3
from splatam_core.types import FrameResult
from splatam_ros.frames.rep105 import Located

Matrix = NDArray[np.float64]
Vector = NDArray[np.float64]

UNKNOWN_VARIANCE = 1e6  # of a velocity that is not known: large, as filters expect it; zero would mean exact


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """What is known about a moving body.

    Attributes:
        pose_covariance: [6, 6] of x y z and the rotations about x y z, in the axes of the map.
        twist: [6] linear (m/s) and angular (rad/s) velocity in the body's own axes.
        twist_covariance: [6, 6] of it.
    """

    pose_covariance: Matrix
    twist: Vector
    twist_covariance: Matrix


class MotionEstimator:
    """Velocity from one tracked pose to the next; over a gap in which the camera was lost there is none.

    Args:
        stddev_position_m: of a camera that all of its pixels support.
        stddev_orientation_rad: likewise.
    """

    def __init__(self, stddev_position_m: float, stddev_orientation_rad: float) -> None:
        self._variances = np.repeat([stddev_position_m**2, stddev_orientation_rad**2], 3)
        self._previous: tuple[Located, Matrix] | None = None

    def lost(self) -> None:
        """The way from the last pose to the next is not known."""
        self._previous = None

    def observe(self, located: Located, result: FrameResult) -> Motion:
        """Take a tracked pose."""
        covariance = self._pose_covariance(located, result.visible_fraction * result.inlier_fraction)
        previous, self._previous = self._previous, (located, covariance)
        if previous is None:
            return Motion(covariance, np.zeros(6), UNKNOWN_VARIANCE * np.eye(6))
        before, covariance_before = previous
        seconds = (located.stamp_ns - before.stamp_ns) * 1e-9
        twist = se3.log(se3.inverse(before.T_map_body) @ located.T_map_body) / seconds
        J = np.kron(np.eye(2), located.T_map_body[:3, :3].T)  # from the map's axes to the body's
        return Motion(covariance, twist, J @ (covariance + covariance_before) @ J.T / seconds**2)

    def _pose_covariance(self, located: Located, share: float) -> Matrix:
        """[6, 6] of the body: where the camera turns, a body beside it moves."""
        lever = located.T_map_body[:3, 3] - located.T_map_camera[:3, 3]
        J = np.eye(6)
        J[:3, 3:] = -se3.skew(lever)
        return J @ np.diag(self._variances / max(share, 1e-3)) @ J.T
