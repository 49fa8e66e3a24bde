"""Optimization steps that are postponed because frames wait, and made up for when there is time."""

from __future__ import annotations

import math
from collections.abc import Iterator

from splatam_core.interruption import Pressure, PressureGauge

MAX_OWED_FRAMES = 10
"""The steps of this many frames are made up for at most: what is older has been seen again since."""

MAX_WITHOUT = 3
"""Frames in a row without a step; the next one takes one whatever waits, so that new Gaussians are fitted."""


class StepBacklog:
    """Counts the steps that mapping owes.

    Attributes:
        owed: number of postponed steps that may still be taken.
        postponed: number of steps that the last frame postponed.
    """

    def __init__(self) -> None:
        self.owed = self.postponed = 0
        self._num_without = self._num_behind = 0
        self._next_step = 0

    def due(self, steps: range, pressure: PressureGauge) -> Iterator[int]:
        """Yields the steps of a frame: all of them, but one while a frame waits, and none while the queue is full.

        The others are owed. Numbers go on from that of the last step taken, so that what is done at every n-th step stays so.
        """
        must_step = self._num_without >= MAX_WITHOUT
        self._num_without += 1
        self.postponed, self._next_step = 0, steps.start - self._num_behind
        for num_taken in range(len(steps)):
            if not num_taken < _least(pressure(), must_step):
                self.postponed = len(steps) - num_taken
                self._num_behind += self.postponed
                self.owed = min(MAX_OWED_FRAMES * len(steps), self.owed + self.postponed)
                return
            yield self._taken()

    def overdue(self, pressure: PressureGauge) -> Iterator[int]:
        """Yields the steps that are owed, as long as nothing waits."""
        while self.owed and pressure() is Pressure.NONE:
            self.owed -= 1
            self._num_behind -= 1
            yield self._taken()

    def forgive(self) -> None:
        """Owes nothing any more."""
        self.owed = 0

    def _taken(self) -> int:
        """Returns the number of the step that is taken now."""
        self._num_without = 0
        self._next_step += 1
        return self._next_step - 1


def _least(pressure: Pressure, must_step: bool) -> float:
    """Returns how many steps a frame takes at least."""
    if pressure is Pressure.NONE:
        return math.inf
    return 1 if must_step or pressure is Pressure.WAITING else 0
