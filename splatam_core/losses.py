"""The losses of the paper: pure functions of a render and the view it should look like."""

from __future__ import annotations

from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor

from splatam_core.rasterizer import Render
from splatam_core.view import View

SSIM_WINDOW = 11
SSIM_SIGMA = 1.5


def tracking_loss(
    render: Render, view: View, silhouette_threshold: float, color_weight: float, depth_weight: float
) -> Tensor:
    """Summed L1 of depth and colour where the map is sure and the sensor has a reading (paper, eq. 8)."""
    mask = ((render.silhouette.detach() > silhouette_threshold) & view.valid).to(view.rgb.dtype)
    depth = ((render.depth_acc - view.depth).abs() * mask).sum()
    color = ((render.rgb - view.rgb).abs() * mask).sum()
    return depth_weight * depth + color_weight * color


def mapping_loss(render: Render, view: View, ssim_weight: float, color_weight: float, depth_weight: float) -> Tensor:
    """Mean L1 of depth over readings, and L1 with SSIM of colour over the image (paper, section 3.4)."""
    readings = view.valid.sum().clamp(min=1)
    depth = ((render.depth_acc - view.depth).abs() * view.valid).sum() / readings
    color = (1 - ssim_weight) * (render.rgb - view.rgb).abs().mean()
    if ssim_weight > 0:
        color = color + ssim_weight * (1 - ssim_map(render.rgb, view.rgb).mean())
    return depth_weight * depth + color_weight * color


def ssim_map(a: Tensor, b: Tensor) -> Tensor:
    """Structural similarity per pixel and channel (Wang et al. 2004), zero-padded 11x11 Gaussian window.

    Args:
        a: [3, H, W] in [0, 1].
        b: the same; gradients flow into both.

    Returns:
        [3, H, W], at most 1.
    """
    c1, c2 = 0.01**2, 0.03**2
    mean_a, mean_b, aa, bb, ab = _blur(torch.stack([a, b, a * a, b * b, a * b])).unbind()
    variances = aa - mean_a**2 + bb - mean_b**2
    covariance = ab - mean_a * mean_b
    return ((2 * mean_a * mean_b + c1) * (2 * covariance + c2)) / ((mean_a**2 + mean_b**2 + c1) * (variances + c2))


def _blur(images: Tensor) -> Tensor:
    """[..., H, W] convolved with the separable Gaussian window."""
    kernel = _window(images.dtype)
    flat = images.reshape(-1, 1, *images.shape[-2:])
    half = SSIM_WINDOW // 2
    rows = F.conv2d(flat, kernel.view(1, 1, -1, 1), padding=(half, 0))
    return F.conv2d(rows, kernel.view(1, 1, 1, -1), padding=(0, half)).reshape(images.shape)


@lru_cache
def _window(dtype: torch.dtype) -> Tensor:
    offsets = torch.arange(SSIM_WINDOW, dtype=torch.float64) - SSIM_WINDOW // 2
    weights = torch.exp(-(offsets**2) / (2 * SSIM_SIGMA**2))
    return (weights / weights.sum()).to(dtype)
