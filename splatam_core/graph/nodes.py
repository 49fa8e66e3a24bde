"""The nodes of the keyframe graph: where keyframes were tracked, and where they are after all corrections."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from splatam_core.geometry import se3
from splatam_core.geometry.se3 import Matrix
from splatam_core.graph.corrections import blended

_NO_POSES = np.empty((0, 4, 4))


@dataclass(frozen=True, slots=True, eq=False)
class Nodes:
    """K keyframes. Those that the map no longer keeps stay here, because the poses of the frames around them depend on them.

    Attributes:
        frames: [K] int64 numbers of the frames, increasing.
        stamps_ns: [K] int64.
        tracked: [K, 4, 4] camera to world as it was published.
        placed: [K, 4, 4] the same after what was corrected at this keyframe: frames after it are tracked in this world.
        T_world_cam: [K, 4, 4] the same after all corrections.
    """

    frames: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    stamps_ns: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    tracked: Matrix = field(default_factory=lambda: _NO_POSES)
    placed: Matrix = field(default_factory=lambda: _NO_POSES)
    T_world_cam: Matrix = field(default_factory=lambda: _NO_POSES)

    def __len__(self) -> int:
        return len(self.frames)

    def added(self, frame: int, stamp_ns: int, T_world_cam: Matrix) -> Nodes:
        """Returns the nodes with one more."""
        pose = T_world_cam[None]
        return Nodes(
            frames=np.append(self.frames, frame),
            stamps_ns=np.append(self.stamps_ns, stamp_ns),
            tracked=np.concatenate([self.tracked, pose]),
            placed=np.concatenate([self.placed, pose]),
            T_world_cam=np.concatenate([self.T_world_cam, pose]),
        )

    def before(self, frame: int) -> Nodes:
        """Returns the nodes of the frames before a number."""
        count = int(np.searchsorted(self.frames, frame))
        return Nodes(
            self.frames[:count], self.stamps_ns[:count], self.tracked[:count], self.placed[:count], self.T_world_cam[:count]
        )

    def moved(self, T_world_cam: Matrix) -> Nodes:
        """Returns the nodes at other poses [K, 4, 4], corrected at the last one."""
        placed = self.placed.copy()
        placed[-1] = T_world_cam[-1]
        return replace(self, placed=placed, T_world_cam=T_world_cam)

    def corrected(self, stamps_ns: NDArray[np.int64], T_world_cam: Matrix) -> Matrix:
        """Returns where frames are after all corrections.

        Args:
            stamps_ns: [M] of the frames.
            T_world_cam: [M, 4, 4] as they were published.
        """
        if not len(self):
            return T_world_cam
        before, after = self.T_world_cam @ se3.inverse(self.tracked), self.T_world_cam @ se3.inverse(self.placed)
        next_one = np.searchsorted(self.stamps_ns, stamps_ns)  # the first keyframe that is not earlier
        first, second = np.maximum(next_one - 1, 0), np.minimum(next_one, len(self) - 1)
        begin, end = self.stamps_ns[first], self.stamps_ns[second]
        share = np.where(end > begin, (stamps_ns - begin) / np.maximum(end - begin, 1), 1.0)
        share = np.where(next_one == len(self), 0.0, share)
        motion = blended(after[first], before[second], share)
        return motion @ T_world_cam
