"""Where a frame shows what the map lacks, and the Gaussians that fill it (paper, section 3.3)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from splatam_core.config import DensificationConfig
from splatam_core.images.filters import box_sums, median
from splatam_core.images.view import View, unproject
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.rasterizer import Gaussians, Rasterizer, Render

MAX_BIAS = 0.1
"""As a fraction of the depth. A pixel that is off by more shows another surface."""

BIAS_WINDOW = 5  # pixels

MIN_SQUARED_DEPTH = 0.01  # m^2: against division by zero

MIN_NEW_DEPTH, MIN_NEW_FRACTION = 0.02, 0.01
"""Metres, and fraction of the depth: a smaller error is never taken for something new."""


def densify(
    gaussian_map: GaussianMap, view: View, T_cam_world: Tensor, rasterizer: Rasterizer, config: DensificationConfig
) -> None:
    """Adds the Gaussians that make the map explain the view."""
    view = view.narrowed(config.scale, config.max_width)

    def render() -> Render:
        return rasterizer.render(gaussian_map.gaussians.detached(), view.camera, T_cam_world)

    with torch.no_grad():
        chosen, depth = unexplained(render(), view, config), view.depth
        added = gaussian_map.append(new_gaussians(view, chosen, depth, T_cam_world, config.opacity))
        chosen = chosen.masked_scatter(chosen, added)  # without those that were refused
        for _ in range(config.bias_correction_rounds):
            depth = corrected(depth, depth_bias(render(), view), view.depth)
            gaussian_map.replace_last(new_gaussians(view, chosen, depth, T_cam_world, config.opacity))


def corrected(depth: Tensor, bias: Tensor, reading: Tensor) -> Tensor:
    """Returns depth - bias [H, W], and the reading where that is no depth: beside a far surface the bias may exceed a near one."""
    moved = depth - bias
    return torch.where((moved > 0) & (moved < torch.inf), moved, reading)


def depth_bias(render: Render, view: View) -> Tensor:
    """Returns [H, W] metres by which the rendered depth is off, averaged over each pixel's surroundings.

    Blending front to back favours the nearer neighbours, so a fresh map renders slanted or noisy surfaces too near. Only
    the average matters: a pixel's own error is mostly noise, and correcting it would add that noise to the map.
    """
    depth = render.depth()
    compared = (view.valid & (depth > 0) & ((depth - view.depth).abs() < MAX_BIAS * view.depth)).float()
    error, weight = (box_sums(image, BIAS_WINDOW) for image in (compared * (depth - view.depth), compared))
    return error / weight.clamp(min=1)


def unexplained(render: Render, view: View, config: DensificationConfig) -> Tensor:
    """Returns [H, W] which pixels show no map, or something new in front of it (paper, equation 9)."""
    unmapped = render.silhouette < config.silhouette_threshold
    depth = render.depth()
    in_front = (depth > view.depth) & ((depth - view.depth).abs() > _significant_error(depth, view, config))
    return (unmapped | in_front) & view.valid


def _significant_error(depth: Tensor, view: View, config: DensificationConfig) -> Tensor:
    """Returns, [H, W] or [], the depth error in metres beyond which a reading shows something new.

    The paper takes a multiple of the median error. In a deep scene that is metres, and a near surface that was mapped from
    afar stays full of holes. The noise of stereo and structured light grows with the square of the depth, so one number
    describes it at every distance (Khoshelham and Elberink 2012); a floor covers the map's own error.
    """
    error, compared = (depth - view.depth).abs(), view.valid & (depth > 0)
    if config.depth_noise_ratio == 0:
        return config.depth_error_ratio * median(error, compared)
    squared = view.depth.square()
    noise = median(error / squared.clamp(min=MIN_SQUARED_DEPTH), compared)
    return (config.depth_noise_ratio * noise * squared).clamp(min=MIN_NEW_DEPTH) + MIN_NEW_FRACTION * view.depth


def new_gaussians(view: View, chosen: Tensor, depth: Tensor, T_cam_world: Tensor, opacity: float) -> Gaussians:
    """Returns one Gaussian for each chosen pixel [H, W]: at a depth [H, W], one pixel wide, in the pixel's colour."""
    v, u = torch.nonzero(chosen, as_tuple=True)
    points = unproject(view.camera, u, v, depth[v, u])  # [K, 3]
    R, t = T_cam_world[:3, :3], T_cam_world[:3, 3]
    focal = (view.camera.fx + view.camera.fy) / 2
    return Gaussians(
        means=(points - t) @ R,
        log_scales=torch.log(points[:, 2:] / focal),
        logit_opacities=points.new_full((len(points),), math.log(opacity / (1 - opacity))),
        rgb=view.rgb[:, v, u].T.contiguous(),
    )
