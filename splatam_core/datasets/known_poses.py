"""Ground-truth poses instead of tracking (``tracking.method: truth``), to test mapping alone; SplaTAM's ``use_gt_poses``."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatam_core.datasets.base import Sequence
from splatam_core.errors import ConfigError, FrameError
from splatam_core.geometry import se3
from splatam_core.geometry.trajectory import Trajectory, interpolate_centres, stamp_text
from splatam_core.types import RgbdFrame

Matrix = NDArray[np.float64]


class FramesWithGroundTruth:
    """A sequence with the true poses of its frames. Reading a frame without true pose raises ``FrameError``.

    Attributes:
        name, camera, depth_scale: see ``Sequence``.
    """

    def __init__(self, sequence: Sequence) -> None:
        """Read the ground truth of a sequence.

        Raises:
            ConfigError: it has none.
        """
        ground_truth = sequence.ground_truth()
        if ground_truth is None or len(ground_truth) == 0:
            raise ConfigError(f'tracking.method = truth: {sequence.name} has no ground truth; choose render_and_compare or align')
        self.name, self.camera, self.depth_scale = sequence.name, sequence.camera, sequence.depth_scale
        self._sequence = sequence
        self._ground_truth = ground_truth

    def __len__(self) -> int:
        return len(self._sequence)

    def __getitem__(self, index: int) -> RgbdFrame:
        """Read one frame.

        Raises:
            FrameError: its true pose is unknown.
        """
        frame = self._sequence[index]
        if self._pose(frame.stamp_ns) is None:
            raise FrameError(f'there is no true pose at {stamp_text(frame.stamp_ns)} s (tracking.method = truth)')
        return frame

    def ground_truth(self) -> Trajectory:
        """The ground truth of the whole recording."""
        return self._ground_truth

    def motion(self, from_ns: int, to_ns: int) -> Matrix | None:
        """Returns the [4, 4] pose of the camera at the second stamp in the camera at the first; None if it is unknown."""
        start, end = self._pose(from_ns), self._pose(to_ns)
        return None if start is None or end is None else se3.inverse(start) @ end

    def _pose(self, stamp_ns: int) -> Matrix | None:
        """Returns the [4, 4] pose interpolated on SE(3) between its neighbours; None in a gap of the ground truth."""
        ground_truth = self._ground_truth
        _, known = interpolate_centres(ground_truth, np.array([stamp_ns], np.int64))
        if not known[0]:
            return None
        after = min(int(np.searchsorted(ground_truth.stamps_ns, stamp_ns)), len(ground_truth) - 1)
        before = max(0, after - 1)
        interval_ns = int(ground_truth.stamps_ns[after] - ground_truth.stamps_ns[before])
        fraction = np.clip((stamp_ns - int(ground_truth.stamps_ns[before])) / interval_ns, 0, 1) if interval_ns else 0.0
        return se3.interpolate(ground_truth.T_world_cam[before], ground_truth.T_world_cam[after], float(fraction))
