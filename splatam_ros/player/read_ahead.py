"""Reads a recording ahead of playback on a thread of its own, so that a slow disk does not make messages late."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from types import TracebackType

from splatam_core.datasets.bag.recording import RawMessage


class ReadAhead:
    """Messages in order, read before they are needed. Use it as a context manager, which ends the thread."""

    def __init__(self, messages: Iterator[RawMessage], size: int) -> None:
        """Start reading.

        Args:
            messages: is iterated by the thread only.
            size: largest number of messages to hold.
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
        """True if every message has been taken.

        Raises:
            Exception: the error that ended reading, once all messages read before it have been taken.
        """
        with self._changed:
            if self._is_over and not self._waiting and self._error is not None:
                raise self._error
            return self._is_over and not self._waiting

    def take(self, timeout_s: float) -> RawMessage | None:
        """Returns the next message; None at the end, or if none was read in time."""
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
        except Exception as error:  # noqa: BLE001 - raised where messages are taken
            self._error = error
        with self._changed:
            self._is_over = True
            self._changed.notify_all()

    def _put(self, message: RawMessage) -> bool:
        """Queue a message once there is capacity. Returns False if reading should end."""
        with self._changed:
            self._changed.wait_for(lambda: self._is_stopping or len(self._waiting) < self._size)
            self._waiting.append(message)
            self._changed.notify_all()
            return not self._is_stopping
