"""What every tracker does and returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from splatam_core.geometry.se3 import Matrix
from splatam_core.images.view import View
from splatam_core.rasterizer import Gaussians
from splatam_core.tracking.evidence import Evidence
from splatam_core.tracking.motion import SeenMotion
from splatam_core.tracking.pace import Pace
from splatam_core.tracking.readout import ReadoutSeen
from splatam_core.tracking.time_offset import TimeOffset


@dataclass(frozen=True, slots=True, eq=False)
class TrackingResult:
    """A pose and the evidence for it; ``verdict.verify`` decides whether it may be used.

    Attributes:
        T_cam_world: [4, 4] float64, at the colour image's time.
        T_cam_world_depth: [4, 4] float64, at the depth image's time; the same for trackers that do not tell the two apart.
        num_readings: pixels with a depth reading; None for a tracker that looks at none.
        visible_fraction: fraction of the pixels with a depth reading that see the map at the pose.
        inlier_fraction: fraction of those that agree with the map in depth and colour.
        time_offset: between colour and depth, after this frame.
        evidence: how far the pose may be trusted; None for a tracker that does not say.
        readout: what the frame tells about the time that reading an image takes; None if nothing.
    """

    T_cam_world: Matrix
    T_cam_world_depth: Matrix
    num_readings: int | None
    visible_fraction: float
    inlier_fraction: float
    time_offset: TimeOffset = TimeOffset()
    evidence: Evidence | None = None
    readout: ReadoutSeen | None = None


class Tracker(Protocol):
    """A way to find the camera."""

    def track(
        self,
        view: View,
        gaussians: Gaussians,
        T_cam_world: Matrix,
        T_cam_world_before: Matrix | None = None,
        time_offset: TimeOffset | None = None,
        pace: Pace | None = None,
    ) -> TrackingResult:
        """Finds the pose from which the map looks like the view; changes nothing.

        Args:
            view: what the camera sees.
            gaussians: the map.
            T_cam_world: [4, 4] predicted pose.
            T_cam_world_before: [4, 4] the last pose; None if not known.
            time_offset: between colour and depth, as the frames before tell; None if they tell nothing.
            pace: how the camera is expected to move from frame to frame; None if not known.
        """

    def motion(self, view: View, before: View, T_now_before: Matrix) -> SeenMotion | None:
        """Finds how the camera has moved between two frames, without the map; changes nothing.

        Args:
            view: what the camera sees.
            before: what it saw.
            T_now_before: [4, 4] the camera then in the camera now, as predicted.

        Returns:
            The motion; None if the images do not fit each other.
        """
