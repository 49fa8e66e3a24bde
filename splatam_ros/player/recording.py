"""A recording as raw messages, the way the player wants them: nothing is decoded."""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import TracebackType

from rclpy.serialization import deserialize_message
from rosbags.interfaces import Connection, Qos, QosDurability

from splatam_core.errors import DatasetError
from splatam_ros.player.storage import Storage, open_storage

COLOR_OR_DEPTH = ('sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage')
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
DEPTH_ENCODINGS = ('16uc1', '32fc1', 'mono16')
HEADER_TYPE = 'std_msgs/Header'
STATIC_TRANSFORMS = '/tf_static'


@dataclass(frozen=True, slots=True)
class RecordedTopic:
    """A topic of a recording.

    Attributes:
        name: as recorded.
        type_name: e.g. ``sensor_msgs/msg/Image``.
        message_class: rclpy's class of that type.
        offered: the QoS of each of its publishers, as far as recorded.
    """

    name: str
    type_name: str
    message_class: type
    offered: tuple[Qos, ...]

    @property
    def is_image(self) -> bool:
        """Whether it carries images, raw or compressed."""
        return self.type_name in COLOR_OR_DEPTH

    @property
    def is_latched(self) -> bool:
        """Whether who comes late gets the last messages too; of ``/tf_static`` everybody expects that."""
        if self.name == STATIC_TRANSFORMS:
            return True
        return bool(self.offered) and all(qos.durability is QosDurability.TRANSIENT_LOCAL for qos in self.offered)


@dataclass(frozen=True, slots=True)
class RawMessage:
    """A message as it lies in the recording.

    Attributes:
        topic: name of its topic, as recorded.
        time_ns: when it was recorded.
        data: its CDR bytes.
    """

    topic: str
    time_ns: int
    data: bytes


class Recording:
    """An open rosbag2 (folder, .db3 or .mcap) or ROS 1 bag (.bag). Use as a context manager.

    Attributes:
        topics: by name, those that can be published here.
        skipped: name to reason, those that cannot.
        start_ns: time of the first message.
        end_ns: time of the last one.
    """

    def __init__(self, path: Path) -> None:
        """Open it.

        Raises:
            DatasetError: it is no recording, cannot be read, or holds no message.
        """
        self.path = path
        with self._read_errors():
            self._storage: Storage = open_storage(path)
        self.start_ns, self.end_ns = self._storage.start_ns, self._storage.end_ns
        self.topics: dict[str, RecordedTopic] = {}
        self.skipped: dict[str, str] = {}
        for name, connections in self._connections().items():
            self._add_topic(name, connections)
        if self._storage.num_messages == 0:
            self.close()
            raise DatasetError(f'{path}: the recording holds no message')

    @property
    def duration_s(self) -> float:
        """Seconds from the first message to the last."""
        return (self.end_ns - self.start_ns) / 1e9

    def messages(self, topics: Collection[str], start_ns: int | None = None, stop_ns: int | None = None) -> Iterator[RawMessage]:
        """Messages in the order of their recording.

        Args:
            topics: names of those to read.
            start_ns: leave out what was recorded before.
            stop_ns: leave out what was recorded at or after this.

        Raises:
            DatasetError: the files are damaged.
        """
        connections = [connection for connection in self._storage.connections if connection.topic in topics]
        if not connections:  # an empty list would mean all
            return
        with self._read_errors():
            for connection, time_ns, data in self._storage.messages(connections, start_ns, stop_ns):
                yield RawMessage(connection.topic, time_ns, data)

    def is_depth(self, topic: str) -> bool:
        """Whether an image topic carries depth, by what its first message says."""
        first = next(self.messages([topic]), None)
        if first is None:
            return False
        with self._read_errors():
            message = deserialize_message(first.data, self.topics[topic].message_class)
        if self.topics[topic].type_name == 'sensor_msgs/msg/CompressedImage':
            return 'compressedDepth' in message.format or 'depth' in topic
        return message.encoding.lower() in DEPTH_ENCODINGS

    def close(self) -> None:
        """Close the files."""
        self._storage.close()

    def __enter__(self) -> Recording:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self.close()

    def _connections(self) -> dict[str, list[Connection]]:
        by_name: dict[str, list[Connection]] = {}
        for connection in self._storage.connections:
            by_name.setdefault(connection.topic, []).append(connection)
        return by_name

    def _add_topic(self, name: str, connections: list[Connection]) -> None:
        type_names = {self._storage.type_name(connection) for connection in connections}
        if len(type_names) > 1:
            self.skipped[name] = f'it has several types: {", ".join(sorted(type_names))}'
            return
        type_name = type_names.pop()
        try:
            cls = message_class(type_name)
        except LookupError as error:
            self.skipped[name] = str(error)
            return
        offered = tuple(qos for connection in connections for qos in self._storage.offered(connection))
        self.topics[name] = RecordedTopic(name, type_name, cls, offered)

    @contextmanager
    def _read_errors(self) -> Iterator[None]:
        """What storage libraries raise on damaged files is theirs (apsw, lz4, struct, ...); users see one kind."""
        try:
            yield
        except FileNotFoundError as error:
            raise DatasetError(f'{self.path}: {error}') from None
        except Exception as error:
            kind = 'a ROS 1 bag' if self.path.suffix == '.bag' else 'rosbag2'
            reason = ' '.join(str(error).split()) or type(error).__name__
            raise DatasetError(f'{self.path}: cannot be read as {kind}: {reason}') from error


def message_class(type_name: str) -> type:
    """Rclpy's class of a message type such as ``sensor_msgs/msg/Image``.

    Raises:
        LookupError: the type is not installed here.
    """
    package, _, name = type_name.partition('/msg/')
    try:
        return getattr(import_module(f'{package}.msg'), name)
    except (ModuleNotFoundError, AttributeError):
        raise LookupError(f'its type {type_name} is not installed') from None


def starts_with_stamp(cls: type) -> bool:
    """Whether messages of a class begin with a header, or are one."""
    fields = cls.get_fields_and_field_types()  # type: ignore[attr-defined]
    return next(iter(fields.items()), None) in (('header', HEADER_TYPE), ('stamp', 'builtin_interfaces/Time'))


def stamp_of(data: bytes) -> int:
    """Stamp (ns) of serialized message that ``starts_with_stamp``."""
    order = '<' if data[1] & 1 else '>'  # second byte of the CDR encapsulation
    seconds, nanoseconds = struct.unpack_from(f'{order}iI', data, 4)
    return seconds * 1_000_000_000 + nanoseconds
