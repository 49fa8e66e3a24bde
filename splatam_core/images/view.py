"""A frame as the stages see it: tensors, with the readings that count."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatam_core.config import DepthConfig
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.images.filters import nearest, shrunk
from splatam_core.images.rectification import kept
from splatam_core.types import RgbdFrame


@dataclass(frozen=True, eq=False)
class View:
    """One frame's images, stored compactly: keyframes are many.

    Attributes:
        camera: the pinhole of both.
        rgb8: [H, W, 3] uint8.
        depth: [H, W] metres, 0 = no reading.
    """

    camera: PinholeCamera
    rgb8: Tensor
    depth: Tensor

    @classmethod
    def from_frame(cls, frame: RgbdFrame, config: DepthConfig) -> View:
        """The frame's images in the host's memory, with only the depth readings that count."""
        depth_m = usable_depth(frame.depth_m, config)
        return cls(frame.camera, torch.from_numpy(np.ascontiguousarray(frame.rgb)), torch.from_numpy(depth_m))

    def to(self, device: torch.device) -> View:
        """The same on a device; itself where it is there already."""
        if self.depth.device == device:
            return self
        return View(self.camera, self.rgb8.to(device, non_blocking=True), self.depth.to(device, non_blocking=True))

    @cached_property
    def rgb(self) -> Tensor:
        """[3, H, W] in [0, 1]."""
        return self.rgb8.permute(2, 0, 1).float().div_(255).contiguous()

    @cached_property
    def valid(self) -> Tensor:
        """[H, W] bool, where there is a reading."""
        return self.depth > 0

    def scaled(self, scale: float) -> View:
        """The same view at another resolution: colour by area, depth by nearest."""
        if scale == 1.0:
            return self
        size = max(1, round(self.camera.width * scale)), max(1, round(self.camera.height * scale))
        return View(self.camera.resized(*size), shrunk(self.rgb8, *size), nearest(self.depth, *size))

    def narrowed(self, scale: float, max_width: int) -> View:
        """The same view at a scale, or at the one that makes it ``max_width`` pixels wide, if that is less; 0 = any width."""
        return self.scaled(narrowing(self.camera.width, scale, max_width))


def narrowing(width: int, scale: float, max_width: int) -> float:
    """A scale, or the one that makes ``width`` pixels ``max_width``, if that is less; 0 = any width."""
    return min(scale, max_width / width) if max_width else scale


def unproject(camera: PinholeCamera, u: Tensor, v: Tensor, z: Tensor) -> Tensor:
    """[K, 3] camera coordinates of pixels (u, v) at depth z."""
    return torch.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], dim=1)


def usable_depth(depth_m: NDArray[np.float32], config: DepthConfig) -> NDArray[np.float32]:
    """[H, W] the readings inside the configured range and off depth edges; 0 elsewhere."""
    usable = (depth_m >= config.min_m) & (depth_m <= config.max_m)
    if config.edge_filter > 0:
        usable &= ~_is_flying(depth_m, config.edge_filter)
    return kept(depth_m, usable)


def _is_flying(depth_m: NDArray[np.float32], ratio: float) -> NDArray[np.bool_]:
    """Readings that hang between two surfaces: some neighbour with a reading is far nearer or farther."""
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    farthest = cv2.dilate(depth_m, cross)
    nearest = cv2.erode(np.where(depth_m > 0, depth_m, np.float32(np.inf)), cross)
    return (farthest - depth_m > ratio * depth_m) | (depth_m - nearest > ratio * depth_m)
