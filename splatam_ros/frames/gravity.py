"""Which way is up, by an Imu that rests: it then feels nothing but gravity."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu

from msg_adapters import stamps
from msg_adapters.errors import MessageError
from splatam_ros.frames.buffer import TransformBuffer, TransformError
from splatam_ros.throttled_warnings import ThrottledWarnings

Vector = NDArray[np.float64]

IMU_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
WINDOW_NS, MIN_SAMPLES = 500_000_000, 10
GRAVITY_M_S2, GRAVITY_ERROR = 9.81, 0.5
SHAKE_M_S2, TURN_RAD_S = 0.15, 0.05
"""Largest standard deviation of the acceleration, and largest mean rotation rate, of a sensor at rest. A hand is above both."""

LATE_NS = 100_000_000  # an image may be that much newer than the last Imu message


class RestDetector:
    """Finds the times at which an Imu rests, in its last half second."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, Vector]] = deque()  # stamp; acceleration and rotation rate, [6]

    def add(self, stamp_ns: int, acceleration: Vector, rotation_rate: Vector) -> None:
        """Add a measurement: [3] m/s2, which at rest points up, and [3] rad/s."""
        if self._samples and stamp_ns < self._samples[-1][0]:
            self._samples.clear()
        self._samples.append((stamp_ns, np.concatenate([acceleration, rotation_rate])))
        while stamp_ns - self._samples[0][0] > WINDOW_NS:
            self._samples.popleft()

    def up_at(self, stamp_ns: int) -> Vector | None:
        """Return the upward direction [3] in the Imu's axes at a stamp; None if it did not rest then, or that is not known."""
        if len(self._samples) < MIN_SAMPLES:
            return None
        first_ns, last_ns = self._samples[0][0], self._samples[-1][0]
        if last_ns - first_ns < WINDOW_NS // 2 or not first_ns <= stamp_ns <= last_ns + LATE_NS:
            return None
        values = np.array([sample for _, sample in self._samples])
        mean = values[:, :3].mean(axis=0)
        felt = float(np.linalg.norm(mean))
        rests = abs(felt - GRAVITY_M_S2) < GRAVITY_ERROR and np.linalg.norm(values[:, :3].std(axis=0)) < SHAKE_M_S2
        return mean / felt if rests and np.linalg.norm(values[:, 3:].mean(axis=0)) < TURN_RAD_S else None


class GravitySubscription:
    """Receives the topic ``imu``. Its callback runs on the executor's thread; ``up_in`` may be used from another one."""

    def __init__(self, node: Node, buffer: TransformBuffer, warnings: ThrottledWarnings) -> None:
        """Subscribe.

        Args:
            node: the node that subscribes.
            buffer: knows how the Imu is fixed to the camera.
            warnings: receives a warning about a message that cannot be used.
        """
        self._buffer, self._warnings = buffer, warnings
        self._detector, self._frame = RestDetector(), ''
        node.create_subscription(Imu, 'imu', self._receive, IMU_QOS)

    def up_in(self, camera_frame: str, stamp_ns: int) -> Vector | None:
        """Return the upward direction [3] in the camera at a stamp; None if the Imu did not rest, or is not connected."""
        up = self._detector.up_at(stamp_ns)
        if up is None:
            return None
        try:
            return self._buffer.lookup(camera_frame, self._frame, stamp_ns)[:3, :3] @ up
        except TransformError as error:
            self._warnings.warn('imu', f'the Imu is not used: {error}; publish how it is fixed to the camera on /tf_static')
            return None

    def _receive(self, message: Imu) -> None:
        acceleration, rate = (
            np.array([vector.x, vector.y, vector.z]) for vector in (message.linear_acceleration, message.angular_velocity)
        )
        try:
            stamp_ns = stamps.message_stamp_ns(message)
        except MessageError as error:
            self._warnings.warn('imu', f'an Imu message is ignored: {error}')
            return
        if np.isfinite(acceleration).all() and np.isfinite(rate).all():
            self._frame = message.header.frame_id.removeprefix('/')
            self._detector.add(stamp_ns, acceleration, rate)
