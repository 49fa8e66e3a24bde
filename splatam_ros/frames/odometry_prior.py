"""Predicts the motion of the camera from external odometry (wheels, visual-inertial), received as a topic or on TF."""

from __future__ import annotations

import numpy as np
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.node import Node

from msg_adapters import poses, stamps
from msg_adapters.errors import MessageError
from splatam_core.geometry import se3
from splatam_ros.frames.buffer import TransformBuffer, TransformError
from splatam_ros.frames.rep105 import CoordinateFrames
from splatam_ros.subscription import MonitoredSubscription
from splatam_ros.throttled_warnings import ThrottledWarnings

Matrix = NDArray[np.float64]


class OdometrySubscription:
    """Receives the topic ``odom``: each message is the pose of its child frame in its header's frame."""

    def __init__(
        self, node: Node, odom_frame: str, buffer: TransformBuffer, warnings: ThrottledWarnings, *,
        reliability: str, keep_all: bool,
    ) -> None:  # fmt: skip
        """Subscribe.

        Args:
            node: the node that subscribes.
            odom_frame: expected frame of the messages; another one causes a warning.
            buffer: receives the poses.
            warnings: receives a warning about a message that cannot be used.
            reliability: QoS reliability: auto, reliable or best_effort.
            keep_all: True to queue every message.
        """
        self._odom_frame = odom_frame
        self._buffer = buffer
        self._warnings = warnings
        self._subscription = MonitoredSubscription(
            node, Odometry, 'odom', self._receive, reliability=reliability, keep_all=keep_all
        )

    @property
    def topic(self) -> str:
        """Name on the graph, after remapping."""
        return self._subscription.topic

    def _receive(self, message: Odometry) -> None:
        parent, child = message.header.frame_id.removeprefix('/'), message.child_frame_id.removeprefix('/')
        if parent != self._odom_frame:
            self._warnings.warn(
                'odometry', f"{self.topic} is in the frame '{parent}', but odom_frame is '{self._odom_frame}'; "
                f"set it to '{parent}'",
            )  # fmt: skip
        try:
            T_parent_child = poses.pose_matrix(message.pose.pose)
        except MessageError as error:
            self._warnings.warn('odometry', f'an odometry message is ignored: {error}')
        else:
            self._buffer.add(parent, child, stamps.message_stamp_ns(message), T_parent_child)


class OdometryPrior:
    """Motion of the camera between two stamps, by odometry. The core starts tracking from it.

    Attributes:
        camera_frame: name of the frame of the camera whose motion is asked for.
    """

    def __init__(self, frames: CoordinateFrames, max_wait_s: float, warnings: ThrottledWarnings) -> None:
        """Use the odometry that the frames know.

        Args:
            frames: look up the odometry.
            max_wait_s: longest wait for odometry that has not arrived yet.
            warnings: receives a warning when there is no odometry for a frame.
        """
        self.camera_frame = ''
        self._frames = frames
        self._max_wait_s = max_wait_s
        self._warnings = warnings

    def __call__(self, from_ns: int, to_ns: int) -> Matrix | None:
        """Returns the [4, 4] pose of the camera at ``to_ns`` in the camera at ``from_ns``; None if it is not known."""
        try:
            T_odom_to = self._frames.odometry(self.camera_frame, to_ns, self._max_wait_s)
            T_odom_from = self._frames.odometry(self.camera_frame, from_ns)
        except TransformError as error:
            self._warnings.warn('prior', f'no odometry for this frame, constant velocity is used instead: {error}')
            return None
        return se3.inverse(T_odom_from) @ T_odom_to
