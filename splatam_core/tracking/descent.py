"""Gauss-Newton on photometric and depth residuals at one level of a pyramid: the arithmetic on ten unknowns.

It works with any aligner. The native aligner takes the same steps in ``csrc/descent.cpp``, because numpy needs as long for ten
numbers as native code for the sums over all pixels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatam_core.geometry.se3 import Matrix
from splatam_core.tracking.aligner import AlignmentState, Descent, Linearization, LinearSystem

TIME_OFFSET, READOUT = 8, 9
"""Unknowns."""

_MIN_POINTS = 50
_MIN_SCALES = 0.004, 0.001  # no sensor is better
_MAD_TO_DEVIATION = 1.4826  # standard deviation over median absolute deviation, for a normal distribution


def descend(
    linearize: Callable[[Linearization[Any]], LinearSystem], task: Descent[Any], start: AlignmentState
) -> AlignmentState:  # fmt: skip
    """Takes steps until one is small. Returns the state after them, with the scales of the residuals before the last one."""
    state = start
    for _ in range(task.iterations):
        if task.predicted_motion is not None:
            state = replace(state, velocity=task.pace.twist(state.depth_motion @ task.predicted_motion))
        system = linearize(task.at(state))
        state = replace(state, scales=_scales(system))
        step = Equations.of(system, state, task).step()
        if step is None:
            break
        state = state.moved(step)
        if np.abs(step[:6]).max() < task.small_step:
            break
    return state


@dataclass(frozen=True, slots=True, eq=False)
class Equations:
    """The normal equations of all ten unknowns, the readout the last of them, without what is known before.

    Attributes:
        H: [10, 10].
        g: [10].
        off: [10] by how much the state differs from what is known before.
        num_seen: number of points.
        task: what is known before, and what is solved for.
    """

    H: Matrix
    g: Matrix
    off: Matrix
    num_seen: int
    task: Descent[Any]

    @classmethod
    def of(cls, system: LinearSystem, state: AlignmentState, task: Descent[Any]) -> Equations:
        """Returns those of a system. A point moves with the readout as with the time offset, times when its row is read."""
        H, g, turn = np.zeros((10, 10)), np.zeros(10), state.velocity
        H[:9, :9], g[:9] = system.H, system.g
        if task.is_free[READOUT]:
            H[:9, 9] = H[9, :9] = system.H_by_time[:, :6] @ turn
            H[9, 9] = turn @ system.H_by_time_squared[:6, :6] @ turn
            g[9] = turn @ system.g_by_time[:6]
        found = np.array([0.0] * 6 + [state.gain, state.bias, state.time_offset, state.readout])
        return cls(H, g, found - task.mean, system.seen, task)

    def information(self, unknown: int) -> float:
        """Returns the inverse variance that the residuals claim for an unknown, the other free ones marginalized."""
        free, H = self._free, self.H + np.diag(self.task.information)
        others = free[free != unknown]
        among_others, across = H[others[:, None], others], H[others, unknown]
        return float(self.H[unknown, unknown] - across @ np.linalg.solve(among_others, across))

    def step(self) -> Matrix | None:
        """Returns the step [10] of the free unknowns that minimises the residuals; None if they do not determine one.

        On a ramp of brightness a shift looks like a change of bias. What is known before decides what the residuals leave open.
        """
        if self.num_seen < _MIN_POINTS:
            return None
        known, free, step = self.task.information, self._free, np.zeros(10)
        H, g = self.H + np.diag(known), self.g + known * self.off
        try:
            step[free] = -np.linalg.solve(H[free[:, None], free], g[free])
        except np.linalg.LinAlgError:
            return None
        return step

    @property
    def _free(self) -> NDArray[np.intp]:
        return np.flatnonzero(self.task.is_free)


def _scales(system: LinearSystem) -> Matrix:
    """Returns [2] the scales of the residuals of brightness and depth, from their medians."""
    medians = system.photometric_median, system.depth_median
    return np.array([max(least, _MAD_TO_DEVIATION * median) for least, median in zip(_MIN_SCALES, medians, strict=True)])
