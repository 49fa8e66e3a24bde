"""When a pose may be trusted."""

from __future__ import annotations

import numpy as np
import torch

from splatam_core.config import TrackingConfig
from splatam_core.geometry.se3 import Matrix
from splatam_core.images.view import View
from splatam_core.rasterizer import Render
from splatam_core.tracking.base import TrackingResult


def compare(T_cam_world: Matrix, render: Render, view: View, config: TrackingConfig) -> TrackingResult:
    """Returns a pose [4, 4] with the evidence for it: how much of the view agrees with the map rendered from there."""
    visible = view.valid & (render.silhouette > config.silhouette_threshold)
    depth_agrees = (render.depth() - view.depth).abs() <= config.inlier_depth * view.depth
    color_agrees = (render.rgb - view.rgb).abs().mean(dim=0) <= config.inlier_color
    counts = torch.stack([view.valid.sum(), visible.sum(), (visible & depth_agrees & color_agrees).sum()])
    num_readings, num_visible, num_inliers = counts.tolist()
    return TrackingResult(
        T_cam_world=T_cam_world,
        T_cam_world_depth=T_cam_world,
        num_readings=num_readings,
        visible_fraction=num_visible / max(1, num_readings),
        inlier_fraction=num_inliers / max(1, num_visible),
    )


def verify(result: TrackingResult, config: TrackingConfig) -> str:
    """Returns why a pose must not be used; empty where it may be used."""
    if not np.isfinite(result.T_cam_world).all():
        return 'tracking diverged: the pose is not finite'
    if result.num_readings == 0:
        return 'no pixel has a usable depth reading'
    if result.visible_fraction < config.min_visible_fraction:
        return f'only {result.visible_fraction:.0%} of the view is mapped (at least {config.min_visible_fraction:.0%} needed)'
    if result.inlier_fraction < config.min_inlier_fraction:
        return f'only {result.inlier_fraction:.0%} of it agrees with the map (at least {config.min_inlier_fraction:.0%} needed)'
    return ''
