"""More Gaussians where the loss pulls at their places in the image: clones of small ones, splits of large ones.

Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", SIGGRAPH 2023, section 5.2, with the
constants of SplaTAM's offline scripts. Here the pull is that of the whole loss, depth included; theirs is of colour alone.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.rasterizer import Gaussians, joined

PULL = 2e-4  # of the loss by half the image's width or height
SMALL = 0.01  # of the scene's radius
CHILDREN = 2
SHRINK = 0.8 * CHILDREN


class ScreenPull:
    """How hard the loss pulls at each Gaussian's place in the image: the mean over the views that drew it."""

    def __init__(self, size: int, device: torch.device) -> None:
        self._sum, self._views = torch.zeros(size, device=device), torch.zeros(size, device=device)

    def observe(self, slopes: Tensor, means: Tensor, camera: PinholeCamera, T_cam_world: Tensor) -> None:
        """Add a view.

        Args:
            slopes: [N, 3] gradient of the loss by the means.
            means: [N, 3] metres, world.
            camera: of the view.
            T_cam_world: [4, 4].
        """
        z = means @ T_cam_world[2, :3] + T_cam_world[2, 3]
        slopes = slopes @ T_cam_world[:3, :3].T  # by x, y, z in the camera; u = fx x / z + cx at constant z
        u, v = slopes[:, 0] * z / camera.fx, slopes[:, 1] * z / camera.fy
        pull = torch.hypot(u * camera.width / 2, v * camera.height / 2)
        self._sum += pull
        self._views += pull > 0

    def keep(self, kept: Tensor) -> None:
        """Follow ``GaussianMap.keep``."""
        self._sum, self._views = self._sum[kept], self._views[kept]

    def mean(self) -> Tensor:
        """[N] 0 where no view drew a Gaussian."""
        return self._sum / self._views.clamp(min=1)


def grow(gaussian_map: GaussianMap, pull: Tensor, scene_radius: float, rng: np.random.Generator) -> None:
    """Clone what is pulled at and small, split what is pulled at and large; the optimisation goes on.

    Args:
        gaussian_map: changed in place.
        pull: [N] see ``ScreenPull.mean``.
        scene_radius: metres.
        rng: scatters the parts of a split one, as its own density does.
    """
    g = gaussian_map.gaussians.detached()
    chosen = pull >= PULL
    is_small = g.log_scales.amax(dim=1) <= math.log(SMALL * scene_radius)
    large = _chosen(g, chosen & ~is_small)
    children = [_scattered(large, rng) for _ in range(CHILDREN)]
    new = joined(_chosen(g, chosen & is_small), joined(*children))
    gaussian_map.keep(~(chosen & ~is_small))
    gaussian_map.extend(new)


def _chosen(g: Gaussians, chosen: Tensor) -> Gaussians:
    rotations = None if g.rotations is None else g.rotations[chosen]
    return Gaussians(g.means[chosen], g.log_scales[chosen], g.logit_opacities[chosen], g.rgb[chosen], None, rotations)


def _scattered(g: Gaussians, rng: np.random.Generator) -> Gaussians:
    """One smaller Gaussian in place of each."""
    device = g.means.device
    offsets = torch.from_numpy(rng.standard_normal((len(g), 3)).astype(np.float32)).to(device) * g.log_scales.exp()
    if g.rotations is not None:
        R = torch.from_numpy(se3.rotation_from_quaternion(g.rotations.double().numpy(force=True))).float().to(device)
        offsets = (R @ offsets[:, :, None])[:, :, 0]
    return Gaussians(g.means + offsets, g.log_scales - math.log(SHRINK), g.logit_opacities, g.rgb, None, g.rotations)
