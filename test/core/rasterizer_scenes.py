"""Random scenes and comparisons for the rasterizer's contract."""

from __future__ import annotations

import math
from dataclasses import dataclass
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor

from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.rasterizer import Gaussians, Rasterizer, Render, base, reference
from splatam_core.rasterizer.reference import ReferenceRasterizer

PARAMETERS = ('means', 'log_scales', 'logit_opacities', 'rgb')


@dataclass(frozen=True)
class Scene:
    """Gaussians (float64), a camera and a pose."""

    gaussians: Gaussians
    camera: PinholeCamera
    T_cam_world: Tensor


def camera(width: int, height: int) -> PinholeCamera:
    """A camera of about 65 degrees with unequal focal lengths and an off-centre principal point."""
    return PinholeCamera(width, height, 0.8 * width, 0.83 * width, 0.47 * width, 0.52 * height)


def pose(seed: int) -> Tensor:
    """A small random motion away from the identity."""
    twist = np.random.default_rng(seed).normal(size=6) * 0.05
    return torch.from_numpy(se3.exp(twist))


def random_scene(seed: int, count: int, width: int, height: int, sigma_px: float = 2.0, logit: float = 0.0) -> Scene:
    """Gaussians all over the image and somewhat beyond, in no order, of about a given size and opacity."""
    generator = torch.Generator().manual_seed(seed)
    cam = camera(width, height)
    z = 0.5 + 4 * torch.rand(count, generator=generator, dtype=torch.float64)
    u = (1.3 * torch.rand(count, generator=generator, dtype=torch.float64) - 0.15) * width
    v = (1.3 * torch.rand(count, generator=generator, dtype=torch.float64) - 0.15) * height
    means = torch.stack([(u - cam.cx) / cam.fx * z, (v - cam.cy) / cam.fy * z, z], 1)
    spread = torch.randn(count, 2, generator=generator, dtype=torch.float64)
    scales = torch.log(sigma_px * z / cam.fx) + 0.5 * spread[:, 0]
    rgb = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    return Scene(Gaussians(means, scales[:, None], logit + 1.5 * spread[:, 1], rgb), cam, pose(seed))


def anisotropic_scene(seed: int, count: int, width: int, height: int, **options: float) -> Scene:
    """The same places as ``random_scene``; radii that differ threefold and more, turned anyhow."""
    scene = random_scene(seed, count, width, height, **options)
    generator = torch.Generator().manual_seed(seed + 1000)
    g = scene.gaussians
    scales = g.log_scales + 0.7 * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    quaternions = torch.randn(count, 4, generator=generator, dtype=torch.float64)
    turned = Gaussians(g.means, scales, g.logit_opacities, g.rgb, rotations=quaternions)
    return Scene(turned, scene.camera, scene.T_cam_world)


def parameters(gaussians: Gaussians) -> tuple[str, ...]:
    """The names of the tensors."""
    return PARAMETERS if gaussians.rotations is None else (*PARAMETERS, 'rotations')


def one(mean: tuple[float, float, float], sigma_m: float, opacity: float, cam: PinholeCamera) -> Scene:
    """A single white Gaussian seen from the origin."""
    gaussians = Gaussians(
        torch.tensor([mean], dtype=torch.float64),
        torch.tensor([[math.log(sigma_m)]], dtype=torch.float64),
        torch.tensor([math.log(opacity / (1 - opacity))], dtype=torch.float64),
        torch.ones(1, 3, dtype=torch.float64),
    )
    return Scene(gaussians, cam, torch.eye(4, dtype=torch.float64))


def images(render: Render) -> Tensor:
    """[5, H, W]: colour, depth_acc, silhouette."""
    return torch.cat([render.rgb, render.depth_acc[None], render.silhouette[None]])


def device_of(backend: str) -> str:
    """Where a backend's tensors have to be: ``triton`` runs on a GPU where there is one, else in its interpreter."""
    return 'cuda' if backend == 'triton' and torch.cuda.is_available() else 'cpu'


def on_device(gaussians: Gaussians, device: str) -> Gaussians:
    """Float32 copies there, without gradients."""
    copies = (getattr(gaussians, name).to(device, torch.float32, copy=True) for name in parameters(gaussians))
    return Gaussians(**dict(zip(parameters(gaussians), copies)))


def clear_pixels(scene: Scene) -> Tensor:
    """[H, W] pixels where no alpha and no transmittance is so near a threshold that rounding could cross it.

    float32 knows a narrow Gaussian's alpha to about 4e-5: a centre at pixel 60 is off by 6e-6 px, times d/s^2.
    """
    rasterizer = ReferenceRasterizer()
    drawn = []
    for nudge in (1 - 2e-4, 1 + 2e-4):
        with patch.multiple(reference, MIN_ALPHA=base.MIN_ALPHA * nudge, MIN_TRANSMITTANCE=1e-4 * nudge):
            drawn.append(images(rasterizer.render(scene.gaussians, scene.camera, scene.T_cam_world)))
    return (drawn[0] == drawn[1]).all(dim=0)


def render_with_gradients(
    rasterizer: Rasterizer, scene: Scene, dtype: torch.dtype, weights: Tensor, device: str = 'cpu'
) -> tuple[Tensor, dict[str, Tensor]]:
    """The images, and the gradient of their weighted sum by every input (``T_cam_world``: upper three rows); on the CPU."""
    names = parameters(scene.gaussians)
    leaves = {name: getattr(scene.gaussians, name).to(device, dtype, copy=True).requires_grad_() for name in names}
    T = scene.T_cam_world.to(device, dtype, copy=True).requires_grad_()
    image = images(rasterizer.render(Gaussians(**leaves), scene.camera, T))
    (image * weights.to(device, dtype)).sum().backward()
    zero = {name: torch.zeros_like(leaf) for name, leaf in leaves.items()}
    gradients = {name: zero[name] if leaf.grad is None else leaf.grad for name, leaf in leaves.items()}
    gradients['T_cam_world'] = torch.zeros(3, 4, dtype=dtype) if T.grad is None else T.grad[:3]
    return image.detach().cpu(), {name: gradient.cpu() for name, gradient in gradients.items()}
