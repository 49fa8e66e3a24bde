"""How the camera moves from frame to frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from splatam_core.geometry import se3
from splatam_core.geometry.se3 import Matrix
from splatam_core.tracking.readout import ReadoutSeen


@dataclass(frozen=True, slots=True, eq=False)
class Pace:
    """How the camera moves from one frame to the next: by as much of that are colour and depth, and the rows of an image, apart.

    An alignment finds how far a frame is from the last pose. After a jump, or where the last pose was wrong, no camera has moved
    like that.

    Attributes:
        num_frames: intervals between frames since the last pose.
        expected: [6] twist in one of them.
        limit_m: by how much it may be wrong, metres.
        limit_rad: by how much its rotation may be wrong.
        readout: how long reading an image takes, as a fraction of an interval; None if nothing is known about it.
    """

    num_frames: int = 1
    expected: Matrix = field(default_factory=lambda: np.zeros(6))
    limit_m: float = math.inf
    limit_rad: float = math.inf
    readout: ReadoutSeen | None = None

    def twist(self, T_now_last: Matrix) -> Matrix:
        """Returns the twist [6] in one interval, from the motion [4, 4] since the last pose: less of what is not possible."""
        found = se3.log(T_now_last) / self.num_frames
        off = found - self.expected
        excess = max(float(np.linalg.norm(off[:3])) / self.limit_m, float(np.linalg.norm(off[3:])) / self.limit_rad)
        return found if excess <= 1 else self.expected + off / excess**2
