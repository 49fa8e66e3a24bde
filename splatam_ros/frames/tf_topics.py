"""The topics ``/tf`` and ``/tf_static``. Without tf2_msgs, which ROS from pip lacks, the node uses neither."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from msg_adapters import poses, stamps
from msg_adapters.errors import MessageError
from msg_adapters.factory import RclpyMessages, message_class
from splatam_ros.frames.buffer import TransformBuffer
from splatam_ros.frames.options import FrameOptions
from splatam_ros.throttled_warnings import ThrottledWarnings

Matrix = NDArray[np.float64]

# The QoS profiles of tf2.
TF_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
SUBSCRIBE_STATIC_QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE,
                                  durability=DurabilityPolicy.TRANSIENT_LOCAL)  # fmt: skip
PUBLISH_STATIC_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                                durability=DurabilityPolicy.TRANSIENT_LOCAL)  # fmt: skip


class TfTopics:
    """Receives transforms into a buffer, and publishes transforms.

    Attributes:
        is_available: True if tf2_msgs is installed.
    """

    def __init__(self, node: Node, options: FrameOptions, buffer: TransformBuffer, warnings: ThrottledWarnings) -> None:
        """Subscribe and advertise what the options need.

        Args:
            node: the node that subscribes and publishes.
            options: say which topics are needed.
            buffer: receives the transforms of others.
            warnings: receives a warning about a transform that cannot be used.
        """
        self._node = node
        self._buffer = buffer
        self._warnings = warnings
        self._factory = RclpyMessages()
        self._moving: Publisher | None = None
        self._static: Publisher | None = None
        self._published_static: set[tuple[str, str]] = set()
        try:
            message = message_class('tf2_msgs/msg/TFMessage')
        except MessageError:
            self.is_available = False
            return
        self.is_available = True
        if options.subscribes_tf_static:
            node.create_subscription(message, '/tf_static', self._receive_static, SUBSCRIBE_STATIC_QOS)
        if options.subscribes_tf:
            node.create_subscription(message, '/tf', self._receive_moving, TF_QOS)
        if options.publish_tf:
            self._moving = node.create_publisher(message, '/tf', TF_QOS)
            self._static = node.create_publisher(message, '/tf_static', PUBLISH_STATIC_QOS)

    def publish(self, stamp_ns: int, transforms: Mapping[tuple[str, str], Matrix]) -> None:
        """Publish ``T_parent_child`` of each (parent, child) on ``/tf``, if someone subscribes."""
        if self._moving is not None and self._moving.get_subscription_count() > 0:
            self._publish(self._moving, stamp_ns, transforms)

    def publish_static(self, stamp_ns: int, transforms: Mapping[tuple[str, str], Matrix]) -> None:
        """Publish ``T_parent_child`` of each (parent, child) on ``/tf_static``, if the set of links has changed."""
        if transforms.keys() != self._published_static:
            self._publish(self._static, stamp_ns, transforms)
            self._published_static = set(transforms)

    def _publish(self, publisher: Publisher | None, stamp_ns: int, transforms: Mapping[tuple[str, str], Matrix]) -> None:
        if publisher is not None and transforms and self._node.context.ok():
            messages = [
                poses.transform_stamped(self._factory, T, stamp_ns, parent, child) for (parent, child), T in transforms.items()
            ]
            publisher.publish(self._factory.make('tf2_msgs/msg/TFMessage', transforms=messages))

    def _receive_static(self, message: Any) -> None:
        for transform in message.transforms:
            self._attempt(self._set_static, transform)

    def _receive_moving(self, message: Any) -> None:
        for transform in message.transforms:
            self._attempt(self._add, transform)

    def _set_static(self, transform: Any) -> None:
        parent, child = _name(transform.header.frame_id), _name(transform.child_frame_id)
        self._buffer.set_static(parent, child, poses.transform_matrix(transform.transform))

    def _add(self, transform: Any) -> None:
        parent, child = _name(transform.header.frame_id), _name(transform.child_frame_id)
        self._buffer.add(parent, child, stamps.message_stamp_ns(transform), poses.transform_matrix(transform.transform))

    def _attempt(self, use: Callable[[Any], None], transform: Any) -> None:
        """Use one transform of a message. If it cannot be used, warn; the others may be fine."""
        try:
            use(transform)
        except Exception as error:  # noqa: BLE001 - whatever a message holds, the next one may be fine
            self._warnings.warn_of('tf', f"the transform of '{transform.child_frame_id}' is ignored", error)


def _name(frame_id: str) -> str:
    return frame_id.removeprefix('/')  # as tf2 does; recordings of ROS 1 still have the slash
