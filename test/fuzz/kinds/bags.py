"""Bags: whatever their files, tables, metadata and messages hold, frames are read or one line says what is wrong."""

from __future__ import annotations

import json
import shutil
import sqlite3
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import yaml
from dataset_layouts import write_rosbag1
from hypothesis import strategies as st
from rosbags.rosbag2 import CompressionMode
from test_bags_of_people import file_of, scene, write
from test_datasets_rosbag import raw

from kinds.base import Case, Kind, Tally
from kinds.damaged import JSON, WORDS, damage, json_damage
from kinds.dataset_files import read_all, read_whole


@dataclass(frozen=True)
class Bag:
    """A bag as ``open_sequence`` takes it, and the bytes of its files."""

    source: Path
    files: dict[Path, bytes]


@dataclass(frozen=True)
class Change:
    """Other bytes for a file of a bag."""

    bag: int
    file: Path
    data: bytes


@dataclass(frozen=True)
class Statement:
    """A statement of SQL and its values, for the tables of a bag."""

    text: str
    values: tuple[Any, ...] = ()


def bag_at(source: Path) -> Bag:
    files = [path for path in sorted(source.rglob('*')) if path.is_file()] if source.is_dir() else [source]
    return Bag(source, {path: path.read_bytes() for path in files})


def write_bags(folder: Path) -> list[Bag]:
    """Bags of every storage and compression, and one of ROS 1."""
    sources = [write(folder / storage, scene(3), storage) for storage in ('sqlite3', 'mcap')]
    sources += [write(folder / 'mcap_zstd', scene(3), 'mcap', CompressionMode.STORAGE)]
    sources += [write(folder / 'by_message', scene(3), 'sqlite3', CompressionMode.MESSAGE)]
    sources += [write(folder / 'by_file', scene(3), 'sqlite3', CompressionMode.FILE)]
    return [bag_at(source) for source in sources] + [bag_at(write_rosbag1(folder))]


@st.composite
def changes(draw: st.DrawFn, bags: list[Bag]) -> Change:
    bag = draw(st.integers(0, len(bags) - 1))
    file, whole = draw(st.sampled_from(sorted(bags[bag].files.items())))
    near_the_ends = st.sampled_from([200, 2000, len(whole)])
    size = draw(near_the_ends)  # where headers, indices and tables are
    if draw(st.booleans()):
        return Change(bag, file, draw(damage(whole[:size])) + whole[size:])
    return Change(bag, file, whole[:-size] + draw(damage(whole[-size:])))


@st.composite
def metadata(draw: st.DrawFn, bags: list[Bag]) -> Change:
    bag = draw(st.integers(0, len(bags) - 2))  # the last is of ROS 1
    file = bags[bag].source / 'metadata.yaml'
    tree = yaml.safe_load(bags[bag].files[file])
    return Change(bag, file, draw(json_damage(json.dumps(tree).encode())))  # JSON is YAML


def check_change(bags: list[Bag], tally: Tally, change: Change) -> None:
    bag = bags[change.bag]
    try:
        change.file.write_bytes(change.data)
        read_all(tally, bag.source, {})
    finally:
        for path in bag.source.parent.glob('**/*') if bag.source.is_file() else bag.source.rglob('*'):
            if path.is_file() and path not in bag.files and path.parent == bag.source:
                path.unlink()  # of SQLite: journals
        change.file.write_bytes(bag.files[change.file])


@st.composite
def damaged_messages(draw: st.DrawFn, whole: list[tuple[str, int, bytes]]) -> dict[int, tuple[int, bytes]]:
    """Some messages of a bag, by number, with other bytes and times of recording."""
    result = {}
    for number in draw(st.lists(st.integers(0, len(whole) - 1), min_size=1, max_size=4, unique=True)):
        _, recorded_ns, data = whole[number]
        near_the_start = data[:200]
        other = draw(damage(near_the_start)) + data[200:] if draw(st.booleans()) else draw(damage(data))
        result[number] = draw(st.sampled_from([recorded_ns, 0, 2**62])), other
    return result


def check_messages(bag: Path, whole: list[tuple[str, int, bytes]], tally: Tally, changed: dict[int, tuple[int, bytes]]) -> None:
    """The messages are replaced in the table of the bag, in the order in which they were written."""
    statements = [
        Statement('UPDATE messages SET timestamp = ?, data = ? WHERE id = ?', (recorded_ns, data, number + 1))
        for number, (recorded_ns, data) in changed.items()
    ]
    check_tables(bag, tally, statements)


ODD = st.one_of(
    st.none(), st.integers(-(2**63), 2**63 - 1), st.integers(-2, 5), st.floats(), WORDS.map(lambda word: word.replace('\0', '')),
    st.binary(max_size=30), JSON.map(json.dumps),
    st.sampled_from(['sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage', 'sensor_msgs/msg/CameraInfo', '.x/msg/Foo']),
)  # fmt: skip
COLUMNS = {
    'topics': ['id', 'name', 'type', 'serialization_format', 'offered_qos_profiles'],
    'messages': ['id', 'topic_id', 'timestamp', 'data'],
}  # fmt: skip


@st.composite
def statements(draw: st.DrawFn) -> Statement:
    table = draw(st.sampled_from(sorted(COLUMNS)))
    column = draw(st.sampled_from(COLUMNS[table]))
    kind = draw(st.integers(0, 9))
    if kind == 0:
        return Statement(draw(st.sampled_from([
            f'DROP TABLE {table}', f'ALTER TABLE {table} RENAME COLUMN {column} TO x', f'DELETE FROM {table}',
            f'INSERT INTO {table} SELECT * FROM {table} WHERE id < 0', f'DELETE FROM {table} WHERE id % 2',
            'CREATE VIEW v AS SELECT * FROM messages', 'PRAGMA user_version = 99', 'DROP TABLE schema', 'DROP TABLE metadata',
        ])))  # fmt: skip
    where = draw(st.sampled_from(['id = 1', 'id = 2', 'id % 3 = 0', '1']))
    return Statement(f'UPDATE OR IGNORE {table} SET {column} = ? WHERE {where}', (draw(ODD),))


def check_tables(bag: Path, tally: Tally, changed: list[Statement]) -> None:
    copy = bag.with_name('changed')
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(bag, copy)
    with closing(sqlite3.connect(file_of(copy))) as database:
        database.execute('PRAGMA synchronous = OFF')
        for statement in changed:
            try:
                database.execute(statement.text, statement.values)
            except (sqlite3.Error, OverflowError):
                continue  # of a column or table that is gone
        database.commit()
    read_all(tally, copy, {})


def cases(folder: Path) -> list[Case]:
    bags = write_bags(folder)
    for bag in bags:
        read_whole(bag.source, {})
    whole = [(topic, recorded_ns, bytes(raw(message))) for topic, recorded_ns, message in scene(3)]
    sqlite = bags[0].source
    return [
        Case('files', changes(bags), partial(check_change, bags), short=50),
        Case('metadata', metadata(bags), partial(check_change, bags), short=20),
        Case('messages', damaged_messages(whole), partial(check_messages, sqlite, whole), short=20),
        Case('tables', st.lists(statements(), min_size=1, max_size=3), partial(check_tables, sqlite), short=20),
    ]


KIND = Kind('bags', 16_000, cases, memory_mb=512)
