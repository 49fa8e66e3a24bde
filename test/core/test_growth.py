"""Adaptive density control: the screen-space gradient against finite differences, clones and splits by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from splatam_core.device import HOST
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.mapping.adaptive_density import GRADIENT_THRESHOLD, SHRINK, ScreenSpaceGradient, clone_and_split
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.rasterizer import Gaussians, Rates, make_rasterizer

CAMERA = PinholeCamera(32, 24, 30.0, 28.0, 15.5, 11.5)
RATES = Rates(1e-4, 1e-3, 0.05, 2.5e-3, 1e-3)
T_CAM_WORLD = torch.from_numpy(se3.exp(np.array([0.1, -0.2, 0.3, 0.2, -0.1, 0.15]))).float()


def _gaussians(count: int, anisotropic: bool = False) -> Gaussians:
    """In front of the camera, wide enough for smooth images."""
    generator = torch.Generator().manual_seed(3)
    in_camera = torch.rand(count, 3, generator=generator) * torch.tensor([1.0, 0.8, 1.0]) + torch.tensor([-0.5, -0.4, 1.5])
    R, t = T_CAM_WORLD[:3, :3], T_CAM_WORLD[:3, 3]
    log_scales = torch.full((count, 3 if anisotropic else 1), math.log(0.12))
    rotations = torch.randn(count, 4, generator=generator) if anisotropic else None
    rgb = torch.rand(count, 3, generator=generator)
    return Gaussians((in_camera - t) @ R, log_scales, torch.zeros(count), rgb, None, rotations)


def test_screen_space_gradient_is_the_derivative_by_the_position_in_the_image() -> None:
    """Central differences, to a per cent of the largest: so much float32 renders resolve.

    The Gaussians are so wide that none is cut off within the image, which would let the loss jump.
    """
    g, rasterizer = _gaussians(5), make_rasterizer('reference', 1)
    g.log_scales[:] = 0.0

    def loss(means: torch.Tensor) -> torch.Tensor:
        moved = Gaussians(means, g.log_scales, g.logit_opacities, g.rgb)
        return rasterizer.render(moved, CAMERA, T_CAM_WORLD).rgb.square().sum()

    means = g.means.clone().requires_grad_()
    loss(means).backward()
    gradient = ScreenSpaceGradient(5, HOST)
    gradient.observe(means.grad, g.means, CAMERA, T_CAM_WORLD)
    expected = torch.zeros(5, 2)
    z = (g.means @ T_CAM_WORLD[:3, :3].T + T_CAM_WORLD[:3, 3])[:, 2]
    for index in range(5):
        for axis, (focal, size) in enumerate(((CAMERA.fx, CAMERA.width), (CAMERA.fy, CAMERA.height))):
            step = 0.01  # pixels
            offset = T_CAM_WORLD[axis, :3] * step * z[index] / focal
            plus, minus = g.means.clone(), g.means.clone()
            plus[index] += offset
            minus[index] -= offset
            expected[index, axis] = (loss(plus) - loss(minus)) / (2 * step) * size / 2
    torch.testing.assert_close(gradient.mean(), expected.norm(dim=1), atol=0.01 * float(expected.max()), rtol=0.02)


def test_screen_space_gradient_is_the_mean_over_the_views_that_drew_a_gaussian() -> None:
    gradient, means = ScreenSpaceGradient(3, HOST), torch.tensor([[0.0, 0.0, 1.0]]).repeat(3, 1)
    gradients = torch.tensor([[3.0, 0, 0], [1.0, 0, 0], [0.0, 0, 0]])
    gradient.observe(gradients, means, CAMERA, torch.eye(4))
    gradient.observe(gradients * torch.tensor([[1.0], [0.0], [0.0]]), means, CAMERA, torch.eye(4))
    unit = CAMERA.width / 2 / CAMERA.fx
    assert gradient.mean().tolist() == pytest.approx([3 * unit, unit, 0.0])
    gradient.keep(torch.tensor([False, True, True]))
    assert gradient.mean().tolist() == pytest.approx([unit, 0.0])


@pytest.mark.parametrize('anisotropic', [False, True])
def test_small_ones_are_cloned_and_large_ones_split(anisotropic: bool) -> None:
    g = _gaussians(60, anisotropic)
    g.log_scales[:20] = math.log(0.009)
    gaussian_map = GaussianMap(anisotropic)
    gaussian_map.append(g)
    gaussian_map.start_optimization(RATES)
    gaussian_map.means.grad = torch.ones_like(gaussian_map.means)
    gaussian_map.step()
    gradient = torch.zeros(60)
    gradient[10:50] = 2 * GRADIENT_THRESHOLD  # ten small ones, thirty large ones
    before = gaussian_map.gaussians.detached()
    before = Gaussians(before.means.clone(), before.log_scales.clone(), before.logit_opacities, before.rgb)
    clone_and_split(gaussian_map, gradient, scene_radius=1.0, rng=np.random.default_rng(0))
    now = gaussian_map.gaussians.detached()
    assert len(now) == 60 + 10 + 30
    staying = [*range(20), *range(50, 60)]
    assert torch.equal(now.means[:30], before.means[staying]) and torch.equal(now.means[30:40], before.means[10:20])
    children, parents = now.means[40:].view(2, 30, 3), before.means[20:50]
    torch.testing.assert_close(now.log_scales[40:], before.log_scales[20:50].repeat(2, 1) - math.log(SHRINK))
    spread = (children - parents).square().mean().sqrt()
    assert 0.8 < float(spread) / 0.12 < 1.2  # 180 normal numbers: their spread is known to 5 %
    placed = now.means.clone()
    # Adam goes on for those that stay and starts anew for the others: without a gradient only the former move.
    gaussian_map.means.grad = torch.zeros_like(gaussian_map.means)
    gaussian_map.step()
    moved = (gaussian_map.means.detach() - placed).abs().amax(dim=1) > 0
    assert moved.tolist() == [True] * 30 + [False] * 70


def test_a_split_goes_along_the_long_axis() -> None:
    g = _gaussians(40, anisotropic=True)
    g.log_scales[:] = torch.log(torch.tensor([0.5, 0.01, 0.01]))
    gaussian_map = GaussianMap(anisotropic=True)
    gaussian_map.append(g)
    gaussian_map.start_optimization(RATES)
    axes = torch.from_numpy(se3.rotation_from_quaternion(g.rotations.double().numpy())).float()[:, :, 0]
    parents = g.means.clone()
    clone_and_split(gaussian_map, torch.full((40,), 1.0), scene_radius=1.0, rng=np.random.default_rng(1))
    offsets = gaussian_map.means.detach().view(2, 40, 3) - parents
    along = (offsets * axes).sum(dim=2)
    across = (offsets - along[..., None] * axes).norm(dim=2)
    assert float(along.abs().median()) > 0.2 and float(across.max()) < 0.06
