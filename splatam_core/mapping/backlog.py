"""Optimization steps that are postponed because frames wait, and made up for when there is time."""

from __future__ import annotations

import math
from collections.abc import Iterator

from splatam_core.interruption import Pressure, PressureGauge

MAX_OWED = 30
"""Steps that are made up for at most, about ten frames' worth: what is older has been seen again since."""

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
        self._num_without = 0
        self._next_step = 0

    def due(self, steps: range, pressure: PressureGauge) -> Iterator[int]:
        """Yields the steps of a frame: all of them, but one while a frame waits, and none while the queue is full.

        The others are owed.
        """
        must_step = self._num_without >= MAX_WITHOUT
        self._num_without += 1
        self.postponed, self._next_step = 0, steps.stop
        for num_taken, step in enumerate(steps):
            if not num_taken < _least(pressure(), must_step):
                self.postponed, self._next_step = len(steps) - num_taken, step
                self.owed = min(MAX_OWED, self.owed + self.postponed)
                return
            self._num_without = 0
            yield step

    def overdue(self, pressure: PressureGauge) -> Iterator[int]:
        """Yields the steps that are owed, as long as nothing waits."""
        while self.owed and pressure() is Pressure.NONE:
            self.owed -= 1
            self._num_without = 0
            yield self._next_step
            self._next_step += 1


def _least(pressure: Pressure, must_step: bool) -> float:
    """Returns how many steps a frame takes at least."""
    if pressure is Pressure.NONE:
        return math.inf
    return 1 if must_step or pressure is Pressure.WAITING else 0
