"""The subscribers that the player plays for, and the topics on which they report processed frames."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from msg_adapters.errors import MessageError
from msg_adapters.factory import message_class
from msg_adapters.stamps import serialized_stamp_ns
from splatam_core.datasets.bag.typestore import IMAGES
from splatam_ros.process import RosError

HEADER = ('header', 'std_msgs/Header')
STAMP = ('stamp', 'builtin_interfaces/Time')


class AnswerTopic:
    """A topic whose messages answer frames: a message means that the frame with its stamp has been processed.

    Attributes:
        name: of the topic.
    """

    def __init__(self, node: Node, name: str, on_answer: Callable[[int], None]) -> None:
        """Prepare; ``discover`` subscribes once the topic has a publisher.

        Args:
            node: subscribes.
            name: of the topic, whose type must begin with a header or a stamp.
            on_answer: called by the executor with each stamp in nanoseconds.
        """
        self.name = name
        self._node = node
        self._on_answer = on_answer
        self._is_subscribed = False

    def discover(self) -> bool:
        """Subscribe if the topic has a publisher by now. Returns True once subscribed.

        Raises:
            RosError: the topic's type is not installed, or has no header.
        """
        if not self._is_subscribed:
            for publisher in self._node.get_publishers_info_by_topic(self.name)[:1]:
                cls = self._message_class(publisher.topic_type)
                qos = QoSProfile(depth=10, reliability=publisher.qos_profile.reliability)
                self._node.create_subscription(cls, self.name, self._receive, qos, raw=True)
                self._is_subscribed = True
        return self._is_subscribed

    @property
    def is_gone(self) -> bool:
        """True if the topic had a publisher and has none any more."""
        return self._is_subscribed and self._node.count_publishers(self.name) == 0

    def _message_class(self, type_name: str) -> type:
        try:
            cls = message_class(type_name)
        except MessageError as error:
            raise RosError(f'--wait-for {self.name}: {error}') from None
        fields = cls.get_fields_and_field_types()  # type: ignore[attr-defined]  # every message class of rclpy has it
        if next(iter(fields.items()), None) not in (HEADER, STAMP):
            raise RosError(f'--wait-for {self.name}: its type {type_name} has no header, so no stamp to wait for')
        return cls

    def _receive(self, data: bytes) -> None:
        try:
            self._on_answer(serialized_stamp_ns(data))
        except MessageError as error:
            self._node.get_logger().warning(f'an answer on {self.name} is ignored: {error}', throttle_duration_sec=10.0)


class Listeners:
    """The subscribers of some published topics: the player waits for them, and stops when they leave."""

    def __init__(self, node: Node, publishers: Mapping[str, Publisher]) -> None:
        """Choose the topics.

        Args:
            node: asks the graph.
            publishers: by name of the topic on the graph.
        """
        self._node = node
        self._publishers = publishers
        self._watched: set[str] = set()

    @property
    def subscribed(self) -> list[str]:
        """The topics that have a subscriber."""
        return [topic for topic, publisher in self._publishers.items() if publisher.get_subscription_count() > 0]

    @property
    def unsubscribed(self) -> list[str]:
        """The topics that have no subscriber."""
        subscribed = self.subscribed
        return [topic for topic in self._publishers if topic not in subscribed]

    def watch(self) -> None:
        """Remember which topics have subscribers now, for ``lost``."""
        self._watched = set(self.subscribed)

    @property
    def lost(self) -> list[str]:
        """Topics that had a subscriber when ``watch`` was called and have none any more."""
        return sorted(self._watched.intersection(self.unsubscribed))

    def image_topics_wanted(self, besides: Collection[str]) -> list[str]:
        """Returns other image topics on the graph that have a subscriber."""
        return sorted(
            topic
            for topic, types in self._node.get_topic_names_and_types()
            if topic not in besides and set(types).intersection(IMAGES) and self._node.count_subscribers(topic)
        )
