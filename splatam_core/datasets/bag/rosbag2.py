"""A rosbag2: a folder or a single file, compressed or not, whole or not. What is whole is read; the rest is named."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Protocol

from rosbags import rosbag2
from rosbags.interfaces import Connection, ConnectionExtRosbag2

from splatam_core.datasets.bag.bag_metadata import BagMetadata, read_metadata
from splatam_core.datasets.bag.cut_mcap import CutMcap
from splatam_core.datasets.bag.cut_sqlite import CutSqlite
from splatam_core.datasets.bag.names import SUFFIX, storage_files
from splatam_core.datasets.bag.qos import OfferedQos, offered_qos
from splatam_core.datasets.bag.unpacked import UnpackedFile, journal_of, merged_with_journal, unpacked, unpacked_message
from splatam_core.errors import DatasetError, one_line

Message = tuple[Connection, int, bytes]
TopicKey = tuple[str, str]
"""Name and type of a topic. Files of one bag may disagree about everything else."""


class BagFile(Protocol):
    """One open file of a bag.

    Attributes:
        connections: its topics.
        start_ns: time of recording of the first message.
        end_ns: time of recording of the last message.
        missing: what cannot be read, in words; empty if everything can.
    """

    connections: Sequence[Connection]
    start_ns: int
    end_ns: int
    missing: str

    def messages(self, connections: Sequence[Connection], start_ns: int | None, stop_ns: int | None) -> Iterator[Message]:
        """Iterate over messages in order of time."""
        ...

    def close(self) -> None:
        """Close the file."""
        ...


class WholeFile:
    """A file that was closed properly, as a ``BagFile``."""

    missing = ''

    def __init__(self, path: Path) -> None:
        self._reader = rosbag2.Reader(path)
        self._reader.open()
        self.connections: Sequence[Connection] = self._reader.connections
        self.start_ns, self.end_ns = self._reader.start_time, self._reader.end_time - 1
        if type(self.start_ns) is not int or type(self.end_ns) is not int:  # SQLite columns hold values of any type
            raise ValueError('times of recording are no whole numbers')
        if not all(isinstance(text, str) for connection in self.connections for text in _key(connection)):
            raise ValueError('names or types of topics are no texts')

    def messages(self, connections: Sequence[Connection], start_ns: int | None, stop_ns: int | None) -> Iterator[Message]:
        """See ``BagFile``."""
        for connection, time_ns, data in self._reader.messages(connections, start_ns, stop_ns):
            if type(time_ns) is not int or not isinstance(data, (bytes, memoryview)):
                raise ValueError('a message has no time of recording, or no bytes')
            yield connection, time_ns, data

    def close(self) -> None:
        """See ``BagFile``."""
        if self._reader.is_open:
            self._reader.close()


class Rosbag2:
    """A rosbag2 as a ``Storage``: a folder with or without ``metadata.yaml``, or a single ``.db3`` or ``.mcap`` file."""

    def __init__(self, path: Path, *, is_damaged: bool = False) -> None:
        """Open the files.

        Args:
            path: the bag.
            is_damaged: True to read every file as if it were damaged, which takes longer.

        Raises:
            DatasetError: no file can be read.
        """
        self.notes: list[str] = []
        self._keep: list[UnpackedFile] = []
        metadata = read_metadata(path) if path.is_dir() else BagMetadata()
        self._files = self._open(self._paths(path, metadata), path, is_damaged)
        self._qos = metadata.offered
        self._merged = _merged(self._files)
        self.connections: Sequence[Connection] = list(self._merged.values())
        filled = [file for file in self._files if any(connection.msgcount for connection in file.connections)]
        self.start_ns = min((file.start_ns for file in filled), default=0)
        self.end_ns = max((file.end_ns for file in filled), default=0)
        self.notes += [file.missing for file in self._files if file.missing]
        self.notes += _short(metadata, self.connections)

    def type_name(self, connection: Connection) -> str:
        """See ``Storage``."""
        return connection.msgtype

    def offered(self, connection: Connection) -> tuple[OfferedQos, ...]:
        """See ``Storage``."""
        if stated := self._qos.get(connection.topic):
            return stated
        assert isinstance(connection.ext, ConnectionExtRosbag2)
        return tuple(map(offered_qos, connection.ext.offered_qos_profiles))

    def trailing(self, topic: str) -> bytes:
        """See ``Storage``."""
        return b''

    def messages(self, connections: Sequence[Connection], start_ns: int | None, stop_ns: int | None) -> Iterator[Message]:
        """See ``Storage``."""
        wanted = {_key(connection): connection for connection in connections}
        files = sorted(self._files, key=lambda file: file.start_ns)
        streams = [_wanted_messages(file, wanted, start_ns, stop_ns) for file in files]
        follow = all(before.end_ns <= after.start_ns for before, after in pairwise(files))
        for connection, time_ns, data in _one_after_the_other(streams) if follow else heapq.merge(*streams, key=_time_ns):
            yield connection, time_ns, unpacked_message(bytes(data))

    def close(self) -> None:
        """See ``Storage``."""
        for file in self._files:
            file.close()
        self._keep.clear()

    def _paths(self, path: Path, metadata: BagMetadata) -> list[Path]:
        """Returns the files that there are; notes which of those stated are missing."""
        if not path.is_dir():
            return [path]
        there = [path / name for name in storage_files(path)]
        stated = [path / name for name in metadata.file_names]
        found = [file for file in stated if file in there]
        if metadata.problem and there:
            names = ', '.join(file.name for file in there)
            self.notes.append(f'{metadata.problem}; reading {names}')
        elif stated and found and len(found) < len(stated):
            names = ', '.join(file.name for file in stated if file not in there)
            self.notes.append(f'files that metadata.yaml names are missing: {names}')
        if not there:
            missing = f'files are missing: {", ".join(metadata.file_names)}' if stated else 'it holds no .db3 or .mcap file'
            raise DatasetError(f'{path}: cannot be read as a rosbag2: {missing}')
        return found or there

    def _open(self, paths: Sequence[Path], bag: Path, is_damaged: bool) -> list[BagFile]:
        files: list[BagFile] = []
        errors: list[str] = []
        for path in paths:
            try:
                files.append(_opened(self._prepared(path), is_damaged))
            except DatasetError:
                raise
            except Exception as error:  # noqa: BLE001 - the storage libraries raise a dozen types on damaged files
                errors.append(f'{path.name}: {one_line(error) or type(error).__name__}')
        if not files:
            raise DatasetError(f'{bag}: cannot be read as a rosbag2, it may be truncated: {"; ".join(errors)}')
        self.notes += [f'a file cannot be read and is left out: {error}' for error in errors]
        return files

    def _prepared(self, path: Path) -> Path:
        """Returns the file to open: a copy, where the file itself is compressed or lacks its last messages."""
        if path.suffix == SUFFIX:
            self._keep.append(unpacked(path))
        elif path.suffix == '.db3' and journal_of(path).is_file() and journal_of(path).stat().st_size:
            self._keep.append(merged_with_journal(path))
        else:
            return path
        return self._keep[-1].path


def _opened(path: Path, is_damaged: bool) -> BagFile:
    """Open a file; one that is not whole is searched for messages.

    Raises:
        Exception: what the reader of whole files raised, if there are none.
    """
    cut = CutMcap if path.suffix == '.mcap' else CutSqlite
    if is_damaged:
        return cut(path)
    try:
        return WholeFile(path)
    except Exception:  # many types, see read_errors
        try:
            return cut(path)
        except Exception:  # noqa: BLE001 - the first error says more
            pass
        raise


def _merged(files: Sequence[BagFile]) -> dict[TopicKey, Connection]:
    """Returns one connection for each topic, with the messages of all files and the QoS of all publishers."""
    merged: dict[TopicKey, Connection] = {}
    for connection in (connection for file in files for connection in file.connections):
        key = _key(connection)
        if key not in merged:
            merged[key] = connection._replace(id=len(merged) + 1)
            continue
        before = merged[key]
        assert isinstance(before.ext, ConnectionExtRosbag2) and isinstance(connection.ext, ConnectionExtRosbag2)
        profiles = [*before.ext.offered_qos_profiles]
        profiles += [qos for qos in connection.ext.offered_qos_profiles if qos not in profiles]
        extension = before.ext._replace(offered_qos_profiles=profiles)
        merged[key] = before._replace(msgcount=before.msgcount + connection.msgcount, ext=extension)
    return merged


def _wanted_messages(
    file: BagFile, wanted: dict[TopicKey, Connection], start_ns: int | None, stop_ns: int | None
) -> Iterator[Message]:
    connections = [connection for connection in file.connections if _key(connection) in wanted]
    if connections:  # an empty list would mean all of them
        for connection, time_ns, data in file.messages(connections, start_ns, stop_ns):
            yield wanted[_key(connection)], time_ns, data


def _one_after_the_other(streams: Sequence[Iterator[Message]]) -> Iterator[Message]:
    for stream in streams:
        yield from stream


def _short(metadata: BagMetadata, connections: Sequence[Connection]) -> list[str]:
    """Returns a sentence about the topics with fewer messages than the metadata state."""
    counts: dict[str, int] = {}
    for connection in connections:
        counts[connection.topic] = counts.get(connection.topic, 0) + connection.msgcount
    short = [
        f'{topic} has {counts.get(topic, 0)} messages of the {stated} that the bag states'
        for topic, stated in metadata.num_messages.items()
        if counts.get(topic, 0) < stated
    ]
    return [f'{", ".join(short)}; is the copy complete?'] if short else []


def _key(connection: Connection) -> TopicKey:
    return connection.topic, connection.msgtype


def _time_ns(message: Message) -> int:
    return message[1]
