"""Which of the frames that arrive go on to SLAM."""

from __future__ import annotations


class Gate:
    """Lets no frame through while paused, and no more in a second of their own time than asked for.

    Attributes:
        is_paused: whether it is shut.
        max_rate_hz: most frames a second of stamps; 0 = no limit.
    """

    def __init__(self, max_rate_hz: float) -> None:
        self.is_paused = False
        self.max_rate_hz = max_rate_hz
        self._epoch = 0
        self._due_ns: float = 0.0

    def admits(self, epoch: int, stamp_ns: int) -> bool:
        """Whether the frame of this stamp goes on; asked once a frame, in their order."""
        if self.is_paused:
            return False
        if self.max_rate_hz == 0:
            return True
        if epoch == self._epoch and stamp_ns < self._due_ns:
            return False
        period_ns = 1e9 / self.max_rate_hz
        # On a grid of times, so that frames which come a little early do not cost the rate a whole frame.
        is_on_grid = epoch == self._epoch and stamp_ns - self._due_ns < period_ns
        self._due_ns = (self._due_ns if is_on_grid else stamp_ns) + period_ns
        self._epoch = epoch
        return True
