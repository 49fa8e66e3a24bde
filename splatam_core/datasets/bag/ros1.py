"""ROS 1 bags, whose messages are converted to ROS 2's on reading."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

from rosbags import rosbag1
from rosbags.convert.converter import LATCH, STATIC_MSGTYPE_RENAMES, is_same_wireformat, migrate_bytes
from rosbags.interfaces import Connection, ConnectionExtRosbag1
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from splatam_core.datasets.bag.qos import OfferedQos, offered_qos

ROS1_SUFFIX = '.bag'
HEADER = 'std_msgs/msg/Header'


class Rosbag1:
    """A ROS 1 bag as a ``Storage``. Fields that only one of ROS 1 and ROS 2 has are left out or zero."""

    def __init__(self, path: Path) -> None:
        self._reader = rosbag1.Reader(path)
        self._reader.open()
        self.connections: Sequence[Connection] = self._reader.connections
        self.start_ns, self.end_ns = self._reader.start_time, self._reader.end_time - 1
        self._ros2 = get_typestore(Stores.ROS2_JAZZY)
        self._to_cdr: dict[int, Callable[[bytes], memoryview]] = {}

    def type_name(self, connection: Connection) -> str:
        """See ``Storage``."""
        return STATIC_MSGTYPE_RENAMES.get(connection.msgtype, connection.msgtype)

    def offered(self, connection: Connection) -> tuple[OfferedQos, ...]:
        """See ``Storage``; a latched topic is reliable and transient local."""
        assert isinstance(connection.ext, ConnectionExtRosbag1)
        return tuple(map(offered_qos, LATCH)) if connection.ext.latching else ()

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
        """Returns a function that converts messages of a connection to CDR, by the type's definition in the bag."""
        ros1 = get_typestore(Stores.EMPTY)
        ros1.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
        source, target = connection.msgtype, self.type_name(connection)
        if target not in self._ros2.fielddefs:
            self._adopt(ros1, source, target)
        if is_same_wireformat(ros1, self._ros2, source, target):
            return partial(self._ros2.ros1_to_cdr, typename=target)
        return partial(migrate_bytes, ros1, self._ros2, source, target, {}, src_is2=False, dst_is2=True)

    def _adopt(self, ros1: Typestore, name: str, target: str) -> None:
        """Register the bag's definition of a type that ROS 2 does not define, with ROS 2's header."""
        definition, _ = ros1.generate_msgdef(name, ros_version=2)
        types = get_types_from_msg(definition, target)
        types.pop(HEADER, None)
        self._ros2.register(types)
