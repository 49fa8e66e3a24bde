"""No tracking: the predicted pose is the result."""

from __future__ import annotations

import torch

from splatam_core.config import TrackingConfig
from splatam_core.geometry.se3 import Matrix
from splatam_core.images.view import View
from splatam_core.interruption import Stop, never
from splatam_core.rasterizer import Gaussians, Rasterizer
from splatam_core.tracking.base import TrackingResult
from splatam_core.tracking.motion import SeenMotion
from splatam_core.tracking.pace import Pace
from splatam_core.tracking.time_offset import TimeOffset


class NullTracker:
    """Returns the predicted pose without looking at the frame; never lost.

    For mapping along given poses, and for measuring everything but tracking.
    """

    def __init__(
        self, rasterizer: Rasterizer, config: TrackingConfig, threads: int, device: torch.device, stop: Stop = never
    ) -> None:
        pass

    def track(
        self,
        view: View,
        gaussians: Gaussians,
        T_cam_world: Matrix,
        T_cam_world_before: Matrix | None = None,
        time_offset: TimeOffset | None = None,
        pace: Pace | None = None,
    ) -> TrackingResult:
        """See ``Tracker.track``."""
        return TrackingResult(T_cam_world, T_cam_world, num_readings=None, visible_fraction=1.0, inlier_fraction=1.0)

    def motion(self, view: View, before: View, T_now_before: Matrix) -> SeenMotion | None:
        """See ``Tracker.motion``: it is not asked for, because no pose has evidence."""
        return None
