"""Where the camera probably is now."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatam_core.geometry import se3

Matrix = NDArray[np.float64]
# Pose [4, 4] of the camera at the second stamp (ns) in the camera at the first, by another sensor; None: not known.
MotionPrior = Callable[[int, int], 'Matrix | None']
CARRIED_ON = 5  # times the interval a velocity was seen over: after a longer gap nobody knows what the camera did meanwhile


@dataclass(frozen=True, slots=True, eq=False)
class MotionState:
    """What a motion model knows.

    Attributes:
        stamp_ns: of the last pose; 0 = at any time.
        interval_ns: over which the velocity was seen.
        T_world_cam: [4, 4] the last pose.
        velocity: [6] twist per second, in the camera's frame.
    """

    stamp_ns: int
    interval_ns: int
    T_world_cam: Matrix
    velocity: Matrix


class MotionModel:
    """Asks another sensor how the camera moved; else carries its last motion on, by stamps: gaps may differ.

    Args:
        constant_velocity: whether to carry motion on, or stay at the last pose.
        prior: the other sensor.
    """

    def __init__(self, constant_velocity: bool, prior: MotionPrior | None = None) -> None:
        self._constant_velocity = constant_velocity
        self._prior = prior
        self._stamp_ns = 0
        self._interval_ns = 0
        self._T_world_cam: Matrix = np.eye(4)
        self._velocity = np.zeros(6)  # twist per second, in the camera's frame

    @property
    def last_pose(self) -> Matrix:
        """[4, 4] camera to world."""
        return self._T_world_cam

    def state(self) -> MotionState:
        """All it knows; ``restore`` takes it back."""
        return MotionState(self._stamp_ns, self._interval_ns, self._T_world_cam, self._velocity)

    def restore(self, state: MotionState) -> None:
        """Know what another one knew.

        Raises:
            ValueError: that is no pose and velocity.
        """
        if state.T_world_cam.shape != (4, 4) or state.velocity.shape != (6,):
            shapes = f'pose {state.T_world_cam.shape} and velocity {state.velocity.shape}'
            raise ValueError(f'{shapes}: expected (4, 4) and (6,)')
        self._stamp_ns, self._interval_ns = state.stamp_ns, state.interval_ns
        self._T_world_cam, self._velocity = state.T_world_cam, state.velocity

    def predict(self, stamp_ns: int) -> Matrix:
        """[4, 4] camera to world at a stamp."""
        if self._prior and self._stamp_ns and (step := self._prior(self._stamp_ns, stamp_ns)) is not None:
            return self._T_world_cam @ step
        elapsed_ns = min(stamp_ns - self._stamp_ns, CARRIED_ON * self._interval_ns)
        return self._T_world_cam @ se3.exp(self._velocity * elapsed_ns * 1e-9)

    def observe(self, stamp_ns: int, T_world_cam: Matrix) -> None:
        """Learn where the camera was."""
        if self._constant_velocity and self._stamp_ns:
            step = se3.log(se3.inverse(self._T_world_cam) @ T_world_cam)
            self._interval_ns = stamp_ns - self._stamp_ns
            self._velocity = step / (self._interval_ns * 1e-9)
        self._stamp_ns, self._T_world_cam = stamp_ns, T_world_cam

    def place(self, T_world_cam: Matrix) -> None:
        """Be at a pose, at rest, whatever the time: the next stamp may be any."""
        self.stop()
        self._stamp_ns, self._T_world_cam = 0, T_world_cam

    def stop(self) -> None:
        """Forget the velocity: nobody knows how a lost camera moves."""
        self._velocity = np.zeros(6)
