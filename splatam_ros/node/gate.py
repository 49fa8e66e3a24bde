"""Selects the frames that are passed to SLAM: none while paused, and no more than a maximum rate."""

from __future__ import annotations


class FrameGate:
    """Rejects every frame while paused, and limits the rate of the others by their stamps.

    Attributes:
        is_paused: True while every frame is rejected.
    """

    def __init__(self, max_rate_hz: float) -> None:
        self.is_paused = False
        self._max_rate_hz = max_rate_hz
        self._epoch = 0
        self._due_ns: float = 0.0
        self._last_ns: int | None = None

    @property
    def max_rate_hz(self) -> float:
        """Largest number of frames per second of stamps; 0 = no limit. A change holds from the last admitted frame on."""
        return self._max_rate_hz

    @max_rate_hz.setter
    def max_rate_hz(self, max_rate_hz: float) -> None:
        if max_rate_hz != self._max_rate_hz:
            self._max_rate_hz = max_rate_hz
            if max_rate_hz and self._last_ns is not None:
                self._due_ns = self._last_ns + 1e9 / max_rate_hz

    def admits(self, epoch: int, stamp_ns: int) -> bool:
        """Returns True if the frame of this stamp is passed on. Call once per frame, in order."""
        if self.is_paused or not self._is_due(epoch, stamp_ns):
            return False
        self._epoch, self._last_ns = epoch, stamp_ns
        return True

    def _is_due(self, epoch: int, stamp_ns: int) -> bool:
        if self._max_rate_hz == 0:
            return True
        if epoch == self._epoch and stamp_ns < self._due_ns:
            return False
        period_ns = 1e9 / self._max_rate_hz
        # Due times are on a grid, so that a frame that comes slightly early does not cost a whole period.
        is_on_grid = epoch == self._epoch and stamp_ns - self._due_ns < period_ns
        self._due_ns = (self._due_ns if is_on_grid else stamp_ns) + period_ns
        return True
