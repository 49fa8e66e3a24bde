"""Where a frame shows what the map lacks, and the Gaussians that fill it (paper, section 3.3)."""

from __future__ import annotations

import itertools
import math

import torch
from torch import Tensor
from torch.nn import functional

from splatam_core.config import DensificationConfig
from splatam_core.images.filters import box_sums, median
from splatam_core.images.spacing import WINDOW
from splatam_core.images.view import View, unproject
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.mapping.ghosts import ghosts, seen_through
from splatam_core.mapping.posed import Before, PosedView
from splatam_core.rasterizer import Gaussians, Rasterizer, Render
from splatam_core.rasterizer.base import BLUR_PX2

MAX_BIAS = 0.1
"""As a fraction of the depth. A pixel that is off by more shows another surface."""

BIAS_WINDOW = 5  # readings

MIN_SQUARED_DEPTH = 0.01  # m^2: against division by zero

MIN_NEW_DEPTH, MIN_NEW_FRACTION = 0.02, 0.01
"""Metres, and fraction of the depth: a smaller error is never taken for something new."""

MAX_EXCESS = 1.5
"""A single reading far from all others is not taken for farther from them than this many mean spacings."""

MIN_SUPPORTERS, SAME_SURFACE = 2, 0.1
"""A reading with fewer neighbours that differ by at most this fraction stands alone."""

MAX_ALONE = 0.001
"""As a fraction of the readings. More that stand alone are speckles."""


def densify(
    gaussian_map: GaussianMap,
    view: View,
    T_cam_world: Tensor,
    rasterizer: Rasterizer,
    config: DensificationConfig,
    before: Before | None = None,
) -> Tensor:
    """Removes the Gaussians that the view sees through, and adds those that make the map explain it.

    Args:
        gaussian_map: changed in place.
        view: at full size.
        T_cam_world: [4, 4] where it was taken from.
        rasterizer: renders the map.
        config: where Gaussians are added.
        before: the view and the map as it is, at the size at which they are added, if these exist already.

    Returns:
        [K, 3] where the Gaussians were that were removed.
    """
    view = view.narrowed(config.scale, config.max_width) if before is None else before.view
    gone = gaussian_map.means.new_zeros(0, 3)

    def render() -> Render:
        return rasterizer.render(gaussian_map.gaussians.detached(), view.camera, T_cam_world)

    with torch.no_grad():
        drawn = render() if before is None else before.render
        through = seen_through(drawn, view) if config.depth_noise_ratio > 0 else None  # the paper removes nothing
        if through is not None:
            means = gaussian_map.means.detach()
            is_ghost = ghosts(means, PosedView(view, T_cam_world), through)
            gone = means[is_ghost]
            gaussian_map.keep(~is_ghost)
            drawn = render()
        chosen = without_speckles(unexplained(drawn, view, config), view)
        depth, widths_px = view.depth, new_widths(view)
        added = gaussian_map.append(new_gaussians(view, chosen, depth, T_cam_world, config.opacity, widths_px))
        chosen = chosen.masked_scatter(chosen, added)  # without those that were refused
        for _ in range(config.bias_correction_rounds):
            depth = corrected(depth, depth_bias(render(), view), view.depth)
            gaussian_map.replace_last(new_gaussians(view, chosen, depth, T_cam_world, config.opacity, widths_px))
    return gone


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
    side = 2 * round((BIAS_WINDOW * view.spacing - 1) / 2) + 1
    error, weight = (box_sums(image, side) for image in (compared * (depth - view.depth), compared))
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


def without_speckles(chosen: Tensor, view: View) -> Tensor:
    """Returns the chosen pixels [H, W] without readings that stand alone, if there are many of them.

    Stereo matching gives speckles at any depth. Nothing contradicts one in the sky, and it would grow there. Single readings
    are also the last that is seen of a thin thing; they stay.
    """
    v, u = torch.nonzero(chosen, as_tuple=True)
    reach = math.ceil(view.spacing) + 1
    depth, z = functional.pad(view.depth, (reach,) * 4), view.depth[v, u]
    supporters, most = torch.full_like(v, -1), SAME_SURFACE * z  # not itself
    first, around = v * depth.shape[1] + u, range(2 * reach + 1)
    for down, right in itertools.product(around, repeat=2):
        supporters += (depth.take(first + (down * depth.shape[1] + right)) - z).abs() <= most
    alone = supporters < MIN_SUPPORTERS
    is_speckled = alone.sum() > MAX_ALONE * view.valid.sum()
    return chosen.masked_scatter(chosen, ~(alone & is_speckled))


def new_widths(view: View) -> Tensor | None:
    """Returns [H, W] radii in pixels of new Gaussians, that close the surface between its readings; None: one pixel everywhere.

    With its blur, a Gaussian covers as much of the distance to its neighbours as one of a dense image does.
    """
    if view.spacing == 1.0:
        return None
    return ((1 + BLUR_PX2) * _local_spacing(view.valid, view.spacing).square() - BLUR_PX2).sqrt()


def _local_spacing(valid: Tensor, mean_spacing: float) -> Tensor:
    """Returns [H, W] distances in pixels between neighbouring readings, at least 1.

    At the border of a surface the readings of the surface alone count, so that it is not taken for sparser there.

    Args:
        valid: [H, W] bool, where there is a reading.
        mean_spacing: see ``reading_spacing``.
    """
    image, half = valid.float()[None], WINDOW // 2
    for window, padding in (((WINDOW, 1), (half, 0)), ((1, WINDOW), (0, half))):
        image = functional.avg_pool2d(image, window, 1, padding, count_include_pad=False)
    density = functional.max_pool2d(image, WINDOW, 1, half)[0, 1:-1, 1:-1]  # an even window adds a row and a column each time
    return density.clamp(min=1 / WINDOW**2).rsqrt().clamp(1.0, MAX_EXCESS * mean_spacing)


def new_gaussians(
    view: View, chosen: Tensor, depth: Tensor, T_cam_world: Tensor, opacity: float, widths_px: Tensor | None = None
) -> Gaussians:
    """Returns one Gaussian for each chosen pixel [H, W]: at a depth [H, W], in the pixel's colour.

    Args:
        view: the images.
        chosen: [H, W] bool.
        depth: [H, W] metres.
        T_cam_world: [4, 4] of the view.
        opacity: of each Gaussian.
        widths_px: [H, W] radii in pixels; None = one pixel.
    """
    v, u = torch.nonzero(chosen, as_tuple=True)
    points = unproject(view.camera, u, v, depth[v, u])  # [K, 3]
    R, t = T_cam_world[:3, :3], T_cam_world[:3, 3]
    radii = points[:, 2:] / ((view.camera.fx + view.camera.fy) / 2)  # [K, 1]
    if widths_px is not None:
        radii = radii * widths_px[v, u, None]
    return Gaussians(
        means=(points - t) @ R,
        log_scales=torch.log(radii),
        logit_opacities=points.new_full((len(points),), math.log(opacity / (1 - opacity))),
        rgb=view.rgb8[v, u].float().div_(255),
    )
