"""The losses of the paper: pure functions of a render and the view it should look like."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from splatam_core.config import MappingConfig, TrackingConfig
from splatam_core.filters import blurred, median
from splatam_core.rasterizer import Render
from splatam_core.view import View


@dataclass(frozen=True, slots=True, eq=False)
class TrackingLoss:
    """How far a pose is from explaining a view.

    Attributes:
        total: sum over the pixels that count, differentiable.
        depth: the part of depth, unweighted, metres times pixels.
        num_pixels: how many count, a scalar on the device.
    """

    total: Tensor
    depth: Tensor
    num_pixels: Tensor


def tracking_loss(render: Render, view: View, config: TrackingConfig) -> TrackingLoss:
    """Summed L1 of depth and colour where the map is sure and the sensor has a reading (paper, eq. 8).

    Without the silhouette's mask depth counts at every reading, and colour at every pixel, map or not.
    """
    counts = view.valid & (render.silhouette.detach() > config.silhouette_threshold) if config.use_silhouette else view.valid
    error = ((render.depth_acc if config.blended_depth else expected_depth(render)) - view.depth).abs()
    if config.depth_outlier_ratio > 0:
        counts = inliers(error.detach(), counts, config.depth_outlier_ratio)
    mask = counts.to(view.rgb.dtype)
    depth = (error * mask).sum()
    difference = (render.rgb - view.rgb).abs()
    color = (difference * mask).sum() if config.use_silhouette or config.depth_outlier_ratio > 0 else difference.sum()
    return TrackingLoss(config.depth_weight * depth + config.color_weight * color, depth.detach(), counts.sum())


def inliers(error: Tensor, counts: Tensor, ratio: float) -> Tensor:
    """[H, W] what counts and has an error of at most so many times the median of all that count."""
    return counts & (error <= ratio * median(error, counts))


def expected_depth(render: Render) -> Tensor:
    """[H, W] metres; where little or no map is seen it fades to 0, differentiably."""
    return render.depth_acc / render.silhouette.clamp(min=0.5)


def mapping_loss(render: Render, view: View, config: MappingConfig) -> Tensor:
    """Mean L1 of depth over readings, and L1 with SSIM of colour over the image (paper, section 3.4)."""
    error, counts = (render.depth_acc - view.depth).abs(), view.valid
    if config.depth_outlier_ratio > 0:
        counts = inliers(error.detach(), counts, config.depth_outlier_ratio)
    depth = (error * counts).sum() / counts.sum().clamp(min=1)
    color = (1 - config.ssim_weight) * (render.rgb - view.rgb).abs().mean()
    if config.ssim_weight > 0:
        color = color + config.ssim_weight * (1 - ssim_map(render.rgb, view.rgb).mean())
    return config.depth_weight * depth + config.color_weight * color


def ssim_map(a: Tensor, b: Tensor) -> Tensor:
    """Structural similarity per pixel and channel (Wang et al. 2004), zero-padded 11x11 Gaussian window.

    Args:
        a: [3, H, W] in [0, 1].
        b: the same; gradients flow into both.

    Returns:
        [3, H, W], at most 1.
    """
    luminance, structure = ssim_terms(a, b)
    return luminance * structure


def ssim_terms(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """The two factors of ``ssim_map``: luminance, and contrast times structure."""
    c1, c2 = 0.01**2, 0.03**2
    mean_a, mean_b, aa, bb, ab = map(_Blur.apply, (a, b, a * a, b * b, a * b))
    variances = aa - mean_a**2 + bb - mean_b**2
    covariance = ab - mean_a * mean_b
    return (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1), (2 * covariance + c2) / (variances + c2)


class _Blur(torch.autograd.Function):
    """Images [N, H, W] convolved with the SSIM window, zeros outside; symmetric, so it is its own adjoint."""

    @staticmethod
    def forward(ctx: Any, images: Tensor) -> Tensor:
        return blurred(images.detach())

    @staticmethod
    def backward(ctx: Any, slopes: Tensor) -> Tensor:
        return blurred(slopes)
