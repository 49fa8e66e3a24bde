"""Opens the files of a bag and iterates over their messages, whatever the storage format."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from rosbags.interfaces import Connection

from splatam_core.datasets.bag.names import ROS1_SUFFIX
from splatam_core.datasets.bag.qos import OfferedQos
from splatam_core.datasets.bag.ros1 import Rosbag1
from splatam_core.datasets.bag.rosbag2 import Rosbag2
from splatam_core.errors import DatasetError, SplatamError


class Storage(Protocol):
    """An open bag. Only one iterator at a time may read from it, because iterators share the file position.

    Attributes:
        connections: one for each recorded publisher, or one for several publishers of the same topic.
        start_ns: time of recording of the first message.
        end_ns: time of recording of the last message.
        notes: what is missing, in words.
    """

    connections: Sequence[Connection]
    start_ns: int
    end_ns: int
    notes: list[str]

    def type_name(self, connection: Connection) -> str:
        """Returns the ROS 2 name of the messages' type, such as ``sensor_msgs/msg/Image``."""
        ...

    def offered(self, connection: Connection) -> tuple[OfferedQos, ...]:
        """Returns the QoS that the publishers offered, as far as it was recorded."""
        ...

    def trailing(self, topic: str) -> bytes:
        """Returns the bytes that follow the first message of a topic in its record; empty where there are none."""
        ...

    def messages(
        self, connections: Sequence[Connection], start_ns: int | None, stop_ns: int | None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Iterate over (connection, time of recording, CDR bytes) in order of time, from ``start_ns`` to before ``stop_ns``.

        A message that cannot be unpacked or converted has no bytes.
        """
        ...

    def close(self) -> None:
        """Close the files."""
        ...


def open_storage(path: Path, *, is_damaged: bool = False) -> Storage:
    """Open a bag.

    Args:
        path: the bag.
        is_damaged: True to search the files for messages that are whole.

    Raises:
        DatasetError: there is no such bag, or it cannot be read.
    """
    if not path.exists():
        raise DatasetError(f'{path}: there is no such file or folder')
    with read_errors(path):
        return Rosbag1(path, is_damaged=is_damaged) if path.suffix == ROS1_SUFFIX else Rosbag2(path, is_damaged=is_damaged)


@contextmanager
def read_errors(path: Path) -> Iterator[None]:
    """Turn what the storage libraries raise on damaged files into one ``DatasetError``.

    They raise a dozen types (apsw, lz4, struct, assertions, ...).
    """
    try:
        yield
    except SplatamError:
        raise
    except Exception as error:
        kind = 'a ROS 1 bag' if path.suffix == ROS1_SUFFIX else 'a rosbag2'
        reason = ' '.join(str(error).split()) or type(error).__name__
        raise DatasetError(f'{path}: cannot be read as {kind}, it may be truncated: {reason}') from error
