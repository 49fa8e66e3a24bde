"""Opens the files of a bag and iterates over their messages, whatever the storage format."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from rosbags import rosbag2
from rosbags.interfaces import Connection, ConnectionExtRosbag2

from splatam_core.datasets.bag.qos import OfferedQos, offered_qos
from splatam_core.datasets.bag.ros1 import ROS1_SUFFIX, Rosbag1
from splatam_core.errors import DatasetError, SplatamError

ROSBAG2_SUFFIXES = ('.db3', '.mcap')


class Storage(Protocol):
    """An open bag. Only one iterator at a time may read from it, because iterators share the file position.

    Attributes:
        connections: one for each recorded publisher, or one for several publishers of the same topic.
        start_ns: time of recording of the first message.
        end_ns: time of recording of the last message.
    """

    connections: Sequence[Connection]
    start_ns: int
    end_ns: int

    def type_name(self, connection: Connection) -> str:
        """Returns the ROS 2 name of the messages' type, such as ``sensor_msgs/msg/Image``."""
        ...

    def offered(self, connection: Connection) -> tuple[OfferedQos, ...]:
        """Returns the QoS that the publishers offered, as far as it was recorded."""
        ...

    def messages(
        self, connections: Sequence[Connection], start_ns: int | None, stop_ns: int | None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """Iterate over (connection, time of recording, CDR bytes) in order of time, from ``start_ns`` to before ``stop_ns``."""
        ...

    def close(self) -> None:
        """Close the files."""
        ...


class Rosbag2:
    """A rosbag2: a folder with ``metadata.yaml``, or a single ``.db3`` or ``.mcap`` file; compressed ones too."""

    def __init__(self, path: Path) -> None:
        self._reader = rosbag2.Reader(path)
        self._reader.open()
        self.connections: Sequence[Connection] = self._reader.connections
        self.start_ns, self.end_ns = self._reader.start_time, self._reader.end_time - 1

    def type_name(self, connection: Connection) -> str:
        """See ``Storage``."""
        return connection.msgtype

    def offered(self, connection: Connection) -> tuple[OfferedQos, ...]:
        """See ``Storage``."""
        assert isinstance(connection.ext, ConnectionExtRosbag2)
        return tuple(map(offered_qos, connection.ext.offered_qos_profiles))

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


def open_storage(path: Path) -> Storage:
    """Open a bag.

    Raises:
        DatasetError: there is no such bag, or it cannot be read.
    """
    if not path.exists():
        raise DatasetError(f'{path}: there is no such file or folder')
    _check_closed(path)
    with read_errors(path):
        return Rosbag1(path) if path.suffix == ROS1_SUFFIX else Rosbag2(path)


def is_bag(path: Path) -> bool:
    """Returns True if a path has the name of a bag or a folder has the files of one; nothing is opened."""
    if path.is_dir():
        return (path / 'metadata.yaml').is_file() or bool(_storage_files(path))
    return path.suffix in (*ROSBAG2_SUFFIXES, ROS1_SUFFIX) and path.is_file()


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


def _check_closed(path: Path) -> None:
    """Refuse a folder without metadata: the recording was interrupted."""
    if not path.is_dir() or (path / 'metadata.yaml').exists():
        return
    if files := _storage_files(path):
        raise DatasetError(
            f'{path}: there is no metadata.yaml, the recording was not closed; run "ros2 bag reindex {path.name}" '
            f'or open {files[0]} itself'
        )


def _storage_files(folder: Path) -> list[str]:
    return sorted(file.name for suffix in ROSBAG2_SUFFIXES for file in folder.glob(f'*{suffix}'))
