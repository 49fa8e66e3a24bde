"""Types that cross the core's boundary: frames in, results and snapshots out. All are immutable."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from splatam_core.geometry.camera import PinholeCamera


@dataclass(frozen=True, slots=True, eq=False)
class RgbdFrame:
    """One colour image with depth registered to it, from an ideal camera.

    Attributes:
        stamp_ns: time of the exposure, integer nanoseconds.
        rgb: [H, W, 3] uint8, RGB.
        depth_m: [H, W] float32 metres along the optical axis; 0 = no reading, never NaN or inf.
        camera: pinhole camera of both images, after rectification.
        epoch: number of backward time jumps before this frame; stamps increase within an epoch.
        frame_id: coordinate frame of the colour image, as its ROS header names it; empty for recordings without one.
        depth_spacing: mean distance in pixels between neighbouring readings before the frame was made smaller; 1 = dense, or it
            was not made smaller.
    """

    stamp_ns: int
    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    camera: PinholeCamera
    epoch: int = 0
    frame_id: str = ''
    depth_spacing: float = 1.0


class Status(str, Enum):
    """Outcome of tracking one frame."""

    INITIALIZED = 'initialized'
    TRACKED = 'tracked'
    UNCERTAIN = 'uncertain'
    LOST = 'lost'

    @property
    def is_trusted(self) -> bool:
        """Whether the pose may be relied on and the frame be mapped."""
        return self in (Status.INITIALIZED, Status.TRACKED)


@dataclass(frozen=True, slots=True)
class StageTimings:
    """Wall time that one frame took in each stage, in milliseconds."""

    track: float = 0.0
    densify: float = 0.0
    keyframes: float = 0.0
    map: float = 0.0
    graph: float = 0.0
    total: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class PoseCovariance:
    """How far a camera's pose may be off: relative to the map near it, and that of the map since the start.

    The pose's error is that of x, y, z (m) and of the rotations about x, y, z (rad) through the camera's centre, in this
    order, in the axes of the world (ROS REP 103).

    Attributes:
        relative: [6, 6] of the pose relative to the map that the frame sees.
        drift_position_m: standard deviation, along each axis, of where the map itself is.
        drift_rotation_rad: about each axis, of how it is turned.
    """

    relative: NDArray[np.float64]
    drift_position_m: float
    drift_rotation_rad: float

    @property
    def total(self) -> NDArray[np.float64]:
        """[6, 6] of the pose relative to the first frame."""
        return self.relative + np.diag(np.repeat([self.drift_position_m**2, self.drift_rotation_rad**2], 3))


@dataclass(frozen=True, slots=True, eq=False)
class FrameResult:
    """What ``Slam.process`` returns for one frame.

    Attributes:
        index: number of the frame among those processed, from 0.
        stamp_ns: the frame's stamp.
        status: initialized, tracked, uncertain or lost. Only initialized and tracked frames are mapped.
        T_world_cam: [4, 4] float64, camera to world; None if and only if the frame is lost.
        is_keyframe: True if the frame was kept as a keyframe for later mapping.
        num_gaussians: number of Gaussians in the map after this frame.
        visible_fraction: fraction of the pixels with a depth reading that see the map at the tracked pose.
        inlier_fraction: fraction of those that agree with the map in depth and colour.
        reason: why the frame is uncertain or lost; empty otherwise.
        timings: wall time of each stage.
        covariance: of the pose; None if the frame is lost or the tracker estimates none.
        num_held: number of directions (of six) that the images did not determine, in which the pose is the predicted one.
        is_relocalised: True if the camera was found anew in the map: its pose does not follow from the frame before.
        T_world_odom: [4, 4] all corrections of the world before this frame, and the unknown ways of a camera that was found
            elsewhere: its pose is this times one that never jumps.
        postponed_steps: number of optimization steps that were postponed, because the next frame waited already.
    """

    index: int
    stamp_ns: int
    status: Status
    T_world_cam: NDArray[np.float64] | None
    is_keyframe: bool
    num_gaussians: int
    visible_fraction: float
    inlier_fraction: float
    reason: str
    timings: StageTimings
    covariance: PoseCovariance | None = None
    num_held: int = 0
    is_relocalised: bool = False
    T_world_odom: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    postponed_steps: int = 0


@dataclass(frozen=True, slots=True)
class GraphSummary:
    """What a keyframe graph holds.

    Attributes:
        nodes: number of keyframes.
        loops: number of places that were recognised.
        corrections: number of times that poses and map were corrected.
        last_correction_m: distance by which the last of them moved the newest pose; 0 before the first.
    """

    nodes: int = 0
    loops: int = 0
    corrections: int = 0
    last_correction_m: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class RenderedView:
    """The map rendered from one pose.

    Attributes:
        rgb: [H, W, 3] uint8.
        depth_m: [H, W] float32, expected depth; 0 where the silhouette is below 0.5.
        silhouette: [H, W] float32 in [0, 1].
    """

    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    silhouette: NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class MapSnapshot:
    """A copy of the map that does not change while mapping continues.

    Attributes:
        means: [N, 3] float32 metres, world.
        rgb: [N, 3] float32, nominally in [0, 1].
        opacities: [N] float32 in (0, 1).
        log_scales: [N, 1] float32, log metres; [N, 3] for anisotropic Gaussians.
        rotations: [N, 4] float32 quaternions (w, x, y, z) of any length, axes to world; None for isotropic Gaussians.
    """

    means: NDArray[np.float32]
    rgb: NDArray[np.float32]
    opacities: NDArray[np.float32]
    log_scales: NDArray[np.float32]
    rotations: NDArray[np.float32] | None = None


Arrays = Mapping[str, NDArray[Any]]
