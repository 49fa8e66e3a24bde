"""Where the camera should be by somebody else's account: wheel or visual-inertial odometry, as a topic or on TF."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.node import Node

from msg_adapters import poses, stamps
from msg_adapters.errors import MessageError
from splatam_core.geometry import se3
from splatam_ros.frames.buffer import TransformError, TransformTree
from splatam_ros.frames.rep105 import Frames
from splatam_ros.node.parameters import NodeOptions
from splatam_ros.subscription import Input
from splatam_ros.throttled_warnings import ThrottledWarnings

Matrix = NDArray[np.float64]


class OdometryInput:
    """The topic ``odom``: each message says where its child frame is in its frame."""

    def __init__(self, node: Node, options: NodeOptions, tree: TransformTree, warnings: ThrottledWarnings) -> None:
        """Subscribe.

        Args:
            node: to subscribe with.
            options: the node's.
            tree: takes the poses.
            warnings: says what cannot be used.
        """
        self._options = options
        self._tree = tree
        self._warnings = warnings
        self.input = Input(
            node, Odometry, 'odom', self._hear, reliability=options.input_reliability,
            keep_all=options.queue_policy == 'all',
        )  # fmt: skip

    def _hear(self, message: Odometry) -> None:
        parent, child = message.header.frame_id.removeprefix('/'), message.child_frame_id.removeprefix('/')
        if parent != self._options.odom_frame:
            self._warnings.warn(
                'odometry', f"{self.input.topic} is in the frame '{parent}', but odom_frame is "
                f"'{self._options.odom_frame}'; set it to '{parent}'",
            )  # fmt: skip
        try:
            T_parent_child = poses.pose_matrix(message.pose.pose)
        except MessageError as error:
            self._warnings.warn('odometry', f'odometry left out: {error}')
        else:
            self._tree.move(parent, child, stamps.message_stamp_ns(message), T_parent_child)


class OdometryPrior:
    """Motion of the camera by the odometry, for the core to start tracking from.

    Args:
        frames: know the odometry.
        camera_frame: gives the name of the camera's frame, once it is known.
        max_wait_s: longest wait for odometry that has not come yet.
        warnings: says when there is none.
    """

    def __init__(self, frames: Frames, camera_frame: Callable[[], str], max_wait_s: float, warnings: ThrottledWarnings) -> None:
        self._frames = frames
        self._camera_frame = camera_frame
        self._max_wait_s = max_wait_s
        self._warnings = warnings

    def __call__(self, from_ns: int, to_ns: int) -> Matrix | None:
        """[4, 4] pose of the camera at ``to_ns`` in the camera at ``from_ns``; None where it is not known."""
        camera = self._camera_frame()
        try:
            T_odom_to = self._frames.odometry(camera, to_ns, self._max_wait_s)
            T_odom_from = self._frames.odometry(camera, from_ns)
        except TransformError as error:
            self._warnings.warn('prior', f'no odometry for this frame, constant velocity instead: {error}')
            return None
        return se3.inverse(T_odom_from) @ T_odom_to
