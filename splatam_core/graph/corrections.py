"""Corrections of poses: motions of the world at keyframes, interpolated between them so that nothing tears."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatam_core.geometry import motions, se3
from splatam_core.geometry.se3 import Matrix

Frames = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Corrections:
    """By what motion the world moves at each keyframe.

    Attributes:
        frames: [K] numbers of frames, increasing; at least one.
        motions: [K, 4, 4] the pose after is this times the pose before.
    """

    frames: Frames
    motions: Matrix

    @classmethod
    def between(cls, frames: Frames, T_before: Matrix, T_after: Matrix) -> Corrections:
        """Returns what moves poses [K, 4, 4] to others. One that stays moves by exactly nothing."""
        moved = T_after @ se3.inverse(T_before)
        moved[(T_after == T_before).all(axis=(1, 2))] = np.eye(4)
        return cls(frames, moved)

    def at(self, frames: Frames) -> Matrix:
        """Returns the motions [M, 4, 4] at frames [M]; before the first and after the last keyframe they are those there."""
        after = np.clip(np.searchsorted(self.frames, frames), 1, max(1, len(self.frames) - 1))
        if len(self.frames) == 1:
            return np.repeat(self.motions, len(frames), axis=0)
        first, second = self.frames[after - 1], self.frames[after]
        return blended(self.motions[after - 1], self.motions[after], np.clip((frames - first) / (second - first), 0, 1))


def blended(first: Matrix, second: Matrix, share: NDArray[np.float64]) -> Matrix:
    """Returns motions [M, 4, 4] between motions, a share [M] of the way along the screw; exact at 0 and 1."""
    step = motions.log(second @ se3.inverse(first))
    result = motions.exp(share[:, None] * step) @ first
    result[share == 0], result[share == 1] = first[share == 0], second[share == 1]
    return result
