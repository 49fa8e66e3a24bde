"""ROS 1 bags, whose messages are converted to ROS 2's on reading."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path

from rosbags import rosbag1
from rosbags.convert.converter import LATCH, STATIC_MSGTYPE_RENAMES, is_same_wireformat, migrate_bytes
from rosbags.interfaces import Connection, ConnectionExtRosbag1
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from splatam_core.datasets.bag.cut_ros1 import CutRosbag1
from splatam_core.datasets.bag.qos import OfferedQos, offered_qos

HEADER = 'std_msgs/msg/Header'


class Rosbag1:
    """A ROS 1 bag as a ``Storage``. Fields that only one of ROS 1 and ROS 2 has are left out or zero."""

    def __init__(self, path: Path, *, is_damaged: bool = False) -> None:
        """Open the file.

        Args:
            path: the bag.
            is_damaged: True to search it for messages that are whole, which takes longer. This is done, too, if it has no index.
        """
        self.notes: list[str] = []
        self._reader = self._open(path, is_damaged)
        self.connections: Sequence[Connection] = self._reader.connections
        self.start_ns, self.end_ns = self._reader.start_time, self._reader.end_time - 1
        self._ros2 = get_typestore(Stores.ROS2_JAZZY)
        self._converters: dict[int, _Converter] = {}

    def _open(self, path: Path, is_damaged: bool) -> rosbag1.Reader:
        if not is_damaged:
            whole = rosbag1.Reader(path)
            with suppress(Exception):  # the library raises a dozen types on damaged files
                whole.open()
                return whole
        cut = CutRosbag1(path)
        cut.open()
        self.notes.append(cut.missing)
        return cut

    def type_name(self, connection: Connection) -> str:
        """See ``Storage``."""
        return STATIC_MSGTYPE_RENAMES.get(connection.msgtype, connection.msgtype)

    def offered(self, connection: Connection) -> tuple[OfferedQos, ...]:
        """See ``Storage``; a latched topic is reliable and transient local."""
        assert isinstance(connection.ext, ConnectionExtRosbag1)
        return tuple(map(offered_qos, LATCH)) if connection.ext.latching else ()

    def trailing(self, topic: str) -> bytes:
        """See ``Storage``; RealSense Viewer puts the unit of depth there."""
        connections = [connection for connection in self.connections if connection.topic == topic]
        first = next(iter(self._reader.messages(connections)), None) if connections else None
        return b'' if first is None else self._converter(first[0]).trailing(first[2])

    def messages(
        self, connections: Sequence[Connection], start_ns: int | None, stop_ns: int | None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """See ``Storage``."""
        for connection, time_ns, data in self._reader.messages(connections, start_ns, stop_ns):
            yield connection, time_ns, self._converter(connection).to_cdr(data)

    def close(self) -> None:
        """See ``Storage``."""
        if self._reader.bio is not None:
            self._reader.close()

    def _converter(self, connection: Connection) -> _Converter:
        if connection.id not in self._converters:
            self._converters[connection.id] = self._make_converter(connection)
        return self._converters[connection.id]

    def _make_converter(self, connection: Connection) -> _Converter:
        """Returns the converter of a connection's messages, by the type's definition in the bag."""
        ros1 = get_typestore(Stores.EMPTY)
        ros1.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
        source, target = connection.msgtype, self.type_name(connection)
        if target not in self._ros2.fielddefs:
            self._adopt(ros1, source, target)
        convert: Callable[[bytes], memoryview]
        if is_same_wireformat(ros1, self._ros2, source, target):
            convert = partial(self._ros2.ros1_to_cdr, typename=target)
        else:
            convert = partial(migrate_bytes, ros1, self._ros2, source, target, {}, src_is2=False, dst_is2=True)
        return _Converter(convert, partial(_length, ros1, source))

    def _adopt(self, ros1: Typestore, name: str, target: str) -> None:
        """Register the bag's definition of a type that ROS 2 does not define, with ROS 2's header."""
        definition, _ = ros1.generate_msgdef(name, ros_version=2)
        types = get_types_from_msg(definition, target)
        types.pop(HEADER, None)
        self._ros2.register(types)


class _Converter:
    """Converts the messages of a connection to CDR. Bytes behind the end of a message are cut off."""

    def __init__(self, convert: Callable[[bytes], memoryview], length: Callable[[bytes], int]) -> None:
        self._convert = convert
        self._length = length
        self._num_trailing = 0

    def to_cdr(self, data: bytes) -> bytes:
        """Returns the CDR bytes of a message; empty if it is damaged."""
        for attempt in (self._cut_as_before, self._cut_by_content):
            try:
                return bytes(self._convert(attempt(data)))
            except Exception:  # noqa: BLE001 - whatever damaged bytes make the library raise
                continue
        return b''

    def trailing(self, data: bytes) -> bytes:
        """Returns the bytes behind the end of a message; empty if it is damaged."""
        try:
            return bytes(data[self._length(data) :])
        except Exception:  # noqa: BLE001 - whatever damaged bytes make the library raise
            return b''

    def _cut_as_before(self, data: bytes) -> bytes:
        return data[: len(data) - self._num_trailing]

    def _cut_by_content(self, data: bytes) -> bytes:
        length = self._length(data)
        self._num_trailing = len(data) - length
        return data[:length]


def _length(store: Typestore, type_name: str, data: bytes) -> int:
    """Returns how many bytes a message of ROS 1 has."""
    definition = store.get_msgdef(type_name)
    _, end = definition.deserialize_ros1(data, 0, definition.cls, store)
    return end
