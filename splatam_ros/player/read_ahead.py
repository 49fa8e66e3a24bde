"""Reads a recording ahead of playback, on a thread of its own: a slow disk does not make messages late."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from types import TracebackType

from splatam_ros.player.recording import RawMessage


class ReadAhead:
    """Messages in their order, read before they are asked for. Use as a context manager; it joins the thread."""

    def __init__(self, messages: Iterator[RawMessage], size: int) -> None:
        """Start reading.

        Args:
            messages: belongs to the thread from now on, and so does the file below it.
            size: most messages to hold.
        """
        self._messages = messages
        self._size = size
        self._waiting: deque[RawMessage] = deque()
        self._error: Exception | None = None
        self._is_over = self._is_stopping = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name='read_ahead')
        self._thread.start()

    @property
    def is_over(self) -> bool:
        """Whether every message has been taken.

        Raises:
            Exception: what ended reading, once all that was read before has been taken.
        """
        with self._changed:
            if self._is_over and not self._waiting and self._error is not None:
                raise self._error
            return self._is_over and not self._waiting

    def take(self, timeout_s: float) -> RawMessage | None:
        """The next message; None where there is none, or none within some time."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_over, timeout_s)
            if not self._waiting:
                return None
            self._changed.notify_all()
            return self._waiting.popleft()

    def __enter__(self) -> ReadAhead:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        with self._changed:
            self._is_stopping = True
            self._changed.notify_all()
        self._thread.join()

    def _run(self) -> None:
        try:
            for message in self._messages:
                if not self._put(message):
                    break
        except Exception as error:  # noqa: BLE001 - whatever it is, it surfaces where messages are taken
            self._error = error
        with self._changed:
            self._is_over = True
            self._changed.notify_all()

    def _put(self, message: RawMessage) -> bool:
        """Queue a message as soon as there is room; False where nobody wants it any more."""
        with self._changed:
            self._changed.wait_for(lambda: self._is_stopping or len(self._waiting) < self._size)
            self._waiting.append(message)
            self._changed.notify_all()
            return not self._is_stopping
