"""Tells a wrong stamp from a jump in time: a frame out of line with those before it waits until the next one agrees."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from msg_adapters.synchronizer import RgbdSet

USUAL_GAPS = 10  # frames that follow each other are at most this many times the last gap apart, or the threshold


class StampFilter:
    """Drops single sets whose stamps are wrong, and counts the backward jumps of time that remain.

    A set is in line if it is later than the last one, but not by much. A set out of line is held back. If the next set
    is in line with the last one, the stamp of the one held back was wrong, and it is dropped. If the next set follows the
    one held back, time has jumped, and both are passed on.
    """

    def __init__(self, threshold_ns: int, on_wrong: Callable[[RgbdSet, int], None]) -> None:
        """Start without sets.

        Args:
            threshold_ns: stamps may be this far apart.
            on_wrong: called with each set that is dropped, and with the stamp (ns) of the last one in line.
        """
        self._threshold_ns = threshold_ns
        self._on_wrong = on_wrong
        self._held: RgbdSet | None = None
        self._last_ns: int | None = None
        self._gap_ns = 0
        self._epoch = 0

    @property
    def is_holding(self) -> bool:
        """True while a set waits for the next one."""
        return self._held is not None

    def add(self, found: RgbdSet) -> list[RgbdSet]:
        """Add a set. Returns the sets to pass on; their ``resets`` count the jumps back among these."""
        before, self._held = self._held, None
        if self._last_ns is None:
            return [self._accept(found)]
        advance_ns = found.stamp_ns - self._last_ns
        is_late = -self._threshold_ns <= advance_ns <= 0
        if 0 < advance_ns <= self._largest_gap_ns:
            self._drop(before)
            return [self._accept(found)]
        if before is not None and self._follows(before, self._last_ns, found):
            return [self._accept(before), self._accept(found)]
        self._drop(found if is_late else before)
        self._held = before if is_late else found
        return []

    def flush(self) -> list[RgbdSet]:
        """Returns the set that is held back, if there is one: no other set has spoken against it."""
        held, self._held = self._held, None
        return [] if held is None else [self._accept(held)]

    @property
    def _largest_gap_ns(self) -> int:
        return max(self._threshold_ns, USUAL_GAPS * self._gap_ns)

    def _follows(self, before: RgbdSet, last_ns: int, found: RgbdSet) -> bool:
        jump_ns = abs(before.stamp_ns - last_ns)
        return 0 < found.stamp_ns - before.stamp_ns <= max(self._largest_gap_ns, jump_ns)

    def _accept(self, found: RgbdSet) -> RgbdSet:
        if self._last_ns is not None:
            advance_ns = found.stamp_ns - self._last_ns
            self._epoch += advance_ns <= 0
            self._gap_ns = max(0, advance_ns)
        self._last_ns = found.stamp_ns
        return replace(found, resets=self._epoch)

    def _drop(self, wrong: RgbdSet | None) -> None:
        if wrong is not None and self._last_ns is not None:
            self._on_wrong(wrong, self._last_ns)
