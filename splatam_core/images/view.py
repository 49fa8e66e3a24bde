"""A frame as tensors, with the depth readings that are used."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatam_core.config import DepthConfig
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.images.filters import box_sums, closed, nearest, shrunk
from splatam_core.images.rectification import kept
from splatam_core.images.spacing import reading_spacing, shrunk_readings, spacing_of_grid
from splatam_core.types import RgbdFrame

NEAR_PX, HOLE_REACH = 1, 0.025
"""A pixel is near a reading within so many pixels of one, or in a hole of at most twice this fraction of the image's width."""

MIN_AROUND = 2.5  # readings, itself included, of which at least 3 are needed; box sums are inexact


@dataclass(frozen=True, eq=False)
class View:
    """One frame's images, stored compactly because there are many keyframes.

    Attributes:
        camera: the pinhole of both images.
        rgb8: [H, W, 3] uint8.
        depth: [H, W] metres, 0 = no reading; negative in keyframes where nothing is compared (``mapping.ghosts``).
        spacing: mean distance in pixels between neighbouring readings; more than 1 if they are a grid with holes.
    """

    camera: PinholeCamera
    rgb8: Tensor
    depth: Tensor
    spacing: float = 1.0

    @classmethod
    def from_frame(cls, frame: RgbdFrame, config: DepthConfig) -> View:
        """Returns the frame's images in the host's memory, with the depth readings that are used (see ``usable_depth``)."""
        depth_m = usable_depth(frame.depth_m, config)
        rgb = np.require(frame.rgb, requirements=['C', 'W'])  # torch takes no read-only memory
        if min(rgb.strides) < 0:  # a row or column of pixels counts as contiguous in any direction
            rgb = rgb.copy()
        return cls(frame.camera, torch.from_numpy(rgb), torch.from_numpy(depth_m), reading_spacing(depth_m))

    def to(self, device: torch.device) -> View:
        """Returns the view on a device; itself if it is there already."""
        if self.depth.device == device:
            return self
        rgb8, depth = self.rgb8.to(device, non_blocking=True), self.depth.to(device, non_blocking=True)
        return View(self.camera, rgb8, depth, self.spacing)

    def bare(self) -> View:
        """Returns the view without cached images."""
        return View(self.camera, self.rgb8, self.depth, self.spacing)

    @cached_property
    def rgb(self) -> Tensor:
        """[3, H, W] in [0, 1]."""
        return self.rgb8.permute(2, 0, 1).float().div_(255).contiguous()

    @cached_property
    def valid(self) -> Tensor:
        """[H, W] bool, True where there is a reading."""
        return self.depth > 0

    def near_readings(self) -> Tensor:
        """Returns [H, W] bool, False where no reading is near: at which distance is what colour shows there, nobody knows.

        Readings with fewer than two others around them do not count: half a percent of a stereo camera's readings are speckles,
        and few of them would fill the sky. Not cached: a keyframe is seven bytes a pixel.
        """
        valid = (self.depth > 0).float()
        around = box_sums(valid, 2 * math.ceil(self.spacing) + 3)
        reach = max(round(HOLE_REACH * self.camera.width), math.ceil(self.spacing))
        return closed((valid > 0) & (around > MIN_AROUND), reach, NEAR_PX)

    def scaled(self, scale: float) -> View:
        """Returns the view resized: colour by area, depth by the nearest pixel, or reading where depth is a grid with holes."""
        if scale == 1.0:
            return self
        size = max(1, round(self.camera.width * scale)), max(1, round(self.camera.height * scale))
        camera, rgb8 = self.camera.resized(*size), shrunk(self.rgb8, *size)
        if self.spacing == 1.0:
            return View(camera, rgb8, nearest(self.depth, *size))
        readings = shrunk_readings(np.maximum(self.depth.numpy(force=True), 0), *size)
        depth = torch.from_numpy(readings).to(self.depth.device)
        depth = torch.where(depth > 0, depth, nearest(self.depth, *size).clamp(max=0))
        return View(camera, rgb8, depth, spacing_of_grid(readings > 0))

    def through(self, camera: PinholeCamera) -> View:
        """Returns the view as another pinhole at the same place would show it; nothing is compared where this one does not look."""
        if camera == self.camera:
            return self
        own = self.scaled(min(1.0, camera.fx / self.camera.fx))
        to_own = own.camera.matrix @ np.linalg.inv(camera.matrix)
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        x, y = (to_own[axis, axis] * pixels + to_own[axis, 2] for axis, pixels in enumerate((u, v)))
        maps, device = (x.astype(np.float32), y.astype(np.float32)), self.depth.device
        rgb8 = cv2.remap(own.rgb8.numpy(force=True), *maps, cv2.INTER_LINEAR)
        depth = cv2.remap(own.depth.numpy(force=True), *maps, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=-1.0)
        return View(camera, torch.from_numpy(rgb8).to(device), torch.from_numpy(depth).to(device), own.spacing)

    def narrowed(self, scale: float, max_width: int) -> View:
        """Returns the view resized by ``narrowing``."""
        return self.scaled(narrowing(self.camera.width, scale, max_width))


def narrowing(width: int, scale: float, max_width: int) -> float:
    """Returns the scale, or a smaller one that limits ``width`` to ``max_width`` pixels; 0 = no limit."""
    return min(scale, max_width / width) if max_width else scale


def unproject(camera: PinholeCamera, u: Tensor, v: Tensor, z: Tensor) -> Tensor:
    """Returns [K, 3] camera coordinates of pixels (u, v) at depth z."""
    return torch.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], dim=1)


def usable_depth(depth_m: NDArray[np.float32], config: DepthConfig) -> NDArray[np.float32]:
    """Returns [H, W] the readings that are in the configured range and not at depth edges; 0 elsewhere."""
    usable = depth_m >= config.min_m
    usable &= depth_m <= config.max_m
    if config.edge_filter > 0:
        usable &= ~_is_flying(depth_m, config.edge_filter)
    return kept(depth_m, usable)


def _is_flying(depth_m: NDArray[np.float32], ratio: float) -> NDArray[np.bool_]:
    """Returns [H, W] readings between two surfaces: a neighbour with a reading is much nearer or farther."""
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    farthest = cv2.dilate(depth_m, cross)
    nearest = cv2.erode(np.where(depth_m > 0, depth_m, np.float32(np.inf)), cross)
    return (farthest - depth_m > ratio * depth_m) | (depth_m - nearest > ratio * depth_m)
