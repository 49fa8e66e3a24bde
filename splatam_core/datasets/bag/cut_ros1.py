"""Reads a ROS 1 bag that is cut or damaged: every message of it that is whole. Format: wiki.ros.org/Bags/Format/2.0.

The index of a bag is at its end, so that a bag that was not closed has none. It is made anew, as ``rosbag reindex`` does.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from rosbags import rosbag1
from rosbags.interfaces import Connection, ConnectionExtRosbag1, MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag1.reader import Chunk, ChunkInfo, Header, IndexData, RecordType, normalize, read_bytes, read_uint32
from rosbags.typesys.msg import normalize_msgtype

MAGIC = b'#ROSBAG V2.0\n'
MAX_CHUNK_BYTES = 1 << 30
"""Larger chunks, packed or unpacked, are taken as damaged. Recorders close a chunk after a megabyte or the first message beyond."""


@dataclass(slots=True)
class _Index:
    connections: dict[int, Connection] = field(default_factory=dict)
    infos: list[ChunkInfo] = field(default_factory=list)
    chunks: dict[int, Chunk] = field(default_factory=dict)
    messages: dict[int, list[IndexData]] = field(default_factory=dict)
    num_damaged: int = 0


class CutRosbag1(rosbag1.Reader):
    """What is whole of a ROS 1 bag.

    Attributes:
        missing: what cannot be read, in words.
    """

    missing = ''

    def open(self) -> None:
        """Find the messages that are whole, which reads the file once.

        Raises:
            ValueError: there is no whole message.
        """
        path = Path(str(self.path))
        stat = path.stat()
        index = _scanned(path, stat.st_mtime_ns, stat.st_size)
        if not index.infos:
            raise ValueError('no message in it is whole')
        self.chunk_infos, self.chunks = list(index.infos), dict(index.chunks)
        self.indexes = {number: sorted(index.messages.get(number, [])) for number in index.connections}
        self.connections = [
            connection._replace(msgcount=len(self.indexes[number])) for number, connection in index.connections.items()
        ]
        damaged = f', and {index.num_damaged} damaged chunks' if index.num_damaged else ''
        self.missing = f'{path.name} is cut or damaged: what follows its last whole message{damaged} is missing'
        self.bio = path.open('rb')


@lru_cache(maxsize=8)
def _scanned(path: Path, mtime_ns: int, num_bytes: int) -> _Index:
    index = _Index()
    with path.open('rb') as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise ValueError('it is no ROS 1 bag')
        while (position := file.tell()) < num_bytes:
            try:
                header = Header.read(file)
                kind, length = header.get_uint8('op'), read_uint32(file)
            except Exception:  # noqa: BLE001 - where the file is cut or damaged; its records cannot be told apart behind that
                break
            data = file.tell()
            if kind == RecordType.CHUNK:
                _add_chunk(index, file, position, header, min(length, num_bytes - data))
            file.seek(data + length)
    return index


def _add_chunk(index: _Index, file: BinaryIO, position: int, header: Header, length: int) -> None:
    """Add the messages of a chunk to the index. Of one that is cut, those before the cut are whole if it is not compressed."""
    try:
        if max(length, header.get_uint32('size')) > MAX_CHUNK_BYTES:
            raise ValueError('no chunk is as large')
        compression = header.get_string('compression')
        chunk = Chunk(length, file.tell(), rosbag1.reader.decompressors[compression])
        found = _messages(index, BytesIO(chunk.decompressor(read_bytes(file, length))), position)
    except Exception:  # noqa: BLE001 - what decompressors and parsers raise on damaged data is not one type
        index.num_damaged += 1
        return
    if not found:
        return
    index.chunks[position] = chunk
    counts: dict[int, int] = {}
    for number, entry in found:
        index.messages.setdefault(number, []).append(entry)
        counts[number] = counts.get(number, 0) + 1
    times = [entry.time for _, entry in found]
    index.infos.append(ChunkInfo(position, min(times), max(times) + 1, counts))


def _messages(index: _Index, content: BytesIO, position: int) -> list[tuple[int, IndexData]]:
    """Returns the number of the connection and the place of each whole message of a chunk; adds connections to the index."""
    found = []
    size = content.seek(0, os.SEEK_END)
    content.seek(0)
    while (offset := content.tell()) < size:
        try:
            header = Header.read(content)
            data = read_bytes(content, read_uint32(content))
        except rosbag1.ReaderError:  # the chunk is cut here
            break
        kind, number = header.get_uint8('op'), header.get_uint32('conn')
        if kind == RecordType.CONNECTION and number not in index.connections:
            index.connections[number] = _connection(number, header.get_string('topic'), data)
        elif kind == RecordType.MSGDATA and number in index.connections:
            found.append((number, IndexData(header.get_time('time'), position, offset)))
    return found


def _connection(number: int, topic: str, data: bytes) -> Connection:
    """Returns a connection. data: the fields of its own header, without their length."""
    stated = Header.read(BytesIO(len(data).to_bytes(4, 'little') + data))
    definition = MessageDefinition(MessageDefinitionFormat.MSG, stated.get_string('message_definition'))
    latching = int(stated.get_string('latching') or 0) if 'latching' in stated else None
    extension = ConnectionExtRosbag1(stated.get_string('callerid') if 'callerid' in stated else None, latching)
    type_name = normalize_msgtype(stated.get_string('type'))
    return Connection(
        number, normalize(topic), type_name, definition, digest=stated.get_string('md5sum'), msgcount=0, ext=extension, owner=None
    )
