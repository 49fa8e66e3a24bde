"""Where the camera probably is now."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatam_core import se3

Matrix = NDArray[np.float64]


class MotionModel:
    """Carries the camera's last motion on, by stamps: gaps between frames may differ.

    Args:
        constant_velocity: whether to carry motion on, or stay at the last pose.
    """

    def __init__(self, constant_velocity: bool) -> None:
        self._constant_velocity = constant_velocity
        self._stamp_ns = 0
        self._T_world_cam: Matrix = np.eye(4)
        self._velocity = np.zeros(6)  # twist per second, in the camera's frame

    @property
    def last_pose(self) -> Matrix:
        """[4, 4] camera to world."""
        return self._T_world_cam

    def predict(self, stamp_ns: int) -> Matrix:
        """[4, 4] camera to world at a stamp."""
        return self._T_world_cam @ se3.exp(self._velocity * (stamp_ns - self._stamp_ns) * 1e-9)

    def observe(self, stamp_ns: int, T_world_cam: Matrix) -> None:
        """Learn where the camera was."""
        if self._constant_velocity and self._stamp_ns:
            step = se3.log(se3.inverse(self._T_world_cam) @ T_world_cam)
            self._velocity = step / ((stamp_ns - self._stamp_ns) * 1e-9)
        self._stamp_ns, self._T_world_cam = stamp_ns, T_world_cam

    def stop(self) -> None:
        """Forget the velocity: nobody knows how a lost camera moves."""
        self._velocity = np.zeros(6)
