"""MS-SSIM: structural similarity of whole images at several scales."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from splatam_core.images.ssim import ssim_terms

SCALE_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Exponents of the five scales, finest first (Wang et al. 2003, section 3.2)."""

WINDOW_MARGIN = 5
"""Half of the 11 pixel window, in pixels."""

MIN_SIDE = 161
"""Pixels. In smaller images the window does not fit into the coarsest scale."""


def ms_ssim(a: Tensor, b: Tensor) -> float | None:
    """Compute the multi-scale structural similarity of two whole images.

    Wang, Simoncelli, Bovik, "Multi-scale structural similarity for image quality assessment", 2003, equation 7:
    contrast and structure at five scales, and luminance at the coarsest. Only windows that lie inside the image count.
    As in ``pytorch_msssim``, which the original uses, odd sizes are padded with zeros before halving, and a negative
    factor counts as zero.

    Args:
        a: [3, H, W] in [0, 1].
        b: [3, H, W] in [0, 1].

    Returns:
        The mean over the channels; None if the short side has fewer than 161 pixels.
    """
    if min(a.shape[-2:]) < MIN_SIDE:
        return None
    similarity = torch.ones(len(a), device=a.device)
    for scale, weight in enumerate(SCALE_WEIGHTS):
        if scale:
            a, b = _halved(a), _halved(b)
        luminance, structure = (_inside(term) for term in ssim_terms(a, b))
        is_coarsest = scale == len(SCALE_WEIGHTS) - 1
        factor = (luminance * structure if is_coarsest else structure).mean(dim=(1, 2))
        similarity = similarity * factor.clamp(min=0) ** weight
    return float(similarity.mean())


def _halved(image: Tensor) -> Tensor:
    padding = [size % 2 for size in image.shape[-2:]]
    return functional.avg_pool2d(image, kernel_size=2, padding=padding)


def _inside(values: Tensor) -> Tensor:
    return values[:, WINDOW_MARGIN:-WINDOW_MARGIN, WINDOW_MARGIN:-WINDOW_MARGIN]
