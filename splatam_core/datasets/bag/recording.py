"""What a bag holds: its topics, the time it covers, and its messages."""

from __future__ import annotations

import logging
import weakref
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from types import TracebackType
from typing import Any

from rosbags.interfaces import Connection

from splatam_core.datasets.bag import realsense
from splatam_core.datasets.bag.qos import OfferedQos
from splatam_core.datasets.bag.storage import Storage, open_storage, read_errors
from splatam_core.datasets.bag.typestore import FLOAT32, IMAGE, IMAGES, deserialize
from splatam_core.errors import DatasetError

DEPTH_ENCODINGS = ('16uc1', 'mono16', '32fc1')
NUM_TRIED = 10  # messages at the beginning of a topic of which one must be readable

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class RecordedTopic:
    """A topic of a bag.

    Attributes:
        name: as recorded.
        type_names: the types of its messages, such as ``sensor_msgs/msg/Image``, sorted; more than one is a rare fault.
        offered: the QoS of each of its publishers, as far as recorded.
        num_messages: number of messages that the bag states.
    """

    name: str
    type_names: tuple[str, ...]
    offered: tuple[OfferedQos, ...]
    num_messages: int

    @property
    def type_name(self) -> str:
        """The type of its messages; the first one if there are several."""
        return self.type_names[0]

    @property
    def is_image(self) -> bool:
        """True if it carries images, raw or compressed."""
        return self.type_name in IMAGES


@dataclass(frozen=True, slots=True)
class RawMessage:
    """A serialized message of a bag.

    Attributes:
        topic: name of its topic, as recorded.
        time_ns: time of recording.
        data: its CDR bytes; empty if it is damaged.
    """

    topic: str
    time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class ImageFacts:
    """What the first image on a topic states.

    Attributes:
        encoding: of its pixels; of a compressed image, its format.
        frame_id: its coordinate frame.
    """

    encoding: str
    frame_id: str


class Recording:
    """A bag: rosbag2 (folder, ``.db3`` or ``.mcap``) or ROS 1 (``.bag``). Use it as a context manager, or drop it.

    Every iteration over messages reads from files of its own, so several may go on at the same time, also in different
    threads. Files stay open for the next iteration, because opening can take long (a compressed file is decompressed).

    Attributes:
        path: the bag.
        topics: by name.
        start_ns: time of recording of the first message.
        end_ns: time of recording of the last message.
    """

    def __init__(self, path: Path) -> None:
        """Open a bag. Warns if messages are missing.

        Raises:
            DatasetError: there is no such bag, it cannot be read, or it holds no message.
        """
        self.path = path
        self._is_damaged = False
        self._idle: list[Storage] = []
        self._facts: dict[str, ImageFacts | None] = {}
        self._closed_once = weakref.finalize(self, _close_all, self._idle)
        self._read_topics()
        if not any(topic.num_messages for topic in self.topics.values()):
            self.close()
            raise DatasetError(f'{path}: the bag is empty: there is no message on any topic; was anything recorded?')

    def _read_topics(self) -> None:
        with read_errors(self.path), self._storage() as storage:
            self.start_ns, self.end_ns = storage.start_ns, storage.end_ns
            self.topics = _topics(storage)
            for note in storage.notes:
                _log.warning('%s: %s', self.path, note)

    def salvage(self) -> bool:
        """Search the files for messages that are whole, after an iteration failed. Returns False if that cannot help.

        Raises:
            DatasetError: there are none.
        """
        if self._is_damaged:
            return False
        self._is_damaged = True
        _close_all(self._idle)
        self._facts.clear()
        self._read_topics()
        return True

    @property
    def duration_s(self) -> float:
        """Seconds from the first message to the last."""
        return (self.end_ns - self.start_ns) / 1e9

    def topics_of(self, *type_names: str) -> list[str]:
        """Returns the names of the topics of some types that have messages, sorted."""
        return sorted(name for name, topic in self.topics.items() if topic.num_messages and topic.type_name in type_names)

    def messages(self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None) -> Iterator[RawMessage]:
        """Iterate over messages in the order of their recording. A damaged message has no bytes.

        Args:
            topics: names of the topics to read.
            start_ns: skip messages recorded before this time.
            stop_ns: skip messages recorded at this time or later.

        Raises:
            DatasetError: the files are damaged.
        """
        with read_errors(self.path), self._storage() as storage:
            connections = [connection for connection in storage.connections if connection.topic in topics]
            if not connections:  # an empty list would mean all of them
                return
            for connection, time_ns, data in storage.messages(connections, start_ns, stop_ns):
                yield RawMessage(connection.topic, time_ns, data)

    def last_before(self, topics: Collection[str], time_ns: int) -> list[RawMessage]:
        """Returns the last message of each topic that was recorded before a time.

        It searches backwards, because most topics have a message shortly before.

        Raises:
            DatasetError: the files are damaged.
        """
        found: dict[str, RawMessage] = {}
        stop_ns, span_ns = time_ns, 10**9
        while (missing := set(topics) - found.keys()) and stop_ns > self.start_ns:
            start_ns = max(stop_ns - span_ns, self.start_ns)
            found |= {message.topic: message for message in self.messages(missing, start_ns, stop_ns)}
            stop_ns, span_ns = start_ns, 8 * span_ns
        return list(found.values())

    def decode(self, topic: str, data: bytes) -> Any:
        """Deserialize a message of a topic.

        Raises:
            DatasetError: the bytes are no such message.
        """
        with read_errors(self.path):
            return deserialize(self.topics[topic].type_name, data)

    def encoding(self, topic: str) -> str | None:
        """Returns the encoding of the first image on a topic (of a compressed image, its format); None without images."""
        facts = self.image_facts(topic)
        return None if facts is None else facts.encoding

    def image_facts(self, topic: str) -> ImageFacts | None:
        """Returns what the first image on a topic states; None if none of the first ten messages is one."""
        if topic not in self._facts:
            found = (self._read_facts(message) for message in islice(self.messages([topic]), NUM_TRIED))
            self._facts[topic] = next((facts for facts in found if facts is not None), None)
        return self._facts[topic]

    def _read_facts(self, message: RawMessage) -> ImageFacts | None:
        try:
            image = self.decode(message.topic, message.data)
        except DatasetError:
            return None
        is_raw = self.topics[message.topic].type_name == IMAGE
        return ImageFacts(image.encoding if is_raw else image.format, image.header.frame_id)

    def depth_unit_m(self, topic: str) -> float | None:
        """Returns the metres per count of a depth topic that the bag states, as RealSense Viewer does; None if it states none."""
        unit_topic = realsense.unit_topic(topic)
        if unit_topic in self.topics_of(FLOAT32):
            for message in islice(self.messages([unit_topic]), 1):
                return realsense.unit_m(message.data[4:8])
        with read_errors(self.path), self._storage() as storage:
            return realsense.unit_m(storage.trailing(topic))

    def is_depth(self, topic: str) -> bool:
        """Returns True if an image topic carries depth, judged by its first message and, if compressed, by its name."""
        encoding = self.encoding(topic)
        if encoding is None:
            return False
        if self.topics[topic].type_name == IMAGE:
            return encoding.lower() in DEPTH_ENCODINGS
        return 'compressedDepth' in encoding or encoding.lower().startswith(DEPTH_ENCODINGS) or 'depth' in topic.lower()

    def close(self) -> None:
        """Close the files."""
        self._closed_once()

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self.close()

    @contextmanager
    def _storage(self) -> Iterator[Storage]:
        """Lend an open storage that nobody else reads from."""
        storage = self._idle.pop() if self._idle else open_storage(self.path, is_damaged=self._is_damaged)
        try:
            yield storage
        finally:
            if self._closed_once.alive:
                self._idle.append(storage)
            else:
                storage.close()


def _topics(storage: Storage) -> dict[str, RecordedTopic]:
    by_name: dict[str, list[Connection]] = {}
    for connection in storage.connections:
        by_name.setdefault(connection.topic, []).append(connection)
    return {
        name: RecordedTopic(
            name,
            tuple(sorted({storage.type_name(connection) for connection in connections})),
            tuple(qos for connection in connections for qos in storage.offered(connection)),
            sum(connection.msgcount for connection in connections),
        )
        for name, connections in by_name.items()
    }


def _close_all(storages: list[Storage]) -> None:
    while storages:
        storages.pop().close()
