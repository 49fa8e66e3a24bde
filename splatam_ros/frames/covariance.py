"""The velocity and the covariances in ``nav_msgs/Odometry``.

Alignment estimates the covariance of each pose, with the drift of the map (``PoseCovariance``). For a tracker that estimates
none the node states this: a pose that every pixel of the frame supports has the nominal standard deviations
``stddev.position`` and ``stddev.orientation`` relative to the map (parameters). Pixel errors count as independent, so the
variance is divided by the fraction of the pixels that support the pose. Drift of the map is not included then.
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

UNKNOWN_VARIANCE = 1e6  # of a velocity that is not known: filters expect a large value; zero would mean exact


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Velocity of a body, with covariances.

    Attributes:
        pose_covariance: [6, 6] of x, y, z (m) and the rotations about x, y, z (rad) of the body, in map axes.
        camera_covariance: [6, 6] the same of the camera.
        twist: [6] linear (m/s) and angular (rad/s) velocity in body axes.
        twist_covariance: [6, 6] of the twist.
    """

    pose_covariance: Matrix
    camera_covariance: Matrix
    twist: Vector
    twist_covariance: Matrix


class MotionEstimator:
    """Computes the velocity between consecutive poses. Across a gap in tracking the velocity is unknown."""

    def __init__(self, stddev_position_m: float, stddev_orientation_rad: float) -> None:
        """Start without a previous pose.

        Args:
            stddev_position_m: standard deviation of the camera's position if every pixel supports the pose.
            stddev_orientation_rad: standard deviation of its orientation, likewise.
        """
        self._variances = np.repeat([stddev_position_m**2, stddev_orientation_rad**2], 3)
        self._previous: tuple[Located, Matrix] | None = None

    def interrupt(self) -> None:
        """Forget the previous pose: the velocity from it to the next pose is not known."""
        self._previous = None

    def observe(self, located: Located, result: FrameResult) -> Motion:
        """Add a pose and return its motion."""
        relative, total = self._camera_covariances(located, result)
        to_body = _body_of_camera(located)
        covariance, pose_covariance = to_body @ relative @ to_body.T, to_body @ total @ to_body.T
        previous, self._previous = self._previous, (located, covariance)
        if previous is None:
            return Motion(pose_covariance, total, np.zeros(6), UNKNOWN_VARIANCE * np.eye(6))
        before, covariance_before = previous
        seconds = (located.stamp_ns - before.stamp_ns) * 1e-9
        twist = se3.log(se3.inverse(before.T_steady_body) @ located.T_steady_body) / seconds
        J = np.kron(np.eye(2), located.T_map_body[:3, :3].T)  # [6, 6] from map axes to body axes
        return Motion(pose_covariance, total, twist, J @ (covariance + covariance_before) @ J.T / seconds**2)

    def _camera_covariances(self, located: Located, result: FrameResult) -> tuple[Matrix, Matrix]:
        """Returns the [6, 6] covariances of the camera in map axes: relative to the map near it, and with the map's drift."""
        if result.covariance is None:
            supporting_fraction = result.visible_fraction * result.inlier_fraction
            nominal = np.diag(self._variances / max(supporting_fraction, 1e-3))
            return nominal, nominal
        turn = np.kron(np.eye(2), located.T_map_world[:3, :3])
        return turn @ result.covariance.relative @ turn.T, turn @ result.covariance.total @ turn.T


def _body_of_camera(located: Located) -> Matrix:
    """Returns the [6, 6] derivative of the body's pose by the camera's: a rotation of the camera moves a body beside it."""
    lever = located.T_map_body[:3, 3] - located.T_map_camera[:3, 3]
    J = np.eye(6)
    J[:3, 3:] = -se3.skew(lever)
    return J
