"""The files of recordings: rosbag2, and ROS 1 bags whose messages are turned into ROS 2's on the way."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Protocol

from rosbags import rosbag1, rosbag2
from rosbags.convert.converter import LATCH, STATIC_MSGTYPE_RENAMES, generate_message_converter
from rosbags.interfaces import Connection, Qos
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

HEADER = 'std_msgs/msg/Header'


class Storage(Protocol):
    """An open recording.

    Attributes:
        connections: one for each recorded publisher, or one for several of the same topic.
        start_ns: time of the first message.
        end_ns: time of the last one.
        num_messages: of all topics.
    """

    connections: Sequence[Connection]
    start_ns: int
    end_ns: int
    num_messages: int

    def type_name(self, connection: Connection) -> str:
        """The ROS 2 name of its messages' type."""
        ...

    def offered(self, connection: Connection) -> Sequence[Qos]:
        """What its publishers offered, as far as that was recorded."""
        ...

    def messages(
        self, connections: Sequence[Connection], start_ns: int | None, stop_ns: int | None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """(connection, time, CDR) in the order of time, from ``start_ns`` to before ``stop_ns``."""
        ...

    def close(self) -> None:
        """Close the files."""
        ...


def open_storage(path: Path) -> Storage:
    """Open a recording; whatever the libraries below raise comes through."""
    return Rosbag1(path) if path.suffix == '.bag' else Rosbag2(path)


class Rosbag2:
    """A rosbag2: a folder, or a single .db3 or .mcap file."""

    def __init__(self, path: Path) -> None:
        self._reader = rosbag2.Reader(path)
        self._reader.open()
        self.connections: Sequence[Connection] = self._reader.connections
        self.start_ns, self.end_ns = self._reader.start_time, self._reader.end_time - 1
        self.num_messages = self._reader.message_count

    def type_name(self, connection: Connection) -> str:
        """See ``Storage``."""
        return connection.msgtype

    def offered(self, connection: Connection) -> Sequence[Qos]:
        """See ``Storage``."""
        return connection.ext.offered_qos_profiles

    def messages(
        self, connections: Sequence[Connection], start_ns: int | None, stop_ns: int | None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """See ``Storage``."""
        for connection, time_ns, data in self._reader.messages(connections, start_ns, stop_ns):
            yield connection, time_ns, bytes(data)

    def close(self) -> None:
        """See ``Storage``."""
        if self._reader.is_open:
            self._reader.close()


class Rosbag1:
    """A ROS 1 bag. Fields that only one side knows are left out or zero."""

    def __init__(self, path: Path) -> None:
        self._reader = rosbag1.Reader(path)
        self._reader.open()
        self.connections: Sequence[Connection] = self._reader.connections
        self.start_ns, self.end_ns = self._reader.start_time, self._reader.end_time - 1
        self.num_messages = self._reader.message_count
        self._ros2 = get_typestore(Stores.ROS2_JAZZY)
        self._to_cdr: dict[int, Callable[[bytes], memoryview]] = {}

    def type_name(self, connection: Connection) -> str:
        """See ``Storage``."""
        return STATIC_MSGTYPE_RENAMES.get(connection.msgtype, connection.msgtype)

    def offered(self, connection: Connection) -> Sequence[Qos]:
        """See ``Storage``."""
        return LATCH if connection.ext.latching else ()

    def messages(
        self, connections: Sequence[Connection], start_ns: int | None, stop_ns: int | None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """See ``Storage``."""
        for connection, time_ns, data in self._reader.messages(connections, start_ns, stop_ns):
            if connection.id not in self._to_cdr:
                self._to_cdr[connection.id] = self._converter(connection)
            yield connection, time_ns, bytes(self._to_cdr[connection.id](data))

    def close(self) -> None:
        """See ``Storage``."""
        if self._reader.bio is not None:
            self._reader.close()

    def _converter(self, connection: Connection) -> Callable[[bytes], memoryview]:
        """How the messages of a connection become CDR, by the definition that the bag holds of their type."""
        source = get_typestore(Stores.EMPTY)
        source.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
        target = self.type_name(connection)
        if target not in self._ros2.fielddefs:
            self._adopt(source, connection.msgtype, target)
        return generate_message_converter(source, self._ros2, connection.msgtype, target, {}, src_is2=False, dst_is2=True)

    def _adopt(self, source: Typestore, name: str, target: str) -> None:
        """Take a type of somebody's own package over from the bag; its ROS 2 package is installed."""
        definition, _ = source.generate_msgdef(name, ros_version=2)
        types = get_types_from_msg(definition, target)
        types.pop(HEADER, None)
        self._ros2.register(types)
