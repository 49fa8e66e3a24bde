"""Text files that grow line by line and keep whole lines, also while the disk is full."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from types import TracebackType

MAX_WAITING_BYTES = 1 << 20
"""Bytes of lines that wait for a place on the disk; further lines are refused, so that memory is bounded."""


class LineFile:
    """Appends lines to a file, each at once. A line that did not fit on the disk is written before the next one."""

    def __init__(self, path: Path) -> None:
        """Opens the file to append to it; it is made if it does not exist.

        Raises:
            OSError: it cannot be opened.
        """
        self._file = path.open('ab', buffering=0)
        self._waiting = b''

    @property
    def is_full(self) -> bool:
        """True while so much waits to be written that no line is taken any more."""
        return len(self._waiting) > MAX_WAITING_BYTES

    def write(self, line: str) -> None:
        """Writes a line, without its newline, and those that wait.

        Raises:
            OSError: not all of it could be written; the rest waits.
            ValueError: the file is closed.
        """
        if self._file.closed:
            raise ValueError('the file is closed')
        if self.is_full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._waiting += line.encode() + b'\n'
        self.flush()

    def flush(self) -> None:
        """Writes what waits.

        Raises:
            OSError: not all of it could be written; the rest waits.
        """
        while self._waiting:
            written = self._file.write(self._waiting)
            self._waiting = self._waiting[written or 0 :]

    def sync(self) -> None:
        """Waits until the lines so far would survive a power cut.

        Raises:
            OSError: they cannot be written.
        """
        self.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Writes what waits if that is possible, and closes the file.

        Raises:
            OSError: not all of it could be written; the file is closed nevertheless.
        """
        if self._file.closed:
            return
        try:
            self.flush()
        finally:
            self._file.close()

    def __enter__(self) -> LineFile:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self.close()
