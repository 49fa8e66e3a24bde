"""Adaptive density control: clones small Gaussians and splits large ones where the screen-space gradient is high.

Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", SIGGRAPH 2023, section 5.2, with the
constants of SplaTAM's offline scripts. The gradient is that of the whole loss, depth included; theirs is of colour alone.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.rasterizer import Gaussians, joined

GRADIENT_THRESHOLD = 2e-4  # of the loss, by half the image's width or height
SMALL = 0.01  # as a fraction of the scene radius
CHILDREN = 2
SHRINK = 0.8 * CHILDREN


class ScreenSpaceGradient:
    """Magnitude of the loss's gradient by each Gaussian's position in the image, as a mean over the views that drew it."""

    def __init__(self, size: int, device: torch.device) -> None:
        self._sum, self._views = torch.zeros(size, device=device), torch.zeros(size, device=device)

    def observe(self, gradients: Tensor, means: Tensor, camera: PinholeCamera, T_cam_world: Tensor) -> None:
        """Adds a view.

        Args:
            gradients: [N, 3] gradients of the loss by the means.
            means: [N, 3] metres, world.
            camera: of the view.
            T_cam_world: [4, 4].
        """
        z = means @ T_cam_world[2, :3] + T_cam_world[2, 3]
        gradients = gradients @ T_cam_world[:3, :3].T  # by x, y, z in the camera; u = fx x / z + cx, z constant
        u, v = gradients[:, 0] * z / camera.fx, gradients[:, 1] * z / camera.fy
        magnitude = torch.hypot(u * camera.width / 2, v * camera.height / 2)
        self._sum += magnitude
        self._views += magnitude > 0

    def keep(self, kept: Tensor) -> None:
        """Drops what ``GaussianMap.keep`` drops."""
        self._sum, self._views = self._sum[kept], self._views[kept]

    def mean(self) -> Tensor:
        """Returns [N]; 0 where no view drew a Gaussian."""
        return self._sum / self._views.clamp(min=1)


def clone_and_split(gaussian_map: GaussianMap, gradient: Tensor, scene_radius: float, rng: np.random.Generator) -> None:
    """Clones small Gaussians and splits large ones where the gradient is high, during an optimization.

    Args:
        gaussian_map: changed in place.
        gradient: [N] see ``ScreenSpaceGradient.mean``.
        scene_radius: metres.
        rng: draws the positions of the parts of a split Gaussian from its own density.
    """
    g = gaussian_map.gaussians.detached()
    chosen = gradient >= GRADIENT_THRESHOLD
    is_small = g.log_scales.amax(dim=1) <= math.log(SMALL * scene_radius)
    large = g.chosen(chosen & ~is_small)
    children = [_scattered(large, rng) for _ in range(CHILDREN)]
    new = joined(g.chosen(chosen & is_small), joined(*children))
    gaussian_map.keep(~(chosen & ~is_small))
    gaussian_map.extend(new)


def _scattered(g: Gaussians, rng: np.random.Generator) -> Gaussians:
    """Returns one smaller Gaussian in place of each."""
    device = g.means.device
    offsets = torch.from_numpy(rng.standard_normal((len(g), 3)).astype(np.float32)).to(device) * g.log_scales.exp()
    if g.rotations is not None:
        R = torch.from_numpy(se3.rotation_from_quaternion(g.rotations.double().numpy(force=True))).float().to(device)
        offsets = (R @ offsets[:, :, None])[:, :, 0]
    return replace(g, means=g.means + offsets, log_scales=g.log_scales - math.log(SHRINK), bounds=None)
