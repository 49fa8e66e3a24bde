"""Reads single key presses from the terminal, if there is one."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from enum import Enum
from types import TracebackType
from typing import Any


class Key(Enum):
    """The keys that the player understands."""

    SPACE = 'space'
    RIGHT = 'cursor right'
    UP = 'cursor up'
    DOWN = 'cursor down'


SEQUENCES = {
    ' ': Key.SPACE,
    **{start + end: key for start in ('\x1b[', '\x1bO') for end, key in
       (('A', Key.UP), ('B', Key.DOWN), ('C', Key.RIGHT))},
}  # fmt: skip


class Keyboard:
    """Reads keys without waiting for Enter, as a context manager. Without a terminal, no key is ever pressed."""

    def __init__(self, is_enabled: bool = True) -> None:
        """Prepare.

        Args:
            is_enabled: False to leave the terminal alone.
        """
        self._is_enabled = is_enabled
        self._terminal: int | None = None
        self._settings: list[Any] = []
        self._typed = ''

    @property
    def is_attached(self) -> bool:
        """True if keys are read from a terminal."""
        return self._terminal is not None

    def pressed(self) -> list[Key]:
        """Returns the keys pressed since the last call."""
        if self._terminal is None or not select.select([self._terminal], [], [], 0)[0]:
            return []
        self._typed += os.read(self._terminal, 64).decode(errors='ignore')
        keys = []
        while self._typed and not _is_beginning(self._typed):
            sequence = next((known for known in SEQUENCES if self._typed.startswith(known)), None)
            keys += [SEQUENCES[sequence]] if sequence else []
            self._typed = self._typed[len(sequence or ' ') :]
        return keys

    def __enter__(self) -> Keyboard:
        if not self._is_enabled or sys.stdin is None or not sys.stdin.isatty():
            return self
        if not _is_background_job(sys.stdin.fileno()):
            self._terminal = sys.stdin.fileno()
            self._settings = termios.tcgetattr(self._terminal)
            tty.setcbreak(self._terminal)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        if self._terminal is not None:
            termios.tcsetattr(self._terminal, termios.TCSADRAIN, self._settings)


def _is_beginning(typed: str) -> bool:
    """Returns True if the characters are the beginning of a key's escape sequence."""
    return any(sequence.startswith(typed) and sequence != typed for sequence in SEQUENCES)


def _is_background_job(terminal: int) -> bool:
    """Returns True if this process is in the background: changing the terminal would stop it."""
    try:
        return os.tcgetpgrp(terminal) != os.getpgrp()
    except OSError:  # it is not our controlling terminal
        return False
