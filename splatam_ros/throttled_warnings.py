"""Warnings that may repeat with every frame, said once in a while."""

from __future__ import annotations

import time

from rclpy.impl.rcutils_logger import RcutilsLogger


class ThrottledWarnings:
    """Logs the first warning of each kind, and then one in a period, saying how many there were meanwhile."""

    def __init__(self, logger: RcutilsLogger, period_s: float = 10.0) -> None:
        """Log to a node's logger.

        Args:
            logger: where to.
            period_s: between two warnings of the same kind.
        """
        self._logger = logger
        self._period_s = period_s
        self._said_s: dict[str, float] = {}
        self._withheld: dict[str, int] = {}

    def warn(self, kind: str, text: str) -> None:
        """Say it, unless something of this kind was said a moment ago."""
        now_s = time.monotonic()
        if now_s - self._said_s.get(kind, -float('inf')) < self._period_s:
            self._withheld[kind] = self._withheld.get(kind, 0) + 1
            return
        self._said_s[kind] = now_s
        withheld = self._withheld.pop(kind, 0)
        self._logger.warning(text + (f' (and {withheld} more of this kind before)' if withheld else ''))
