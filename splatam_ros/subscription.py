"""A subscription to one input topic that keeps statistics and adapts its QoS."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Sequence
from typing import Any

from rclpy.event_handler import QoSRequestedIncompatibleQoSInfo, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

from msg_adapters import stamps
from splatam_ros.process import RosError
from splatam_ros.throttled_warnings import ThrottledWarnings

DEPTH = 10
QOS_OVERRIDES = 'qos_overrides.'
QOS_OVERRIDE = QOS_OVERRIDES + '{}.subscription.{}'
OVERRIDABLE = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY, QoSPolicyKind.DURABILITY)
CHOICES = {
    policy: tuple(name.lower() for name in kind.__members__ if name != 'UNKNOWN')
    for policy, kind in (
        (QoSPolicyKind.HISTORY, HistoryPolicy), (QoSPolicyKind.RELIABILITY, ReliabilityPolicy),
        (QoSPolicyKind.DURABILITY, DurabilityPolicy),
    )
}  # fmt: skip
RCLPY_TOPICS = ('/clock', '/parameter_events')  # rclpy subscribes to them itself, with overrides of its own


class MonitoredSubscription:
    """A subscription that keeps statistics, and falls back to best effort if the publisher offers no reliable QoS.

    A best-effort subscription would match both kinds of publisher, but it loses large images even of a reliable one.
    As usual in ROS, parameters ``qos_overrides.TOPIC.subscription.POLICY`` take precedence.

    Attributes:
        name: topic name before remapping.
        type_name: e.g. ``sensor_msgs/msg/Image``.
        incompatible_policy: QoS policy in which a publisher offers less than requested; empty if there is none.
        received: number of messages so far.
        delay_s: time from the stamp of the newest message to its arrival; None before the first message.
        last_received_s: monotonic time at which the last message had been handled; of subscribing, before the first.
    """

    def __init__(
        self, node: Node, message_class: type, topic: str, on_message: Callable[[Any], object], *,
        reliability: str, keep_all: bool,
    ) -> None:  # fmt: skip
        """Subscribe.

        Args:
            node: the node that subscribes.
            message_class: message class of rclpy.
            topic: relative topic name; remapping applies.
            on_message: called on the executor's thread with each message.
            reliability: auto, reliable or best_effort.
            keep_all: True to queue every message until it is handled, False to keep only the newest ones.

        Raises:
            RosError: a QoS override has a value that its policy does not allow.
        """
        self.name = topic
        self.type_name = f'{message_class.__module__.split(".")[0]}/msg/{message_class.__name__}'
        self.incompatible_policy = ''
        self.received = 0
        self.delay_s: float | None = None
        self.last_received_s = time.monotonic()
        self._node = node
        self._message_class = message_class
        self._on_message = on_message
        self._warnings = ThrottledWarnings(node.get_logger())
        overridden = _check_overrides(node, node.resolve_topic_name(topic))
        self._may_fall_back = reliability == 'auto' and QoSPolicyKind.RELIABILITY not in overridden
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
        """Number of publishers on the graph, compatible or not."""
        return self._node.count_publishers(self.topic)

    @property
    def other_type(self) -> str:
        """Type that is published on the topic, if it differs from ours; else empty."""
        types = {publisher.topic_type for publisher in self._node.get_publishers_info_by_topic(self.topic)}
        return '' if not types or self.type_name in types else sorted(types)[0]

    def candidates(self) -> list[str]:
        """Returns the published topics of our type, except those of this node."""
        return sorted(
            topic
            for topic, types in self._node.get_topic_names_and_types()
            if self.type_name in types and self._node.count_publishers(topic)
            and not topic.startswith(self._node.get_fully_qualified_name() + '/')
        )  # fmt: skip

    def close(self) -> None:
        """Unsubscribe."""
        self._node.destroy_subscription(self._subscription)

    def _subscribe(self, qos: QoSProfile, overriding: QoSOverridingOptions | None) -> Subscription:
        return self._node.create_subscription(
            self._message_class, self.name, self._receive, qos, qos_overriding_options=overriding,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=self._on_incompatible),
        )  # fmt: skip

    def _receive(self, message: Any) -> None:
        self.received += 1
        try:
            self.delay_s = (self._node.get_clock().now().nanoseconds - stamps.message_stamp_ns(message)) / 1e9
            self._on_message(message)
        except Exception as error:  # noqa: BLE001 - whatever a message holds, the next one may be fine
            self._warnings.warn_of('message', f'{self.topic}: a message is skipped', error)
        self.last_received_s = time.monotonic()  # afterwards, because handling a message may wait for SLAM

    def _on_incompatible(self, event: QoSRequestedIncompatibleQoSInfo) -> None:
        if not self._may_fall_back or event.last_policy_kind != QoSPolicyKind.RELIABILITY:
            self.incompatible_policy = QoSPolicyKind(event.last_policy_kind).name.lower()
            return
        self._may_fall_back = False
        self._node.get_logger().info(f'{self.topic} is published best effort; subscribing with best effort')
        self._node.destroy_subscription(self._subscription)
        qos = copy.copy(self._qos)  # including the overrides, which rclpy has written into it
        qos.reliability = ReliabilityPolicy.BEST_EFFORT
        self._subscription = self._subscribe(qos, None)


def _check_overrides(node: Node, topic: str) -> list[QoSPolicyKind]:
    """Returns the QoS policies of a topic that parameters override.

    Raises:
        RosError: a value is not allowed.
    """
    names = {policy: QOS_OVERRIDE.format(topic, policy.name.lower()) for policy in OVERRIDABLE}
    overridden = [policy for policy, name in names.items() if node.has_parameter(name)]
    for policy in overridden:
        value = node.get_parameter(names[policy]).value
        choices = CHOICES.get(policy)
        if choices and value not in choices:
            raise RosError(f"{names[policy]} = '{value}': expected one of {', '.join(choices)}")
        if not choices and not (type(value) is int and value >= 1):
            raise RosError(f'{names[policy]} = {value}: expected a whole number at least 1')
    return overridden


def unused_overrides(node: Node, topics: Sequence[str]) -> list[str]:
    """Returns the QoS override parameters that match none of the topics: misspelt, or named before remapping.

    Args:
        node: the node that has the parameters.
        topics: names on the graph.
    """
    used = {QOS_OVERRIDE.format(topic, policy.name.lower()) for topic in topics for policy in OVERRIDABLE}
    given = [QOS_OVERRIDES + name for name in node.get_parameters_by_prefix(QOS_OVERRIDES.rstrip('.'))]
    ignored = tuple(QOS_OVERRIDES + topic for topic in RCLPY_TOPICS)
    return sorted(name for name in given if name not in used and not name.startswith(ignored))
