"""Limits the rate of warnings that could repeat with every frame."""

from __future__ import annotations

import time
import traceback

from rclpy.impl.rcutils_logger import RcutilsLogger

from msg_adapters.errors import MessageError
from splatam_core.errors import SplatamError, one_line, printable


class ThrottledWarnings:
    """Logs the first warning of each kind, then at most one per period with the number of suppressed ones."""

    def __init__(self, logger: RcutilsLogger, period_s: float = 10.0) -> None:
        """Log to a node's logger.

        Args:
            logger: receives the warnings.
            period_s: shortest time between two warnings of the same kind.
        """
        self._logger = logger
        self._period_s = period_s
        self._logged_s: dict[str, float] = {}
        self._num_suppressed: dict[str, int] = {}

    def warn(self, kind: str, text: str) -> None:
        """Log a warning, unless one of the same kind was logged less than a period ago."""
        now_s = time.monotonic()
        if now_s - self._logged_s.get(kind, -float('inf')) < self._period_s:
            self._num_suppressed[kind] = self._num_suppressed.get(kind, 0) + 1
            return
        self._logged_s[kind] = now_s
        suppressed = self._num_suppressed.pop(kind, 0)
        self._logger.warning(printable(text) + (f' (and {suppressed} more of this kind before)' if suppressed else ''))

    def warn_of(self, kind: str, what: str, error: Exception) -> None:
        """Log a warning about an error. One that the user cannot cause also logs its traceback, at level debug.

        Args:
            kind: kind of the warning.
            what: what it cost, e.g. ``frame skipped``.
            error: the error.
        """
        if isinstance(error, (SplatamError, MessageError)):
            self.warn(kind, f'{what}: {error}')
            return
        self.warn(kind, f'{what}: {describe(error)}; the traceback is logged at level debug')
        self._logger.debug(''.join(traceback.format_exception(error)))


def describe(error: Exception) -> str:
    """Returns one line about an error that nobody expected."""
    return f'unexpected {type(error).__name__}: {one_line(error)}'
