"""What a program prints costs nothing but itself: not the run, if nobody listens any more."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import IO, Any


@contextmanager
def unfailing_output(results: bool = True) -> Iterator[None]:
    """Replaces streams that would raise: closed ones (``2>&-``), and messages to a terminal, pipe or disk that is gone or full.

    Characters that the encoding of the locale lacks are escaped.

    Args:
        results: the standard output has results, so that a full disk is an error there; False = it has messages only.
    """
    with ExitStack() as closed:

        def usable(stream: IO[str] | None) -> IO[str]:
            return closed.enter_context(open(os.devnull, 'w', encoding='utf-8')) if stream is None else stream

        before = sys.stdout, sys.stderr
        output, errors = usable(sys.stdout), usable(sys.stderr)
        if hasattr(output, 'reconfigure'):
            output.reconfigure(errors='backslashreplace')
        sys.stdout = output if results else _Unfailing(output)
        sys.stderr = _Unfailing(errors)
        try:
            yield
        finally:
            for stream in (sys.stdout, sys.stderr):
                if isinstance(stream, _Unfailing):
                    stream.settle()
            sys.stdout, sys.stderr = before


class _Unfailing:
    """A stream that drops what cannot be written."""

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Writes text. Returns its length."""
        with suppress(OSError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """Writes what waits."""
        with suppress(OSError):
            self._stream.flush()

    def settle(self) -> None:
        """Drops what still waits and cannot be written: the interpreter would fail over it when it ends."""
        try:
            self._stream.flush()
        except OSError:
            with suppress(OSError), open(os.devnull, 'w', encoding='utf-8') as nowhere:
                os.dup2(nowhere.fileno(), self._stream.fileno())

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)
