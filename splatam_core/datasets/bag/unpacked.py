"""Unpacks compressed bag files and messages: a file once for all that read it, and only where there is space for it."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
import weakref
from collections.abc import Iterator
from contextlib import closing
from functools import lru_cache
from pathlib import Path

from backports import zstd

from splatam_core.errors import DatasetError

MAGIC = b'\x28\xb5\x2f\xfd'
MAX_MESSAGE = 2**30
BLOCK = 2**24
RESERVE = 2**28
"""Bytes that stay free on the disk."""


class UnpackedFile:
    """A file in a temporary folder that is removed once nobody uses it.

    Attributes:
        path: the file.
    """

    def __init__(self, name: str, parts: Iterator[bytes], size: int | None, source: Path) -> None:
        """Write the file.

        Args:
            name: of the file.
            parts: its content.
            size: number of bytes of it; None if unknown.
            source: the file that it comes from, for error messages.

        Raises:
            DatasetError: there is no space for it.
        """
        folder = Path(tempfile.mkdtemp(prefix='splatam_bag_'))
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        self.path = folder / name
        _check_space(folder, size or 0, source)
        with self.path.open('wb') as file:
            for part in parts:
                file.write(part)
                _check_space(folder, 0, source)


def unpacked(path: Path) -> UnpackedFile:
    """Returns the unpacked content of a ``.zstd`` file; who needs it keeps the result.

    Raises:
        DatasetError: there is no space for it.
    """
    stat = path.stat()
    return _unpacked(path, stat.st_mtime_ns, stat.st_size)


def merged_with_journal(path: Path) -> UnpackedFile:
    """Returns a copy of a SQLite file beside its write-ahead log, which holds the last messages of a recording that was killed.

    Raises:
        DatasetError: there is no space for it.
    """
    stat = path.stat()
    return _with_journal(path, stat.st_mtime_ns, stat.st_size)


def journal_of(path: Path) -> Path:
    """Returns where SQLite keeps the write-ahead log of a file."""
    return path.with_name(f'{path.name}-wal')


def unpacked_message(data: bytes) -> bytes:
    """Returns a message as it was before compression, if it is compressed; empty if it is damaged or larger than 1 GiB."""
    if not data.startswith(MAGIC):
        return data
    try:
        decompressor = zstd.ZstdDecompressor()
        message = decompressor.decompress(data, MAX_MESSAGE)
    except (zstd.ZstdError, EOFError):
        return b''
    return message if decompressor.eof else b''


@lru_cache(maxsize=2)
def _unpacked(path: Path, mtime_ns: int, num_bytes: int) -> UnpackedFile:
    with path.open('rb') as file:
        beginning = file.read(64)
    return UnpackedFile(path.stem, _parts(path), zstd.get_frame_info(beginning).decompressed_size, path)


@lru_cache(maxsize=2)
def _with_journal(path: Path, mtime_ns: int, num_bytes: int) -> UnpackedFile:
    copy = UnpackedFile(path.name, _blocks(path), num_bytes, path)
    shutil.copyfile(journal_of(path), journal_of(copy.path))
    with closing(sqlite3.connect(copy.path)) as database:
        database.execute('PRAGMA journal_mode = DELETE')  # moves what the log holds into the file
    return copy


def _parts(path: Path) -> Iterator[bytes]:
    with zstd.open(path, 'rb') as file:
        while part := file.read(BLOCK):
            yield part


def _blocks(path: Path) -> Iterator[bytes]:
    with path.open('rb') as file:
        while part := file.read(BLOCK):
            yield part


def _check_space(folder: Path, needed: int, source: Path) -> None:
    free = shutil.disk_usage(folder).free
    if free < needed + RESERVE:
        raise DatasetError(
            f'{source}: unpacking it needs {(needed + RESERVE) / 1e9:.1f} GB, but {folder.parent} has {free / 1e9:.1f} GB free; '
            f'set TMPDIR to a folder with space, or unpack it yourself: zstd -d {source.name}'
        )
