"""Predicts where the camera is when a frame arrives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from splatam_core.geometry import se3
from splatam_core.geometry.se3 import Matrix
from splatam_core.tracking.time_offset import TimeOffset

MotionPrior = Callable[[int, int], 'Matrix | None']
"""Pose [4, 4] of the camera at the second stamp (ns) in the camera at the first, by another sensor; None = not known."""

MAX_EXTRAPOLATION = 5
"""A velocity is extrapolated for at most this many times the interval it was observed over: longer gaps say nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class MotionState:
    """The state of a motion model.

    Attributes:
        stamp_ns: of the last pose; 0 = the next pose may have any stamp.
        interval_ns: over which the velocity was observed.
        T_world_cam: [4, 4] the last pose.
        velocity: [6] twist per second, in the camera's frame.
        time_offset: between colour and depth.
    """

    stamp_ns: int
    interval_ns: int
    T_world_cam: Matrix
    velocity: Matrix
    time_offset: TimeOffset = TimeOffset()


class MotionModel:
    """Predicts by another sensor if there is one, else extrapolates the last velocity, by stamps: frames may be missing.

    Attributes:
        time_offset: between colour and depth, a property of the camera: it outlives a lost track.

    Args:
        constant_velocity: whether to extrapolate the velocity; else the prediction is the last pose.
        prior: the other sensor.
    """

    def __init__(self, constant_velocity: bool, prior: MotionPrior | None = None) -> None:
        self._constant_velocity = constant_velocity
        self._prior = prior
        self._stamp_ns = 0
        self._interval_ns = 0
        self._T_world_cam: Matrix = np.eye(4)
        self._velocity = np.zeros(6)  # twist per second, in the camera's frame
        self.time_offset = TimeOffset()

    @property
    def last_pose(self) -> Matrix:
        """[4, 4] camera to world."""
        return self._T_world_cam

    def state(self) -> MotionState:
        """Returns the state, for ``restore``."""
        return MotionState(self._stamp_ns, self._interval_ns, self._T_world_cam, self._velocity, self.time_offset)

    def restore(self, state: MotionState) -> None:
        """Sets the state to that of another motion model.

        Raises:
            ValueError: pose or velocity has the wrong shape.
        """
        if state.T_world_cam.shape != (4, 4) or state.velocity.shape != (6,):
            shapes = f'pose {state.T_world_cam.shape} and velocity {state.velocity.shape}'
            raise ValueError(f'{shapes}: expected (4, 4) and (6,)')
        self._stamp_ns, self._interval_ns = state.stamp_ns, state.interval_ns
        self._T_world_cam, self._velocity, self.time_offset = state.T_world_cam, state.velocity, state.time_offset

    def predict(self, stamp_ns: int) -> Matrix:
        """Returns the predicted pose [4, 4], camera to world, at a stamp."""
        if self._prior and self._stamp_ns and (step := self._prior(self._stamp_ns, stamp_ns)) is not None:
            return self._T_world_cam @ step
        elapsed_ns = min(stamp_ns - self._stamp_ns, MAX_EXTRAPOLATION * self._interval_ns)
        return self._T_world_cam @ se3.exp(self._velocity * elapsed_ns * 1e-9)

    def observe(self, stamp_ns: int, T_world_cam: Matrix) -> None:
        """Records the pose of a frame."""
        if self._constant_velocity and self._stamp_ns:
            step = se3.log(se3.inverse(self._T_world_cam) @ T_world_cam)
            self._interval_ns = stamp_ns - self._stamp_ns
            self._velocity = step / (self._interval_ns * 1e-9)
        self._stamp_ns, self._T_world_cam = stamp_ns, T_world_cam

    def place(self, T_world_cam: Matrix) -> None:
        """Sets the pose, at rest; the next frame may have any stamp."""
        self.stop()
        self._stamp_ns, self._T_world_cam = 0, T_world_cam

    def stop(self) -> None:
        """Sets the velocity to zero, because the motion of a lost camera is not known."""
        self._velocity = np.zeros(6)
