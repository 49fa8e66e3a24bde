"""Selects the frames that are passed to SLAM: none while paused, and no more than a maximum rate."""

from __future__ import annotations


class FrameGate:
    """Rejects every frame while paused, and limits the rate of the others by their stamps.

    Attributes:
        is_paused: True while every frame is rejected.
        max_rate_hz: largest number of frames per second of stamps; 0 = no limit.
    """

    def __init__(self, max_rate_hz: float) -> None:
        self.is_paused = False
        self.max_rate_hz = max_rate_hz
        self._epoch = 0
        self._due_ns: float = 0.0

    def admits(self, epoch: int, stamp_ns: int) -> bool:
        """Returns True if the frame of this stamp is passed on. Call once per frame, in order."""
        if self.is_paused:
            return False
        if self.max_rate_hz == 0:
            return True
        if epoch == self._epoch and stamp_ns < self._due_ns:
            return False
        period_ns = 1e9 / self.max_rate_hz
        # Due times are on a grid, so that a frame that comes slightly early does not cost a whole period.
        is_on_grid = epoch == self._epoch and stamp_ns - self._due_ns < period_ns
        self._due_ns = (self._due_ns if is_on_grid else stamp_ns) + period_ns
        self._epoch = epoch
        return True
