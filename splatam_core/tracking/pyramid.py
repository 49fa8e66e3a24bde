"""Image pyramids for alignment: brightness and depth at a half, a quarter, ... of the resolution."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from torch import Tensor

from splatam_core.geometry.camera import PinholeCamera
from splatam_core.images.filters import is_on_host
from splatam_core.images.view import View
from splatam_core.rasterizer import Render
from splatam_core.tracking.aligner import Aligner, Array

EDGE = 0.05
"""Depth that changes by more than this fraction from one pixel to the next is an edge, not a surface."""

_MAX_HOLE = 0.025  # of the width: wider holes of the depth stay open
_SHARE_POWER = 3  # 2 is the fraction of readings; what lies between them has errors of its own (docs/decisions/0010)
_COARSEST_PX = 32  # smaller images show too little to align
_LEAST_SILHOUETTE = 1e-3  # to divide by
_DEPTH_LAYER = 3


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """One resolution of an image that is aligned.

    Attributes:
        camera: its pinhole.
        brightness: [H, W] in [0, 1]; an array on the host, else a tensor.
        depth: [H, W] metres; NaN where there is none.
        depth_share: weight of a depth relative to dense depth, at most 1; less where many depths lie between readings.
    """

    camera: PinholeCamera
    brightness: Array | Tensor
    depth: Array | Tensor
    depth_share: float = 1.0


def frame_level(view: View, aligner: Aligner[Any]) -> Level:
    """Returns a frame at its full resolution, with small holes of its depth closed.

    Half of a stereo camera's readings may be missing, and depth that was registered by forward warping has a grid of holes.
    Halving drops every block with a hole, and colour is compared only at points of known depth.
    """
    max_gap, share = max(1, round(_MAX_HOLE * view.camera.width)), view.spacing**-_SHARE_POWER
    brightness, depth = aligner.frame_images(_for_aligner(view.rgb8), _for_aligner(view.depth), max_gap, EDGE)
    return Level(view.camera, brightness, depth, share)


def render_level(render: Render, camera: PinholeCamera, silhouette_threshold: float, aligner: Aligner[Any]) -> Level:
    """Returns a render at its full resolution, with depth where the silhouette is above the threshold.

    Where Gaussians of two frames meet, the silhouette dips and the black behind them shows. The brightness is that without it.
    """
    rgb, depth_acc, silhouette = map(_for_aligner, (render.rgb, render.depth_acc, render.silhouette))
    return Level(camera, *aligner.render_images(rgb, depth_acc, silhouette, silhouette_threshold, _LEAST_SILHOUETTE))


def half_pyramid(level: Level, aligner: Aligner[Any]) -> list[Level]:
    """Returns a level at a half, a quarter, ... of its resolution, finest first; the level itself if it is too small.

    The full resolution is left out: it would be three quarters of the work.
    """
    return list(_halved(level, aligner)) or [level]


def full_pyramid(level: Level, aligner: Aligner[Any]) -> list[Level]:
    """Returns a level, without depth at depth edges, and at a half, a quarter, ... of its resolution.

    A render blends the depths on both sides of an edge. ``half_pyramid`` removes them when it halves the first time.
    """
    finest = replace(level, depth=_without_edges(level, aligner))
    return [finest, *_halved(finest, aligner)]


def _without_edges(level: Level, aligner: Aligner[Any]) -> Array | Tensor:
    """Returns a level's depth without depth edges; the other layers, eight times as much memory, go."""
    depth = aligner.layers(level.brightness, level.depth, EDGE)[..., _DEPTH_LAYER]
    return depth.contiguous() if isinstance(depth, Tensor) else np.ascontiguousarray(depth)


def _halved(level: Level, aligner: Aligner[Any]) -> Iterator[Level]:
    while min(level.camera.width, level.camera.height) >= 2 * _COARSEST_PX:
        level = Level(_halved_camera(level.camera), *aligner.halve(level.brightness, level.depth, EDGE), level.depth_share)
        yield level


@lru_cache(maxsize=16)
def _halved_camera(camera: PinholeCamera) -> PinholeCamera:
    """Cached, because every frame has the cameras of the one before."""
    width, height = camera.width // 2, camera.height // 2
    return camera.cropped(2 * width, 2 * height).resized(width, height)


def _for_aligner(image: Tensor) -> Any:
    """Returns an image on the host as an array, which the native aligner takes; another one as it is."""
    return image.numpy() if is_on_host(image) else image
