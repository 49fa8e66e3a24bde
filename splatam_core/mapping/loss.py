"""The paper's mapping loss (section 3.4)."""

from __future__ import annotations

from torch import Tensor

from splatam_core.config import MappingConfig
from splatam_core.images.filters import inliers
from splatam_core.images.ssim import ssim_map
from splatam_core.images.view import View
from splatam_core.rasterizer import Render


def mapping_loss(render: Render, view: View, config: MappingConfig) -> Tensor:
    """Mean L1 of depth over readings, and L1 with SSIM of colour over the image (paper, section 3.4)."""
    paper = config.paper
    error, counts = (render.depth_acc - view.depth).abs(), view.valid
    if paper.depth_outlier_ratio > 0:
        counts = inliers(error.detach(), counts, paper.depth_outlier_ratio)
    depth = (error * counts).sum() / counts.sum().clamp(min=1)
    color = (1 - paper.ssim_weight) * (render.rgb - view.rgb).abs().mean()
    if paper.ssim_weight > 0:
        color = color + paper.ssim_weight * (1 - ssim_map(render.rgb, view.rgb).mean())
    return config.depth_weight * depth + config.color_weight * color
