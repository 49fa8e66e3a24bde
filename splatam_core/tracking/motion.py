"""Predicts where the camera is when a frame arrives."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from splatam_core.geometry import se3
from splatam_core.geometry.se3 import Matrix
from splatam_core.tracking.pace import Pace
from splatam_core.tracking.read_motion import ReadMotion
from splatam_core.tracking.readout import Readout, ReadoutSeen
from splatam_core.tracking.time_offset import TimeOffset

MotionPrior = Callable[[int, int], 'Matrix | None']
"""Pose [4, 4] of the camera at the second stamp (ns) in the camera at the first, by another sensor; None = not known."""

MAX_EXTRAPOLATION = 5
"""A velocity is extrapolated for at most this many times the interval it was observed over: longer gaps say nothing."""

MAX_INTERVALS = 10**6
"""More frame intervals than this since the last pose, nine hours at 30 Hz, count as this many: of a clock that was set, or after
two stamps a nanosecond apart, there are more than native code counts."""

MAX_ACCELERATION, MAX_ANGULAR_ACCELERATION = 10.0, 60.0  # m/s^2, rad/s^2: a jerk of the hand


@dataclass(frozen=True, slots=True, eq=False)
class SeenMotion:
    """How the camera has moved from one frame to another, as their images tell without the map.

    Attributes:
        T_now_before: [4, 4] the camera then in the camera now.
        covariance: [6, 6] of the twist by which ``exp(twist) @ T_now_before`` is true, m and rad.
    """

    T_now_before: Matrix
    covariance: Matrix


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """Where the camera is expected.

    Attributes:
        T_world_cam: [4, 4].
        T_world_cam_before: [4, 4] the pose that it follows from.
        seconds: since then; infinite where that is not known.
        is_guess: True if nothing is known about the motion since then.
        is_measured: True if another sensor has measured it.
        seen: what the images of the two frames tell about it; None where they were not compared.
        pace: how it is expected to move from frame to frame.
    """

    T_world_cam: Matrix
    T_world_cam_before: Matrix
    seconds: float
    is_guess: bool = False
    is_measured: bool = False
    seen: SeenMotion | None = None
    pace: Pace = field(default_factory=Pace)

    @property
    def T_cam_world(self) -> Matrix:
        """[4, 4] world to camera."""
        return se3.inverse(self.T_world_cam)


@dataclass(frozen=True, slots=True, eq=False)
class MotionState:
    """The state of a motion model.

    Attributes:
        stamp_ns: of the last pose; 0 = the next pose may have any stamp.
        interval_ns: over which the velocity was observed.
        T_world_cam: [4, 4] the last pose.
        velocity: [6] twist per second, in the camera's frame.
        time_offset: between colour and depth.
        trusted_ns: stamp of the last pose that may be trusted; None where that is the last pose.
        T_world_cam_trusted: [4, 4] that pose.
        readout: how long reading an image takes.
    """

    stamp_ns: int
    interval_ns: int
    T_world_cam: Matrix
    velocity: Matrix
    time_offset: TimeOffset = TimeOffset()
    trusted_ns: int | None = None
    T_world_cam_trusted: Matrix = field(default_factory=lambda: np.eye(4))
    readout: Readout = Readout()


class MotionModel:
    """Predicts by another sensor if there is one, else extrapolates the last velocity, by stamps: frames may be missing.

    Attributes:
        time_offset: between colour and depth, a property of the camera: it outlives a lost track.
        readout: how long reading an image takes, another one.

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
        self._trusted_ns: int | None = None
        self._T_world_cam_trusted: Matrix = np.eye(4)
        self.time_offset = TimeOffset()
        self.readout = Readout()

    @property
    def last_pose(self) -> Matrix:
        """[4, 4] camera to world."""
        return self._T_world_cam

    @property
    def trusted_pose(self) -> Matrix:
        """[4, 4] camera to world, the last one that is not uncertain."""
        return self._T_world_cam if self._trusted_ns is None else self._T_world_cam_trusted

    @property
    def read_motion(self) -> ReadMotion:
        """How the camera moved while it took the last frame, as far as its velocity is known."""
        return ReadMotion(-self._velocity, self.readout.used_s, 1e-9 * self._interval_ns * self.time_offset.mean)

    def state(self) -> MotionState:
        """Returns the state, for ``restore``."""
        return MotionState(
            stamp_ns=self._stamp_ns,
            interval_ns=self._interval_ns,
            T_world_cam=self._T_world_cam,
            velocity=self._velocity,
            time_offset=self.time_offset,
            trusted_ns=self._trusted_ns,
            T_world_cam_trusted=self._T_world_cam_trusted,
            readout=self.readout,
        )

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
        self._trusted_ns, self._T_world_cam_trusted = state.trusted_ns, state.T_world_cam_trusted
        self.readout = state.readout

    def predictions(self, stamp_ns: int) -> list[Prediction]:
        """Returns where the camera is expected: from the last pose, and if that is uncertain, from the last one to be trusted."""
        predictions = [self._prediction(stamp_ns, self._stamp_ns, self._T_world_cam)]
        if self._trusted_ns is not None:
            predictions.append(self._prediction(stamp_ns, self._trusted_ns, self._T_world_cam_trusted))
        return predictions

    def _prediction(self, stamp_ns: int, before_ns: int, T_before: Matrix) -> Prediction:
        if not before_ns:
            return Prediction(T_before, T_before, math.inf)
        seconds = 1e-9 * (stamp_ns - before_ns)
        step = self._prior(before_ns, stamp_ns) if self._prior else None
        is_measured = step is not None
        T_world_cam = self._extrapolated(stamp_ns, before_ns, T_before) if step is None else T_before @ step
        is_guess = not is_measured and self._constant_velocity and not self._velocity.any()
        pace = self._pace(stamp_ns - before_ns, se3.inverse(T_world_cam) @ T_before)
        return Prediction(T_world_cam, T_before, seconds, is_guess, is_measured, pace=pace)

    def _pace(self, elapsed_ns: int, T_now_before: Matrix) -> Pace:
        """Returns how the camera moves from frame to frame, from the motion [4, 4] predicted for a time."""
        num_frames, seconds = self._num_frames(elapsed_ns), 1e-9 * elapsed_ns
        return Pace(
            num_frames=num_frames,
            expected=se3.log(T_now_before) / num_frames,
            limit_m=MAX_ACCELERATION * seconds**2 / num_frames,
            limit_rad=MAX_ANGULAR_ACCELERATION * seconds**2 / num_frames,
            readout=self.readout.prior(seconds / num_frames),
        )

    def _num_frames(self, elapsed_ns: int) -> int:
        """Returns how many frame intervals a time is, by the last one over which a velocity was observed."""
        return min(max(1, round(elapsed_ns / self._interval_ns)), MAX_INTERVALS) if self._interval_ns else 1

    def predict(self, stamp_ns: int) -> Matrix:
        """Returns the predicted pose [4, 4], camera to world, at a stamp."""
        return self._prediction(stamp_ns, self._stamp_ns, self._T_world_cam).T_world_cam

    def _extrapolated(self, stamp_ns: int, before_ns: int, T_before: Matrix) -> Matrix:
        """Returns the pose [4, 4] to which the velocity leads, from that at an earlier stamp."""
        elapsed_ns = min(stamp_ns - before_ns, MAX_EXTRAPOLATION * self._interval_ns)
        return T_before @ se3.exp(self._velocity * elapsed_ns * 1e-9)

    def observe(self, stamp_ns: int, T_world_cam: Matrix, *, is_trusted: bool = True, readout: ReadoutSeen | None = None) -> None:
        """Records the pose of a frame. One that may be wrong is where the next prediction starts, but gives no velocity.

        Args:
            stamp_ns: of the frame.
            T_world_cam: [4, 4] its pose.
            is_trusted: False if it may be wrong.
            readout: what the frame tells about the time that reading an image takes.
        """
        if not is_trusted:
            if self._trusted_ns is None:
                self._trusted_ns, self._T_world_cam_trusted = self._stamp_ns, self._T_world_cam
            self._stamp_ns, self._T_world_cam = stamp_ns, T_world_cam
            return
        if readout is not None and self._stamp_ns and self._trusted_ns is None:
            elapsed_ns = stamp_ns - self._stamp_ns
            self.readout = self.readout.updated(readout, 1e-9 * elapsed_ns / self._num_frames(elapsed_ns))
        if self._constant_velocity and self._stamp_ns:
            step = se3.log(se3.inverse(self._T_world_cam) @ T_world_cam)
            self._interval_ns = stamp_ns - self._stamp_ns
            self._velocity = step / (self._interval_ns * 1e-9)
        self._stamp_ns, self._T_world_cam, self._trusted_ns = stamp_ns, T_world_cam, None

    def correct(self, motion: Matrix) -> None:
        """Moves all poses by a motion [4, 4] of the world, because map and poses were corrected; the velocity stays."""
        self._T_world_cam, self._T_world_cam_trusted = motion @ self._T_world_cam, motion @ self._T_world_cam_trusted

    def place(self, T_world_cam: Matrix) -> None:
        """Sets the pose, at rest; the next frame may have any stamp."""
        self.stop()
        self._stamp_ns, self._T_world_cam, self._trusted_ns = 0, T_world_cam, None

    def stop(self) -> None:
        """Sets the velocity to zero, because the motion of a lost camera is not known."""
        self._velocity = np.zeros(6)
