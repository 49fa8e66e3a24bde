"""Where a frame shows what the map lacks, and the Gaussians that fill it (paper, section 3.3)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from splatam_core.config import DensificationConfig
from splatam_core.rasterizer import Gaussians, Rasterizer, Render
from splatam_core.view import View


def densify(
    gaussians: Gaussians, view: View, T_cam_world: Tensor, rasterizer: Rasterizer, config: DensificationConfig
) -> Gaussians:
    """The Gaussians to add so that the map explains the view."""
    view = view.scaled(config.scale)
    with torch.no_grad():
        render = rasterizer.render(gaussians.detached(), view.camera, T_cam_world)
    return new_gaussians(view, unexplained(render, view, config), T_cam_world, config.opacity)


def unexplained(render: Render, view: View, config: DensificationConfig) -> Tensor:
    """[H, W] pixels that see no map, or something new in front of it (paper, eq. 9).

    The median error is taken over the pixels that have both a reading and map behind it.
    """
    unmapped = render.silhouette < config.silhouette_threshold
    depth = render.depth()
    error = (depth - view.depth).abs()
    compared = view.valid & (depth > 0)
    if not compared.any():
        return unmapped & view.valid
    in_front = (depth > view.depth) & (error > config.depth_error_ratio * error[compared].median())
    return (unmapped | in_front) & view.valid


def new_gaussians(view: View, chosen: Tensor, T_cam_world: Tensor, opacity: float) -> Gaussians:
    """One Gaussian per chosen pixel [H, W], one pixel wide, of the pixel's colour."""
    points = view.points(chosen)  # [K, 3]
    R, t = T_cam_world[:3, :3], T_cam_world[:3, 3]
    focal = (view.camera.fx + view.camera.fy) / 2
    return Gaussians(
        means=(points - t) @ R,
        log_scales=torch.log(points[:, 2:] / focal),
        logit_opacities=torch.full((len(points),), math.log(opacity / (1 - opacity))),
        rgb=view.rgb[:, chosen].T.contiguous(),
    )
