"""One subscribed input topic."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.event_handler import QoSRequestedIncompatibleQoSInfo, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

DEPTH = 10


class Input:
    """A subscription that settles for best effort when a publisher offers no better.

    A best-effort subscription would take both kinds of publisher, but loses large images from either.

    Attributes:
        topic: its name on the graph.
        is_incompatible: whether a publisher offers less than what was asked for.
        received: messages so far.
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
        self.is_incompatible = False
        self.received = 0
        self._node = node
        self._message_class = message_class
        self._name = topic
        self._on_message = on_message
        self._may_fall_back = reliability == 'auto'
        self._keep_all = keep_all
        self._subscription = self._subscribe(
            ReliabilityPolicy.BEST_EFFORT if reliability == 'best_effort' else ReliabilityPolicy.RELIABLE
        )

    @property
    def topic(self) -> str:
        """Name on the graph, after remapping."""
        return self._subscription.topic_name

    @property
    def num_publishers(self) -> int:
        """Publishers on the graph, compatible or not."""
        return self._node.count_publishers(self.topic)

    def close(self) -> None:
        """Take no more messages."""
        self._node.destroy_subscription(self._subscription)

    def _subscribe(self, reliability: ReliabilityPolicy) -> Subscription:
        history = HistoryPolicy.KEEP_ALL if self._keep_all else HistoryPolicy.KEEP_LAST
        return self._node.create_subscription(
            self._message_class, self._name, self._receive,
            QoSProfile(history=history, depth=DEPTH, reliability=reliability),
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=self._on_incompatible),
        )  # fmt: skip

    def _receive(self, message: Any) -> None:
        self.received += 1
        self._on_message(message)

    def _on_incompatible(self, event: QoSRequestedIncompatibleQoSInfo) -> None:
        if not self._may_fall_back:
            self.is_incompatible = True
            return
        self._may_fall_back = False
        self._node.get_logger().info(f'{self.topic} is published best effort: subscribing to it best effort')
        self._node.destroy_subscription(self._subscription)
        self._subscription = self._subscribe(ReliabilityPolicy.BEST_EFFORT)
