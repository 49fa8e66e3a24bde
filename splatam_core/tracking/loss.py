"""The paper's tracking loss (section 3.2, equation 8)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from splatam_core.config import TrackingConfig
from splatam_core.images.filters import inliers
from splatam_core.images.view import View
from splatam_core.rasterizer import Render


@dataclass(frozen=True, slots=True, eq=False)
class TrackingLoss:
    """The loss of a pose.

    Attributes:
        total: weighted sum over the pixels compared, differentiable.
        depth: the unweighted sum of depth errors, metres times pixels; detached.
        num_pixels: number of pixels compared, a scalar on the device.
    """

    total: Tensor
    depth: Tensor
    num_pixels: Tensor


def tracking_loss(render: Render, view: View, config: TrackingConfig) -> TrackingLoss:
    """Returns the summed L1 errors of depth and colour where the map is opaque and the sensor has a reading (paper, eq. 8).

    Without ``use_silhouette``, depth is compared at every reading, and colour at every pixel, whether the map is there or not.
    """
    counts = view.valid & (render.silhouette.detach() > config.silhouette_threshold) if config.paper.use_silhouette else view.valid
    error = ((render.depth_acc if config.paper.blended_depth else expected_depth(render)) - view.depth).abs()
    if config.paper.depth_outlier_ratio > 0:
        counts = inliers(error.detach(), counts, config.paper.depth_outlier_ratio)
    mask = counts.to(view.rgb.dtype)
    depth = (error * mask).sum()
    difference = (render.rgb - view.rgb).abs()
    color = (difference * mask).sum() if config.paper.use_silhouette or config.paper.depth_outlier_ratio > 0 else difference.sum()
    return TrackingLoss(config.depth_weight * depth + config.color_weight * color, depth.detach(), counts.sum())


def expected_depth(render: Render) -> Tensor:
    """Returns [H, W] metres, differentiable; below a silhouette of one half it falls to 0."""
    return render.depth_acc / render.silhouette.clamp(min=0.5)
