"""The nodes of the keyframe graph: where keyframes were tracked, and where they are after all corrections."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from splatam_core.geometry import se3
from splatam_core.geometry.se3 import Matrix, Vector
from splatam_core.graph.corrections import blended
from splatam_core.tracking.read_motion import STILL, ReadMotion

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
        velocity: [K, 6] of the camera, see ``ReadMotion``; zeros where it is not known.
        readout_s: [K] as it was estimated then.
        delay_s: [K] as it was estimated then.
    """

    frames: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    stamps_ns: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    tracked: Matrix = field(default_factory=lambda: _NO_POSES)
    placed: Matrix = field(default_factory=lambda: _NO_POSES)
    T_world_cam: Matrix = field(default_factory=lambda: _NO_POSES)
    velocity: Matrix = field(default_factory=lambda: np.empty((0, 6)))
    readout_s: Vector = field(default_factory=lambda: np.empty(0))
    delay_s: Vector = field(default_factory=lambda: np.empty(0))

    def __len__(self) -> int:
        return len(self.frames)

    def added(self, frame: int, stamp_ns: int, T_world_cam: Matrix, motion: ReadMotion = STILL) -> Nodes:
        """Returns the nodes with one more. motion: of the camera while it took the frame."""
        pose = T_world_cam[None]
        return Nodes(
            frames=np.append(self.frames, frame),
            stamps_ns=np.append(self.stamps_ns, stamp_ns),
            tracked=np.concatenate([self.tracked, pose]),
            placed=np.concatenate([self.placed, pose]),
            T_world_cam=np.concatenate([self.T_world_cam, pose]),
            velocity=np.concatenate([self.velocity, motion.velocity[None]]),
            readout_s=np.append(self.readout_s, motion.readout_s),
            delay_s=np.append(self.delay_s, motion.delay_s),
        )

    def motion(self, node: int, as_known_at: int) -> ReadMotion:
        """Returns how the camera moved while it took a node's frame.

        The readout, a property of the camera, is better known at a later node; the delay drifts.
        """
        return ReadMotion(self.velocity[node], float(self.readout_s[as_known_at]), float(self.delay_s[node]))

    def before(self, frame: int) -> Nodes:
        """Returns the nodes of the frames before a number."""
        count = int(np.searchsorted(self.frames, frame))
        return Nodes(**{name: getattr(self, name)[:count] for name in Nodes.__dataclass_fields__})

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
