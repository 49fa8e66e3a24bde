"""Reads an MCAP file that is cut or damaged: every record and chunk of it that is whole. Format: mcap.dev/spec."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from heapq import heappop, heappush
from pathlib import Path
from typing import BinaryIO, NamedTuple
from zlib import crc32

from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag2.storage_mcap import DECOMPRESSORS

from splatam_core.datasets.bag.qos import recorded_qos

MAGIC = b'\x89MCAP0\r\n'
SCHEMA, CHANNEL, MESSAGE, CHUNK = 3, 4, 5, 6
_RECORD = struct.Struct('<BQ')
_MESSAGE = struct.Struct('<HIQQ')
_CHUNK = struct.Struct('<QQQI')


class _Message(NamedTuple):
    time_ns: int
    order: int
    channel: int
    data: bytes


@dataclass(frozen=True, slots=True)
class _Block:
    """A chunk, or a message outside chunks: where its record is, and what is in it."""

    kind: int
    position: int
    length: int
    start_ns: int
    end_ns: int
    channels: frozenset[int]


@dataclass(slots=True)
class _Index:
    blocks: list[_Block] = field(default_factory=list)
    schemas: dict[int, tuple[str, MessageDefinition]] = field(default_factory=dict)
    channels: dict[int, Connection] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    num_damaged: int = 0


class CutMcap:
    """What is whole of an MCAP file, as a ``BagFile``."""

    def __init__(self, path: Path) -> None:
        """Find the records that are whole, which reads the file once.

        Raises:
            ValueError: there is no whole message.
        """
        stat = path.stat()
        self._index = _scanned(path, stat.st_mtime_ns, stat.st_size)
        if not self._index.blocks:
            raise ValueError('no message in it is whole')
        self.connections: Sequence[Connection] = [
            connection._replace(msgcount=self._index.counts.get(channel, 0)) for channel, connection in self._index.channels.items()
        ]
        self.start_ns = min(block.start_ns for block in self._index.blocks)
        self.end_ns = max(block.end_ns for block in self._index.blocks)
        damaged = f', and {self._index.num_damaged} damaged chunks' if self._index.num_damaged else ''
        self.missing = f'{path.name} is cut or damaged: what follows its last whole record{damaged} is missing'
        self._file: BinaryIO = path.open('rb')

    def messages(
        self, connections: Sequence[Connection], start_ns: int | None, stop_ns: int | None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """See ``BagFile``."""
        wanted = {connection.id: connection for connection in connections}
        start_ns, stop_ns = start_ns or 0, 2**64 if stop_ns is None else stop_ns
        heap: list[_Message] = []
        for block in sorted(self._index.blocks, key=lambda block: block.start_ns):
            if block.end_ns < start_ns or block.start_ns >= stop_ns or wanted.keys().isdisjoint(block.channels):
                continue
            while heap and heap[0].time_ns < block.start_ns:
                message = heappop(heap)
                yield wanted[message.channel], message.time_ns, message.data
            for message in _messages(_content(self._file, block), block):
                if message.channel in wanted and start_ns <= message.time_ns < stop_ns:
                    heappush(heap, message)
        while heap:
            message = heappop(heap)
            yield wanted[message.channel], message.time_ns, message.data

    def close(self) -> None:
        """See ``BagFile``."""
        self._file.close()


@lru_cache(maxsize=8)
def _scanned(path: Path, mtime_ns: int, num_bytes: int) -> _Index:
    index = _Index()
    with path.open('rb') as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise ValueError('it is no MCAP file')
        while len(head := file.read(_RECORD.size)) == _RECORD.size:
            kind, length = _RECORD.unpack(head)
            position = file.tell()
            if position + length > num_bytes:
                break
            try:
                _add(index, file, kind, position, length)
            except Exception:  # noqa: BLE001 - what decompressors and parsers raise on damaged data is not one type
                index.num_damaged += 1
            file.seek(position + length)
    return index


def _add(index: _Index, file: BinaryIO, kind: int, position: int, length: int) -> None:
    """Add a record of the file to the index."""
    if kind in (SCHEMA, CHANNEL):
        _define(index, kind, file.read(length))
    elif kind in (MESSAGE, CHUNK):
        block = _Block(kind, position, length, 0, 0, frozenset())
        content = _content(file, block)
        if kind == CHUNK:
            for inner, start, end in _records(content):
                if inner in (SCHEMA, CHANNEL):
                    _define(index, inner, content[start:end])
        found = [message for message in _messages(content, block) if message.channel in index.channels]
        if not found:
            return
        times = [message.time_ns for message in found]
        channels = frozenset(message.channel for message in found)
        index.blocks.append(_Block(kind, position, length, min(times), max(times), channels))
        for message in found:
            index.counts[message.channel] = index.counts.get(message.channel, 0) + 1


def _content(file: BinaryIO, block: _Block) -> bytes:
    """Returns the records of a chunk, or the message that a block is."""
    file.seek(block.position)
    data = file.read(block.length)
    if block.kind == MESSAGE:
        return data
    _, _, size, checksum = _CHUNK.unpack_from(data)
    compression, at = _text(data, _CHUNK.size)
    (length,) = struct.unpack_from('<Q', data, at)
    content = DECOMPRESSORS[compression](data[at + 8 : at + 8 + length], size)
    if len(content) != size or (checksum and crc32(content) != checksum):
        raise ValueError('the chunk is damaged')
    return content


def _messages(content: bytes, block: _Block) -> Iterator[_Message]:
    if block.kind == MESSAGE:
        yield _message(content, 0, len(content), block.position)
        return
    for kind, start, end in _records(content):
        if kind == MESSAGE:
            yield _message(content, start, end, block.position + start)


def _message(content: bytes, start: int, end: int, order: int) -> _Message:
    channel, _, time_ns, _ = _MESSAGE.unpack_from(content, start)
    return _Message(time_ns, order, channel, content[start + _MESSAGE.size : end])


def _records(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Iterate over (kind, start, end) of the records of a chunk."""
    at = 0
    while at + _RECORD.size <= len(content):
        kind, length = _RECORD.unpack_from(content, at)
        at += _RECORD.size
        if at + length > len(content):
            return
        yield kind, at, at + length
        at += length


def _define(index: _Index, kind: int, record: bytes) -> None:
    """Add a schema or a channel to the index."""
    (key,) = struct.unpack_from('<H', record)
    if kind == SCHEMA:
        name, at = _text(record, 2)
        encoding, at = _text(record, at)
        form = MessageDefinitionFormat.MSG if encoding == 'ros2msg' else MessageDefinitionFormat.IDL
        index.schemas[key] = name, MessageDefinition(form, _text(record, at)[0])
        return
    (schema,) = struct.unpack_from('<H', record, 2)
    type_name, definition = index.schemas[schema]
    topic, at = _text(record, 4)
    encoding, at = _text(record, at)
    (length,) = struct.unpack_from('<I', record, at)
    offered = _offered(record[at + 4 : at + 4 + length])
    extension = ConnectionExtRosbag2(encoding, recorded_qos(offered))
    index.channels[key] = Connection(key, topic, type_name, definition, digest='', msgcount=0, ext=extension, owner=None)


def _offered(metadata: bytes) -> str:
    at = 0
    while at < len(metadata):
        name, at = _text(metadata, at)
        value, at = _text(metadata, at)
        if name == 'offered_qos_profiles':
            return value
    return ''


def _text(data: bytes, at: int) -> tuple[str, int]:
    """Returns a text with its length before it, and the position after it."""
    (length,) = struct.unpack_from('<I', data, at)
    return data[at + 4 : at + 4 + length].decode(), at + 4 + length
