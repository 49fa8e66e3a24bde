"""How far apart the stamps of a colour and a depth image may be: a fixed time, or one that adapts to the rate."""

from __future__ import annotations

from collections import deque

LEAST_NS, MOST_NS = 20_000_000, 50_000_000
NUM_PERIODS = 15


class PairInterval:
    """The largest distance of the stamps of a pair.

    Without a fixed one it is half the median time between the last colour images: beyond that, another image is nearer. It is
    at least 20 ms, because drivers stamp inexactly, and at most 50 ms, because cameras move.
    """

    def __init__(self, fixed_ns: int | None) -> None:
        """Start without images.

        Args:
            fixed_ns: the distance; None adapts it.
        """
        self._fixed_ns = fixed_ns
        self._newest_ns: int | None = None
        self._periods_ns: deque[int] = deque(maxlen=NUM_PERIODS)

    @property
    def ns(self) -> int:
        """The distance now."""
        if self._fixed_ns is not None:
            return self._fixed_ns
        if not self._periods_ns:
            return LEAST_NS
        median_ns = sorted(self._periods_ns)[len(self._periods_ns) // 2]
        return min(max(median_ns // 2, LEAST_NS), MOST_NS)

    def add_color(self, stamp_ns: int) -> None:
        """Take note of a colour image."""
        if self._newest_ns is not None and stamp_ns > self._newest_ns:
            self._periods_ns.append(stamp_ns - self._newest_ns)
        self._newest_ns = stamp_ns
