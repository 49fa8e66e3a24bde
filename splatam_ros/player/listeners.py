"""Who listens to the player, and what they answer."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from splatam_ros.player.recording import COLOR_OR_DEPTH, message_class, stamp_of, starts_with_stamp
from splatam_ros.process import RosError


class Answers:
    """The stamps of messages on a topic: each says that the frame of this stamp is done."""

    def __init__(self, node: Node, topic: str, on_answer: Callable[[int], None]) -> None:
        """Prepare; ``discover`` subscribes as soon as somebody publishes the topic.

        Args:
            node: to subscribe with.
            topic: of any type that begins with a header.
            on_answer: called by the executor with each stamp, ns.
        """
        self.topic = topic
        self._node = node
        self._on_answer = on_answer
        self._is_subscribed = False

    def discover(self) -> bool:
        """Subscribe if somebody publishes by now. Whether we are subscribed.

        Raises:
            RosError: the topic's type is not installed, or has no header.
        """
        if not self._is_subscribed:
            for publisher in self._node.get_publishers_info_by_topic(self.topic)[:1]:
                cls = self._message_class(publisher.topic_type)
                qos = QoSProfile(depth=10, reliability=publisher.qos_profile.reliability)
                self._node.create_subscription(cls, self.topic, self._receive, qos, raw=True)
                self._is_subscribed = True
        return self._is_subscribed

    @property
    def is_gone(self) -> bool:
        """Whether the topic was there and has no publisher any more."""
        return self._is_subscribed and self._node.count_publishers(self.topic) == 0

    def _message_class(self, type_name: str) -> type:
        try:
            cls = message_class(type_name)
        except LookupError as error:
            raise RosError(f'--wait-for {self.topic}: {error}') from None
        if not starts_with_stamp(cls):
            raise RosError(f'--wait-for {self.topic}: its type {type_name} has no header, so no stamp to wait for')
        return cls

    def _receive(self, data: bytes) -> None:
        self._on_answer(stamp_of(data))


class Listeners:
    """The subscribers that the player waits for, and must not lose on the way."""

    def __init__(self, node: Node, publishers: Mapping[str, Publisher]) -> None:
        """Watch some topics.

        Args:
            node: to ask the graph with.
            publishers: by name of the topic on the graph.
        """
        self._node = node
        self._publishers = publishers
        self._watched: set[str] = set()

    @property
    def heard(self) -> list[str]:
        """The topics that somebody subscribes to."""
        return [topic for topic, publisher in self._publishers.items() if publisher.get_subscription_count() > 0]

    @property
    def unheard(self) -> list[str]:
        """The topics that nobody subscribes to."""
        heard = self.heard
        return [topic for topic in self._publishers if topic not in heard]

    def watch(self) -> None:
        """From now on ``gone`` tells which of the topics heard now are heard no more."""
        self._watched = set(self.heard)

    @property
    def gone(self) -> list[str]:
        """Watched topics that have lost their last subscriber."""
        return sorted(self._watched.intersection(self.unheard))

    def image_topics_wanted(self, besides: Collection[str]) -> list[str]:
        """Image topics on the graph that somebody subscribes to."""
        return sorted(
            topic
            for topic, types in self._node.get_topic_names_and_types()
            if topic not in besides and set(types).intersection(COLOR_OR_DEPTH) and self._node.count_subscribers(topic)
        )
