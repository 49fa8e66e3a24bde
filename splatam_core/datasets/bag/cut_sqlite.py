"""Reads a SQLite file of a rosbag2 that is cut or damaged: every message before the first damaged page.

SQLite puts the first page that lists others some hundred messages behind the beginning: of a shorter rest nothing is found.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path

from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat

from splatam_core.datasets.bag.qos import recorded_qos

_NO_DEFINITION = MessageDefinition(MessageDefinitionFormat.NONE, '')
Row = tuple[int, int, int]
"""Time of recording, number of the message, number of its topic."""


class CutSqlite:
    """What is whole of a SQLite file, as a ``BagFile``."""

    def __init__(self, path: Path) -> None:
        """Find the messages that are whole, which reads the file once.

        Raises:
            ValueError: there is none.
            sqlite3.Error: the file is no database.
        """
        stat = path.stat()
        self._rows = _scanned(path, stat.st_mtime_ns, stat.st_size)
        if not self._rows:
            raise ValueError('no message in it is whole')
        self._database = _connect(path)
        counts: dict[int, int] = {}
        for _, _, topic in self._rows:
            counts[topic] = counts.get(topic, 0) + 1
        self.connections: Sequence[Connection] = list(_connections(self._database, counts))
        self.start_ns, self.end_ns = self._rows[0][0], self._rows[-1][0]
        self.missing = f'{path.name} is cut or damaged: what follows its last whole message is missing'

    def messages(
        self, connections: Sequence[Connection], start_ns: int | None, stop_ns: int | None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        """See ``BagFile``."""
        wanted = {connection.id: connection for connection in connections}
        for time_ns, number, topic in self._rows:
            is_in_time = (start_ns is None or time_ns >= start_ns) and (stop_ns is None or time_ns < stop_ns)
            if topic in wanted and is_in_time:
                (data,) = self._database.execute('SELECT data FROM messages WHERE id = ?', (number,)).fetchone()
                yield wanted[topic], time_ns, data

    def close(self) -> None:
        """See ``BagFile``."""
        self._database.close()


@lru_cache(maxsize=8)
def _scanned(path: Path, mtime_ns: int, num_bytes: int) -> list[Row]:
    """Returns the rows of whole messages in order of time."""
    database = _connect(path)
    rows: list[Row] = []
    try:
        for number, topic, time_ns, data in database.execute('SELECT id, topic_id, timestamp, data FROM messages'):
            if isinstance(data, bytes) and type(time_ns) is int and type(topic) is int:
                rows.append((time_ns, number, topic))
    except sqlite3.Error:
        pass
    finally:
        database.close()
    return sorted(rows)


def _connect(path: Path) -> sqlite3.Connection:
    uri = f'{path.resolve().as_uri()}?mode=ro&immutable=1'
    database = sqlite3.connect(uri, uri=True, check_same_thread=False)  # one thread at a time reads from it
    database.execute('PRAGMA writable_schema = ON')  # accept a file that is shorter than its header states
    return database


def _connections(database: sqlite3.Connection, counts: Mapping[int, int]) -> Iterator[Connection]:
    cursor = database.execute('SELECT * FROM topics')
    columns = [description[0] for description in cursor.description]
    for values in cursor:
        topic = dict(zip(columns, values, strict=True))
        if not (isinstance(topic['name'], str) and isinstance(topic['type'], str)):  # columns hold values of any type
            continue
        extension = ConnectionExtRosbag2(topic['serialization_format'], recorded_qos(topic.get('offered_qos_profiles')))
        key = topic['id']
        yield Connection(key, topic['name'], topic['type'], _NO_DEFINITION, digest='', msgcount=counts.get(key, 0),
                         ext=extension, owner=None)  # fmt: skip
