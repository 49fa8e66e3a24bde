"""Depth of a stereo camera outdoors: houses 20 to 30 metres away, thin posts near the camera, noise and speckles.

The error of the disparity is correlated over many pixels, as block matching makes it, and that of the depth grows with its square:
1.6 metres at 25. One reading in 200 is a speckle, at any depth; matching widens near things by two pixels; the sky has none.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from splatam_core.geometry.camera import PinholeCamera
from splatam_core.geometry.trajectory import Trajectory
from splatam_core.types import RgbdFrame

CAMERA = PinholeCamera(320, 240, 280.0, 280.0, 159.5, 119.5)
BASELINE_M = 0.25
DISPARITY_ERROR_PX = 0.18
CORRELATED_OVER_PX = 6
SPECKLES = 0.005
SKY_M = 60.0
TEXTURE_PX = 1024


def sigma_m(depth_m: np.ndarray) -> np.ndarray:
    """Returns the standard deviation of a reading."""
    return DISPARITY_ERROR_PX / (CAMERA.fx * BASELINE_M) * depth_m**2


@dataclass(frozen=True)
class Panel:
    """A painted rectangle: one corner, two edges in metres, and its paint.

    grain: texels per metre.
    """

    corner: tuple[float, float, float]
    right: tuple[float, float, float]
    down: tuple[float, float, float]
    colour: tuple[int, int, int]
    grain: float


def _box(x: float, y: float, z: float, width: float, height: float, colour: tuple[int, int, int]) -> list[Panel]:
    return [
        Panel((x, y, z), (width, 0, 0), (0, height, 0), colour, 40),
        Panel((x, y, z), (0, 0, 6), (0, height, 0), colour, 40),
        Panel((x + width, y, z), (0, 0, 6), (0, height, 0), colour, 40),
    ]


PANELS = [
    Panel((-60, 1.6, 0), (120, 0, 0), (0, 0, 45), (120, 120, 110), 60),  # ground
    Panel((-40, -5, 30), (80, 0, 0), (0, 6.6, 0), (170, 130, 100), 30),  # houses
    *_box(-14, -4, 22, 9, 5.6, (150, 90, 80)),
    *_box(6, -3, 20, 7, 4.6, (110, 130, 160)),
    *_box(-3, -1, 25, 5, 2.6, (160, 160, 90)),
    Panel((-0.75, -3, 1.6), (0.04, 0, 0), (0, 4.6, 0), (60, 70, 60), 300),  # posts
    Panel((0.35, -3, 0.8), (0.02, 0, 0), (0, 4.6, 0), (90, 60, 50), 300),
    Panel((1.6, -3, 2.6), (0.06, 0, 0), (0, 4.6, 0), (70, 70, 80), 300),
]


def _texture() -> np.ndarray:
    rng = np.random.default_rng(3)
    noise = sum(
        cv2.resize(rng.standard_normal((side, side)).astype(np.float32), (TEXTURE_PX, TEXTURE_PX), interpolation=cv2.INTER_CUBIC)
        for side in (16, 64, 256, 1024)
    )
    return noise / noise.std()


TEXTURE = _texture()


class FarStereo:
    """A slow walk sideways and forwards."""

    def __init__(self, frames: int, seed: int = 0) -> None:
        self.camera = CAMERA
        self._frames, self._seed = frames, seed

    def __len__(self) -> int:
        return self._frames

    def pose(self, index: int) -> np.ndarray:
        T = np.eye(4)
        yaw = 0.06 * np.sin(index / 15)
        T[:3, :3] = [[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]]
        T[:3, 3] = 0.015 * index, 0.02 * np.sin(index / 5), 0.01 * index
        return T

    def ground_truth(self) -> Trajectory:
        indices = range(len(self))
        return Trajectory(np.array([self._stamp_ns(i) for i in indices]), np.stack([self.pose(i) for i in indices]))

    @staticmethod
    def true_view(T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Colour [H, W, 3] uint8 and depth [H, W], ``SKY_M`` in the sky, from a pose [4, 4]."""
        v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
        rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1) @ T[:3, :3].T
        depth = np.full(u.shape, SKY_M)
        rgb = np.broadcast_to(np.array([150, 180, 220.0]), (*u.shape, 3)).copy()
        for panel in PANELS:
            along_x, along_y = np.array(panel.right), np.array(panel.down)
            width, height = np.linalg.norm(along_x), np.linalg.norm(along_y)
            normal, offset = np.cross(along_x, along_y), np.array(panel.corner) - T[:3, 3]
            with np.errstate(divide='ignore', invalid='ignore'):
                z = offset @ normal / (rays @ normal)
                x, y = ((z[..., None] * rays - offset) @ (axis / size) for axis, size in ((along_x, width), (along_y, height)))
                hit = (z > 0.05) & (z < depth) & (x >= 0) & (x <= width) & (y >= 0) & (y <= height)
            depth[hit] = z[hit]
            texel = [(panel.grain * place[hit]).astype(int) % TEXTURE_PX for place in (y, x)]
            rgb[hit] = np.array(panel.colour) + 28 * TEXTURE[tuple(texel)][:, None]
        return rgb.clip(0, 255).astype(np.uint8), depth.astype(np.float32)

    def __getitem__(self, index: int) -> RgbdFrame:
        rgb, depth_m = self.true_view(self.pose(index))
        return RgbdFrame(self._stamp_ns(index), rgb, self._measured(depth_m, index), CAMERA)

    def _measured(self, depth_m: np.ndarray, index: int) -> np.ndarray:
        rng = np.random.default_rng([self._seed, index])
        matched = cv2.erode(depth_m, np.ones((1, 5)))  # near things grow
        error = cv2.GaussianBlur(rng.standard_normal(depth_m.shape).astype(np.float32), (0, 0), CORRELATED_OVER_PX)
        disparity = CAMERA.fx * BASELINE_M / matched + DISPARITY_ERROR_PX * error / error.std()
        measured = CAMERA.fx * BASELINE_M / np.maximum(disparity, 0.5)
        speckle = rng.random(depth_m.shape) < SPECKLES
        measured[speckle] = rng.uniform(0.5, 40, np.count_nonzero(speckle))
        measured[(matched >= SKY_M) & ~speckle] = 0
        return measured.astype(np.float32)

    @staticmethod
    def _stamp_ns(index: int) -> int:
        return 10**9 + index * 33_333_333
