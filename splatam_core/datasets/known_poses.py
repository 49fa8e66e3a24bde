"""True poses in place of tracking (``tracking.method: truth``): mapping alone, as in the original's ``use_gt_poses``."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatam_core.datasets.base import Sequence
from splatam_core.errors import ConfigError, FrameError
from splatam_core.geometry import se3
from splatam_core.geometry.trajectory import Trajectory, interpolate_centres, stamp_text
from splatam_core.types import RgbdFrame

Matrix = NDArray[np.float64]


class FramesWithTruth:
    """The frames of a sequence whose true pose is known; asking for another is a FrameError.

    Attributes:
        name, camera, depth_scale: as ``Sequence`` has them.
    """

    def __init__(self, sequence: Sequence) -> None:
        """Take a sequence that has true poses.

        Raises:
            ConfigError: it has none.
        """
        truth = sequence.ground_truth()
        if truth is None or len(truth) == 0:
            raise ConfigError(f'tracking.method = truth: {sequence.name} has no true poses; choose render_and_compare or align')
        self.name, self.camera, self.depth_scale = sequence.name, sequence.camera, sequence.depth_scale
        self._sequence = sequence
        self._truth = truth

    def __len__(self) -> int:
        return len(self._sequence)

    def __getitem__(self, index: int) -> RgbdFrame:
        """Read one frame.

        Raises:
            FrameError: its true pose is not known.
        """
        frame = self._sequence[index]
        if self._pose(frame.stamp_ns) is None:
            raise FrameError(f'there is no true pose at {stamp_text(frame.stamp_ns)} s (tracking.method = truth)')
        return frame

    def ground_truth(self) -> Trajectory:
        """The truth of the whole recording."""
        return self._truth

    def motion(self, from_ns: int, to_ns: int) -> Matrix | None:
        """[4, 4] pose of the camera at the second stamp in the camera at the first; None where not known."""
        start, end = self._pose(from_ns), self._pose(to_ns)
        return None if start is None or end is None else se3.inverse(start) @ end

    def _pose(self, stamp_ns: int) -> Matrix | None:
        """[4, 4] interpolated along the screw between the neighbours; None where the truth has a gap."""
        truth = self._truth
        _, known = interpolate_centres(truth, np.array([stamp_ns], np.int64))
        if not known[0]:
            return None
        after = min(int(np.searchsorted(truth.stamps_ns, stamp_ns)), len(truth) - 1)
        before = max(0, after - 1)
        interval_ns = int(truth.stamps_ns[after] - truth.stamps_ns[before])
        fraction = np.clip((stamp_ns - int(truth.stamps_ns[before])) / interval_ns, 0, 1) if interval_ns else 0.0
        return se3.interpolate(truth.T_world_cam[before], truth.T_world_cam[after], float(fraction))
