"""``/tf`` and ``/tf_static``. Without tf2_msgs, which pip's ROS lacks, all is mute."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from msg_adapters import poses, stamps
from msg_adapters.errors import MessageError
from msg_adapters.factory import RclpyMessages
from splatam_ros.frames.buffer import TransformTree
from splatam_ros.player.recording import message_class
from splatam_ros.throttled_warnings import ThrottledWarnings

Matrix = NDArray[np.float64]

TF_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
HEAR_STATIC_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE,
                             durability=DurabilityPolicy.TRANSIENT_LOCAL)  # fmt: skip
SAY_STATIC_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                            durability=DurabilityPolicy.TRANSIENT_LOCAL)  # fmt: skip


class Tf:
    """The node's ears and voice on ``/tf`` and ``/tf_static``; topics and QoS are tf2's.

    Attributes:
        is_available: whether tf2_msgs is installed.
    """

    def __init__(
        self, node: Node, tree: TransformTree, warnings: ThrottledWarnings, *,
        hears: bool, hears_moving: bool, says: bool,
    ) -> None:  # fmt: skip
        """Subscribe and advertise.

        Args:
            node: to do so with.
            tree: takes what is heard.
            warnings: says what cannot be used.
            hears: whether to listen to ``/tf_static``.
            hears_moving: whether to listen to ``/tf`` as well.
            says: whether to publish.
        """
        self._node = node
        self._tree = tree
        self._warnings = warnings
        self._factory = RclpyMessages()
        self._moving: Publisher | None = None
        self._fixed: Publisher | None = None
        try:
            message = message_class('tf2_msgs/msg/TFMessage')
        except LookupError:
            self.is_available = False
            return
        self.is_available = True
        if hears:
            node.create_subscription(message, '/tf_static', self._hear_fixed, HEAR_STATIC_QOS)
        if hears_moving:
            node.create_subscription(message, '/tf', self._hear_moving, TF_QOS)
        if says:
            self._moving = node.create_publisher(message, '/tf', TF_QOS)
            self._fixed = node.create_publisher(message, '/tf_static', SAY_STATIC_QOS)

    def move(self, stamp_ns: int, transforms: Mapping[tuple[str, str], Matrix]) -> None:
        """Publish ``T_parent_child`` of each (parent, child) on ``/tf``."""
        self._publish(self._moving, stamp_ns, transforms)

    def fix(self, stamp_ns: int, transforms: Mapping[tuple[str, str], Matrix]) -> None:
        """Publish ``T_parent_child`` of each (parent, child) on ``/tf_static``, instead of what was."""
        self._publish(self._fixed, stamp_ns, transforms)

    def _publish(self, publisher: Publisher | None, stamp_ns: int, transforms: Mapping[tuple[str, str], Matrix]) -> None:
        if publisher is not None and transforms and self._node.context.ok():
            messages = [
                poses.transform_stamped(self._factory, T, stamp_ns, parent, child) for (parent, child), T in transforms.items()
            ]
            publisher.publish(self._factory.make('tf2_msgs/msg/TFMessage', transforms=messages))

    def _hear_fixed(self, message: Any) -> None:
        for transform in message.transforms:
            if (T := self._matrix(transform)) is not None:
                self._tree.fix(_name(transform.header.frame_id), _name(transform.child_frame_id), T)

    def _hear_moving(self, message: Any) -> None:
        for transform in message.transforms:
            if (T := self._matrix(transform)) is not None:
                self._tree.move(
                    _name(transform.header.frame_id), _name(transform.child_frame_id),
                    stamps.message_stamp_ns(transform), T,
                )  # fmt: skip

    def _matrix(self, transform: Any) -> Matrix | None:
        try:
            return poses.transform_matrix(transform.transform)
        except MessageError as error:
            self._warnings.warn('tf', f"transform of '{transform.child_frame_id}' left out: {error}")
            return None


def _name(frame_id: str) -> str:
    return frame_id.removeprefix('/')  # as tf2 does; ROS 1's bags still have it
