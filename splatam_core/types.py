"""What crosses the core's boundaries: frames in, results and snapshots out. All immutable."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
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
        camera: the pinhole both images were taken with (or rectified to).
        epoch: how often time had jumped back before; stamps increase within an epoch.
    """

    stamp_ns: int
    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    camera: PinholeCamera
    epoch: int = 0


class Status(str, Enum):
    """What became of a frame."""

    INITIALIZED = 'initialized'
    TRACKED = 'tracked'
    LOST = 'lost'


@dataclass(frozen=True, slots=True)
class StageTimings:
    """Wall time one frame spent in each stage, milliseconds."""

    track: float = 0.0
    densify: float = 0.0
    keyframes: float = 0.0
    map: float = 0.0
    total: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class FrameResult:
    """What ``Slam.process`` found out about one frame.

    Attributes:
        index: number of the frame among those processed, from 0.
        stamp_ns: the frame's stamp.
        status: initialized, tracked or lost.
        T_world_cam: [4, 4] float64, camera to world; None exactly when lost.
        is_keyframe: whether the frame was kept for later mapping.
        num_gaussians: size of the map after this frame.
        visible_fraction: fraction of the pixels with a depth reading that see the map at the tracked pose.
        inlier_fraction: fraction of those that agree with the map in depth and colour.
        reason: why the frame is lost; empty otherwise.
        timings: where the time went.
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


@dataclass(frozen=True, slots=True, eq=False)
class RenderedView:
    """What the map looks like from a pose.

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
    """A copy of the map that stays as it was while the map goes on.

    Attributes:
        means: [N, 3] float32 metres, world.
        rgb: [N, 3] float32, nominally in [0, 1].
        opacities: [N] float32 in (0, 1).
        log_scales: [N, 1] float32, log metres; [N, 3] of anisotropic Gaussians.
        rotations: [N, 4] float32 quaternions (w, x, y, z) of any length, axes to world; None of isotropic Gaussians.
    """

    means: NDArray[np.float32]
    rgb: NDArray[np.float32]
    opacities: NDArray[np.float32]
    log_scales: NDArray[np.float32]
    rotations: NDArray[np.float32] | None = None


Arrays = Mapping[str, NDArray[Any]]
