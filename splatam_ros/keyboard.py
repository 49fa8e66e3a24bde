"""Single key presses from the terminal, if there is one."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from types import TracebackType


class Keyboard:
    """Reads keys without waiting for Enter while its ``with`` lasts; stays silent away from a terminal."""

    def __init__(self) -> None:
        self._terminal: int | None = None
        self._settings: list[object] = []

    @property
    def is_attached(self) -> bool:
        """Whether key presses can come."""
        return self._terminal is not None

    def pressed(self) -> str:
        """The next key pressed, or an empty text."""
        if self._terminal is None or not select.select([self._terminal], [], [], 0)[0]:
            return ''
        return os.read(self._terminal, 1).decode(errors='ignore')

    def __enter__(self) -> Keyboard:
        if sys.stdin is not None and sys.stdin.isatty() and not _is_background_job(sys.stdin.fileno()):
            self._terminal = sys.stdin.fileno()
            self._settings = termios.tcgetattr(self._terminal)
            tty.setcbreak(self._terminal)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._terminal is not None:
            termios.tcsetattr(self._terminal, termios.TCSADRAIN, self._settings)


def _is_background_job(terminal: int) -> bool:
    """Whether the shell would stop us for touching the terminal."""
    try:
        return os.tcgetpgrp(terminal) != os.getpgrp()
    except OSError:  # not the terminal that controls us, so nobody does
        return False
