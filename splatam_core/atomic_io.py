"""Files and folders that appear complete or not at all, and reading that does not wait for a pipe."""

from __future__ import annotations

import errno
import os
import shutil
import stat
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """Yields a temporary path to write to; the file there replaces the given one when the block ends without an error.

    Readers see the complete old file or the complete new one at any time, whatever interrupts the writer.
    """
    temporary = path.with_name(f'.{path.name}.{os.getpid()}')
    try:
        yield temporary
        with temporary.open('rb') as file:
            os.fsync(file.fileno())  # otherwise a power cut may leave an empty file under the new name
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Yields a temporary folder to write into; it moves to the given path when the block ends without an error.

    Raises:
        OSError: it cannot be made, or something other than an empty folder is at the path in the end.
    """
    temporary = path.with_name(f'.{path.name}.{os.getpid()}')
    shutil.rmtree(temporary, ignore_errors=True)  # in containers a process often has the number of one that was killed
    temporary.mkdir(parents=True)
    try:
        yield temporary
        temporary.replace(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def open_regular(path: Path) -> BinaryIO:
    """Opens a file to read its bytes.

    Raises:
        OSError: it cannot be opened, or is a pipe, a device or a folder, of which reading may never end.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # O_NONBLOCK: do not wait for a pipe's writer
    try:
        mode = os.fstat(descriptor).st_mode
        if not stat.S_ISREG(mode):
            code = errno.EISDIR if stat.S_ISDIR(mode) else errno.EINVAL
            what = os.strerror(errno.EISDIR) if stat.S_ISDIR(mode) else 'Not a regular file'
            raise OSError(code, what, str(path))
        return os.fdopen(descriptor, 'rb')
    except BaseException:
        os.close(descriptor)
        raise


def is_unfinished(name: str, replaceable: Collection[str]) -> bool:
    """Returns True if ``replaced`` left a file of this name when its process was killed.

    Args:
        name: of the file.
        replaceable: names that ``replaced`` may have been given.
    """
    stem, _, process = name.removeprefix('.').rpartition('.')
    return name.startswith('.') and process.isdecimal() and stem in replaceable


def replace_text(path: Path, text: str) -> None:
    """Writes a text file in one step; it replaces the file at the path."""
    with replaced(path) as temporary:
        temporary.write_text(text, encoding='utf-8')


@contextmanager
def prepared(texts: Mapping[Path, str]) -> Iterator[Callable[[], None]]:
    """Writes text files under temporary names. Yields a function that puts all of them in place, which takes no space.

    Raises:
        OSError: they do not fit on the disk; nothing has changed.
    """
    temporary = {path: path.with_name(f'.{path.name}.{os.getpid()}') for path in texts}
    try:
        for path, text in texts.items():
            with temporary[path].open('w', encoding='utf-8') as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())

        def put_in_place() -> None:
            for path in texts:
                os.replace(temporary[path], path)

        yield put_in_place
    finally:
        for path in temporary.values():
            path.unlink(missing_ok=True)


def same_file(path: Path, other: Path) -> None:
    """Gives a file a second name, without taking space for it; where the file system cannot, makes a copy."""
    try:
        os.link(path, other)
    except OSError:
        shutil.copy2(path, other)
