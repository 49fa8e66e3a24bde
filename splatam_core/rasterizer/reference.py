"""The contract in plain torch: slow, differentiated by autograd, in any precision. Every other backend is tested against it."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from splatam_core.errors import RasterizerError
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.rasterizer.base import (
    BETA_1,
    BLUR_PX2,
    COLOR_LIMIT,
    DEPTH_LIMIT_M,
    EPSILON,
    FIT_BETA_2,
    FIT_TILE,
    HUGE,
    MAX_ALPHA,
    MIN_ALPHA,
    MIN_TRANSMITTANCE,
    NEAR_M,
    Gaussians,
    Moments,
    Rates,
    Render,
    Target,
    check_isotropic,
)
from splatam_core.rasterizer.ewa import Ellipses
from splatam_core.rasterizer.ewa import project as project_anisotropic

_MAX_CELLS = 20_000_000  # Gaussian-pixel pairs held at once
_MAX_ROW_CELLS = 400_000_000  # of one row, which is not divided: about 10 GB
MAX_LOG_SCALE = 40.0


class ReferenceRasterizer:
    """Evaluates every Gaussian at every pixel."""

    def render(self, gaussians: Gaussians, camera: PinholeCamera, T_cam_world: Tensor) -> Render:
        """See ``Rasterizer.render``."""
        project = _project_isotropic if gaussians.rotations is None else project_anisotropic
        ellipses = project(gaussians, camera, T_cam_world)
        z = ellipses.features[:, 3:]
        features = torch.cat([ellipses.features, torch.ones_like(z)], dim=1)  # [K, 5]
        columns = torch.arange(camera.width, dtype=z.dtype, device=z.device)
        if len(z) * camera.width > _MAX_ROW_CELLS:
            raise RasterizerError(
                f'{len(z)} Gaussians at {camera.width} pixels of width are too many for rasterizer=reference; use rasterizer=cpu'
            )
        rows_at_once = max(1, _MAX_CELLS // max(1, len(z) * camera.width))
        bands = [
            _blend(ellipses, features, columns, rows.to(z.dtype))
            for rows in torch.arange(camera.height, device=z.device).split(rows_at_once)
        ]
        image = torch.cat(bands, dim=1)  # [5, H, W]
        return Render(image[:3], image[3], image[4])

    def fit(self, gaussians: Gaussians, moments: Moments, rates: Rates, target: Target) -> float:
        """See ``Rasterizer.fit``."""
        check_isotropic(gaussians)
        values = [gaussians.means, gaussians.log_scales, gaussians.logit_opacities[:, None], gaussians.rgb]
        packed = torch.cat(values, dim=1).detach().requires_grad_()  # [N, 8]
        means, log_scales, logits, rgb = packed.split([3, 1, 1, 3], dim=1)
        losses = _losses(self.render(Gaussians(means, log_scales, logits[:, 0], rgb), target.camera, target.T_cam_world), target)
        loss = losses.mean().item()
        (gradient,) = torch.autograd.grad((losses * ~_are_fitted_well(losses.detach(), target.enough)).mean(), packed)
        seen = (gradient != 0).any(dim=1) & (gradient.abs() < math.sqrt(HUGE)).all(dim=1)
        gradient = gradient[seen]
        moments.steps[seen] += (moments.steps[seen] < 255).to(torch.uint8)
        step = moments.steps[seen, None].to(gradient.dtype)
        first, second = moments.first_second[seen].to(gradient.dtype).split(8, dim=1)
        first, second = BETA_1 * first + (1 - BETA_1) * gradient, FIT_BETA_2 * second + (1 - FIT_BETA_2) * gradient**2
        moments.first_second[seen] = torch.cat([first, second], dim=1).to(moments.first_second.dtype)
        rate = torch.tensor([rates.means] * 3 + [rates.log_scales, rates.logit_opacities] + [rates.rgb] * 3).to(step.device)
        ahead = (BETA_1 * first + (1 - BETA_1) * gradient) / (1 - BETA_1 ** (step + 1))  # Nesterov's momentum
        move = rate * ahead / ((second / (1 - FIT_BETA_2**step)).sqrt() + EPSILON)
        for value, moved in zip(values, move.split([3, 1, 1, 3], dim=1), strict=True):
            value[seen] -= moved.to(value.dtype)
        return loss


def _losses(render: Render, target: Target) -> Tensor:
    """Returns [H, W] the loss of each pixel, whose mean is that of the view."""
    color = (_huber(render.rgb - target.rgb8.permute(2, 0, 1) / 255, COLOR_LIMIT) * (target.depth >= 0)).mean(dim=0)
    read = target.depth > 0
    depth = _huber(render.depth_acc - target.depth, DEPTH_LIMIT_M) * read * (read.numel() / read.sum().clamp(min=1))
    return target.color_weight * color + target.depth_weight * depth


def _are_fitted_well(losses: Tensor, enough: float) -> Tensor:
    """Returns [H, W] which pixels are in a square of ``FIT_TILE`` pixels a side whose mean loss is less than enough."""
    tiles = functional.avg_pool2d(losses[None, None], FIT_TILE, ceil_mode=True, count_include_pad=False) < enough
    return tiles[0, 0].repeat_interleave(FIT_TILE, 0).repeat_interleave(FIT_TILE, 1)[: losses.shape[0], : losses.shape[1]]


def _huber(residual: Tensor, limit: float) -> Tensor:
    size = residual.abs()
    return torch.where(size <= limit, residual**2 / (2 * limit), size - limit / 2)


def _project_isotropic(gaussians: Gaussians, camera: PinholeCamera, T_cam_world: Tensor) -> Ellipses:
    """Projects isotropic Gaussians to circles, front to back."""
    gaussians = gaussians.only_usable()
    points = gaussians.means @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]  # [N, 3]
    visible = (points[:, 2].detach() > NEAR_M) & (points.detach().abs() <= HUGE).all(dim=1)
    drawn = torch.nonzero(visible)[:, 0]
    drawn = drawn[torch.sort(points[drawn, 2].detach(), stable=True).indices]  # [K]
    x, y, z = points[drawn].unbind(-1)
    centers = torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], dim=1)
    focal = (camera.fx + camera.fy) / 2
    variance = (focal * gaussians.log_scales[drawn, 0].clamp(max=MAX_LOG_SCALE).exp() / z) ** 2 + BLUR_PX2
    conics = torch.stack([1 / variance, torch.zeros_like(z), 1 / variance], dim=1)
    features = torch.cat([gaussians.rgb[drawn], z[:, None]], dim=1)
    return Ellipses(centers, conics, torch.sigmoid(gaussians.logit_opacities[drawn]), features)


def _blend(ellipses: Ellipses, features: Tensor, columns: Tensor, rows: Tensor) -> Tensor:
    """Returns [5, R, W]: the features [K, 5] of sorted ellipses, blended over a band of R rows."""
    dx = columns - ellipses.centers[:, 0, None, None]  # [K, 1, W]
    dy = rows[:, None] - ellipses.centers[:, 1, None, None]  # [K, R, 1]
    xx, xy, yy = (entry[:, None, None] for entry in ellipses.conics.unbind(1))
    distance = xx * dx**2 + 2 * xy * dx * dy + yy * dy**2  # [K, R, W]
    alpha = ellipses.opacities[:, None, None] * torch.exp(-distance / 2)
    alpha = torch.where(alpha < MIN_ALPHA, torch.zeros_like(alpha), alpha.clamp(max=MAX_ALPHA))
    remaining = torch.cumprod(1 - alpha, dim=0)
    before = torch.cat([torch.ones_like(remaining[:1]), remaining[:-1]])  # transmittance in front of each
    weights = torch.where(before < MIN_TRANSMITTANCE, torch.zeros_like(alpha), alpha * before)
    return torch.einsum('krw,kc->crw', weights, features)
