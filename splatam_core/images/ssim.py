"""Structural similarity (Wang et al. 2004), differentiable."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from splatam_core.images.filters import blurred


def ssim_map(a: Tensor, b: Tensor) -> Tensor:
    """Returns the structural similarity per pixel and channel, with a zero-padded 11x11 Gaussian window.

    Args:
        a: [3, H, W] in [0, 1].
        b: the same; gradients flow into both.

    Returns:
        [3, H, W], at most 1.
    """
    luminance, structure = ssim_terms(a, b)
    return luminance * structure


def ssim_terms(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the two factors of ``ssim_map``: luminance, and contrast times structure."""
    c1, c2 = 0.01**2, 0.03**2
    mean_a, mean_b, aa, bb, ab = map(_Blur.apply, (a, b, a * a, b * b, a * b))
    variances = aa - mean_a**2 + bb - mean_b**2
    covariance = ab - mean_a * mean_b
    return (2 * mean_a * mean_b + c1) / (mean_a**2 + mean_b**2 + c1), (2 * covariance + c2) / (variances + c2)


class _Blur(torch.autograd.Function):
    """Convolves images [N, H, W] with the SSIM window; zeros outside. It is symmetric, and so its own adjoint."""

    @staticmethod
    def forward(ctx: Any, images: Tensor) -> Tensor:
        return blurred(images.detach())

    @staticmethod
    def backward(ctx: Any, gradients: Tensor) -> Tensor:
        return blurred(gradients)
