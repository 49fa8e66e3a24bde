"""One subscribed input topic."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from typing import Any

from rclpy.event_handler import QoSRequestedIncompatibleQoSInfo, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

from msg_adapters import stamps

DEPTH = 10
QOS_OVERRIDE = 'qos_overrides.{}.subscription.{}'
OVERRIDABLE = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY)


class Input:
    """A subscription that settles for best effort when a publisher offers no better.

    A best-effort subscription would take both kinds of publisher, but loses large images from either. Parameters
    ``qos_overrides.TOPIC.subscription.POLICY`` have the last word, as usual in ROS.

    Attributes:
        name: as given, before remapping.
        type_name: e.g. ``sensor_msgs/msg/Image``.
        incompatible_policy: the QoS policy in which a publisher offers less than was asked for; empty if none does.
        received: messages so far.
        delay_s: from the stamp of the newest message to its arrival; None before the first.
        heard_s: when the last one came, by the monotonic clock; when this was made, before the first.
    """

    def __init__(
        self, node: Node, message_class: type, topic: str, on_message: Callable[[Any], None], *,
        reliability: str, keep_all: bool,
    ) -> None:  # fmt: skip
        """Subscribe.

        Args:
            node: to subscribe with.
            message_class: rclpy's.
            topic: relative name, remapped as usual.
            on_message: called by the executor.
            reliability: auto, reliable or best_effort.
            keep_all: keep every message until it is taken, not just the newest.
        """
        self.type_name = f'{message_class.__module__.split(".")[0]}/msg/{message_class.__name__}'
        self.incompatible_policy = ''
        self.received = 0
        self.delay_s: float | None = None
        self.heard_s = time.monotonic()
        self._node = node
        self._message_class = message_class
        self.name = topic
        self._on_message = on_message
        override = QOS_OVERRIDE.format(node.resolve_topic_name(topic), 'reliability')
        self._may_fall_back = reliability == 'auto' and not node.has_parameter(override)
        self._qos = QoSProfile(
            history=HistoryPolicy.KEEP_ALL if keep_all else HistoryPolicy.KEEP_LAST,
            depth=DEPTH,
            reliability=ReliabilityPolicy.BEST_EFFORT if reliability == 'best_effort' else ReliabilityPolicy.RELIABLE,
        )
        self._subscription = self._subscribe(self._qos, QoSOverridingOptions(OVERRIDABLE))

    @property
    def topic(self) -> str:
        """Name on the graph, after remapping."""
        return self._subscription.topic_name

    @property
    def num_publishers(self) -> int:
        """Publishers on the graph, compatible or not."""
        return self._node.count_publishers(self.topic)

    @property
    def other_type(self) -> str:
        """The type that is published on the topic, if it is not ours; else empty."""
        types = {publisher.topic_type for publisher in self._node.get_publishers_info_by_topic(self.topic)}
        return '' if not types or self.type_name in types else sorted(types)[0]

    def candidates(self) -> list[str]:
        """Topics of our type that somebody publishes."""
        return sorted(
            topic
            for topic, types in self._node.get_topic_names_and_types()
            if self.type_name in types and self._node.count_publishers(topic)
            and not topic.startswith(self._node.get_fully_qualified_name() + '/')
        )  # fmt: skip

    def close(self) -> None:
        """Take no more messages."""
        self._node.destroy_subscription(self._subscription)

    def _subscribe(self, qos: QoSProfile, overriding: QoSOverridingOptions | None) -> Subscription:
        return self._node.create_subscription(
            self._message_class, self.name, self._receive, qos, qos_overriding_options=overriding,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=self._on_incompatible),
        )  # fmt: skip

    def _receive(self, message: Any) -> None:
        self.received += 1
        self.delay_s = (self._node.get_clock().now().nanoseconds - stamps.message_stamp_ns(message)) / 1e9
        self._on_message(message)
        self.heard_s = time.monotonic()  # after the message, which may have waited for SLAM

    def _on_incompatible(self, event: QoSRequestedIncompatibleQoSInfo) -> None:
        if not self._may_fall_back or event.last_policy_kind != QoSPolicyKind.RELIABILITY:
            self.incompatible_policy = QoSPolicyKind(event.last_policy_kind).name.lower()
            return
        self._may_fall_back = False
        self._node.get_logger().info(f'{self.topic} is published best effort: subscribing to it best effort')
        self._node.destroy_subscription(self._subscription)
        qos = copy.copy(self._qos)  # with what was overridden
        qos.reliability = ReliabilityPolicy.BEST_EFFORT
        self._subscription = self._subscribe(qos, None)
