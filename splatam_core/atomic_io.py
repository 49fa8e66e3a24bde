"""Files that are never half there."""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replaced(path: Path) -> Iterator[Path]:
    """A path beside the given one to write to; it takes its place once the block is through without an error.

    Readers see the old file or the new one, complete, whenever they look and whatever interrupts the writer.
    """
    temporary = path.with_name(f'.{path.name}.{os.getpid()}')
    try:
        yield temporary
        with temporary.open('rb') as file:
            os.fsync(file.fileno())  # else a power cut may leave the new name with nothing behind it
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """A folder beside the given path to write into; it gets that path once the block is through without an error.

    Raises:
        OSError: it cannot be made, or something but an empty folder is at the path by then.
    """
    temporary = path.with_name(f'.{path.name}.{os.getpid()}')
    try:
        temporary.mkdir(parents=True)
        yield temporary
        temporary.replace(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def is_unfinished(name: str, replaceable: Collection[str]) -> bool:
    """Whether a file's name is one that ``replaced`` left when its process was killed."""
    stem, _, process = name.removeprefix('.').rpartition('.')
    return name.startswith('.') and process.isdecimal() and stem in replaceable


def replace_text(path: Path, text: str) -> None:
    """Write a text file in one step, in place of the one that is there."""
    with replaced(path) as temporary:
        temporary.write_text(text, encoding='utf-8')
