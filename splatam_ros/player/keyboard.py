"""Single key presses from the terminal, if there is one."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from enum import Enum
from types import TracebackType


class Key(Enum):
    """The keys that mean something."""

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
    """Reads keys without waiting for Enter while its ``with`` lasts; stays silent away from a terminal."""

    def __init__(self, is_enabled: bool = True) -> None:
        """Prepare.

        Args:
            is_enabled: whether to touch the terminal at all.
        """
        self._is_enabled = is_enabled
        self._terminal: int | None = None
        self._settings: list[object] = []
        self._typed = ''

    @property
    def is_attached(self) -> bool:
        """Whether key presses can come."""
        return self._terminal is not None

    def pressed(self) -> list[Key]:
        """The keys pressed since the last call."""
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
    """Whether the rest of a key's sequence is still to come."""
    return any(sequence.startswith(typed) and sequence != typed for sequence in SEQUENCES)


def _is_background_job(terminal: int) -> bool:
    """Whether the shell would stop us for touching the terminal."""
    try:
        return os.tcgetpgrp(terminal) != os.getpgrp()
    except OSError:  # not the terminal that controls us, so nobody does
        return False
