"""What a bag holds: its topics, the time it covers, and its messages."""

from __future__ import annotations

import weakref
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from rosbags.interfaces import Connection

from splatam_core.datasets.bag.qos import OfferedQos
from splatam_core.datasets.bag.storage import Storage, open_storage, read_errors
from splatam_core.datasets.bag.typestore import IMAGE, IMAGES, deserialize
from splatam_core.errors import DatasetError

DEPTH_ENCODINGS = ('16uc1', 'mono16', '32fc1')


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
        data: its CDR bytes.
    """

    topic: str
    time_ns: int
    data: bytes


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
        """Open a bag.

        Raises:
            DatasetError: there is no such bag, it cannot be read, or it holds no message.
        """
        self.path = path
        self._idle: list[Storage] = []
        self._encodings: dict[str, str | None] = {}
        self._closed_once = weakref.finalize(self, _close_all, self._idle)
        with read_errors(path), self._storage() as storage:
            self.start_ns, self.end_ns = storage.start_ns, storage.end_ns
            self.topics = _topics(storage)
        if not any(topic.num_messages for topic in self.topics.values()):
            self.close()
            raise DatasetError(f'{path}: the bag is empty: there is no message on any topic; was anything recorded?')

    @property
    def duration_s(self) -> float:
        """Seconds from the first message to the last."""
        return (self.end_ns - self.start_ns) / 1e9

    def topics_of(self, *type_names: str) -> list[str]:
        """Returns the names of the topics of some types that have messages, sorted."""
        return sorted(name for name, topic in self.topics.items() if topic.num_messages and topic.type_name in type_names)

    def messages(self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None) -> Iterator[RawMessage]:
        """Iterate over messages in the order of their recording.

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

    def decode(self, topic: str, data: bytes) -> Any:
        """Deserialize a message of a topic.

        Raises:
            DatasetError: the bytes are no such message.
        """
        with read_errors(self.path):
            return deserialize(self.topics[topic].type_name, data)

    def encoding(self, topic: str) -> str | None:
        """Returns the encoding of the first image on a topic (of a compressed image, its format); None without messages."""
        if topic not in self._encodings:
            first = next(self.messages([topic]), None)
            message = None if first is None else self.decode(topic, first.data)
            is_raw = self.topics[topic].type_name == IMAGE
            self._encodings[topic] = None if message is None else message.encoding if is_raw else message.format
        return self._encodings[topic]

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
        storage = self._idle.pop() if self._idle else open_storage(self.path)
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
