"""Map refinement: Adam on the Gaussians, poses fixed, one random view of the window a step (paper, section 3.4)."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence

import numpy as np
import torch
from torch import Tensor

from splatam_core.config import MappingConfig, SlamConfig
from splatam_core.images.filters import is_on_host
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.mapping.keyframes import PosedView, draw
from splatam_core.mapping.loss import mapping_loss
from splatam_core.rasterizer import Rasterizer, Rates, Target

RESET_OPACITY = 0.01
"""What the original makes of all opacities (``reset_opacities``), as 3D Gaussian splatting does."""

FINAL_FIRST, FINAL_LAST, FINAL_MEANS, FINAL_SCALES = 5.0, 0.2, 0.3, 3.0
"""Of ``refit``: step sizes at its beginning and end, relative to the usual ones, and factors of centres and log scales."""


def refine(
    gaussian_map: GaussianMap,
    window: Sequence[PosedView],
    rasterizer: Rasterizer,
    config: SlamConfig,
    scene_radius: float,
    rng: np.random.Generator,
    more: int = 0,
) -> None:
    """Fit the map to the window, pruning on the way.

    Args:
        gaussian_map: changed in place.
        window: the views to fit.
        rasterizer: draws the map.
        config: steps, weights, rates, pruning.
        scene_radius: metres; Gaussians are too wide relative to it.
        rng: draws the view of each step.
        more: steps on top of the configured ones.
    """
    fit = _fit_fused if config.mapping.optimizer == 'fused' else _fit_by_autograd
    steps = range(config.mapping.iterations + more)
    views = (_sized(draw(window, config.keyframes, rng), step, config.mapping.half_size_every) for step in steps)
    fit(gaussian_map, views, rasterizer, config.mapping, scene_radius)


def _sized(posed: PosedView, step: int, half_size_every: int) -> PosedView:
    is_half = half_size_every and step % half_size_every == half_size_every - 1
    return PosedView(posed.view.scaled(0.5), posed.T_cam_world) if is_half else posed


def rates(config: MappingConfig) -> Rates:
    """Adam's."""
    return Rates(config.means_rate, config.scale_rate, config.opacity_rate, config.rgb_rate, config.rotation_rate)


def _fit_by_autograd(
    gaussian_map: GaussianMap, views: Iterable[PosedView], rasterizer: Rasterizer, config: MappingConfig,
    scene_radius: float,
) -> None:  # fmt: skip
    gaussian_map.start_optimization(rates(config))
    for step, posed in enumerate(views):
        render = rasterizer.render(gaussian_map.gaussians, posed.view.camera, posed.T_cam_world)
        mapping_loss(render, posed.view, config).backward()
        if step <= config.prune_until:
            _tidy_up(gaussian_map, config, scene_radius, step)
        gaussian_map.step()
    gaussian_map.stop_optimization()


def _tidy_up(gaussian_map: GaussianMap, config: MappingConfig, scene_radius: float, step: int) -> None:
    if config.prune_every and step % config.prune_every == 0 and step >= config.prune_from:
        last = step == config.prune_until and config.prune_last_opacity > 0
        min_opacity = config.prune_last_opacity if last else config.prune_opacity
        max_scale = config.prune_scale * scene_radius if step >= config.prune_scale_from else math.inf
        gaussian_map.keep(~prunable(gaussian_map, min_opacity, max_scale))
    if config.reset_opacity_every and step > 0 and step % config.reset_opacity_every == 0:
        gaussian_map.set_opacities(RESET_OPACITY)


def _fit_fused(
    gaussian_map: GaussianMap, views: Iterable[PosedView], rasterizer: Rasterizer, config: MappingConfig,
    scene_radius: float,
) -> None:  # fmt: skip
    for posed in views:
        _step_fused(gaussian_map, posed, rasterizer, config, rates(config))
    if config.prune_every:
        chosen = prunable(gaussian_map, config.prune_opacity, config.prune_scale * scene_radius)
        if torch.count_nonzero(chosen) > config.prune_share * len(gaussian_map):
            gaussian_map.keep(~chosen)


def _step_fused(gaussian_map: GaussianMap, posed: PosedView, rasterizer: Rasterizer, config: MappingConfig, rates: Rates) -> None:
    view = posed.view
    target = Target(view.camera, view.rgb8, view.depth, posed.T_cam_world, config.color_weight, config.depth_weight)
    rasterizer.fit(gaussian_map.gaussians, gaussian_map.moments, rates, target)


def refit(
    gaussian_map: GaussianMap,
    keyframes: Sequence[PosedView],
    rasterizer: Rasterizer,
    config: MappingConfig,
    rng: np.random.Generator,
    limit_s: float = math.inf,
    stop: Callable[[], bool] = lambda: False,
) -> int:
    """Fit the map to all keyframes in turn, poses fixed, step sizes fading: what few steps a frame forgot comes back.

    Args:
        gaussian_map: changed in place.
        keyframes: the views to fit.
        rasterizer: draws the map; its fused fitting is used.
        config: passes, weights, rates.
        rng: draws the order of each pass.
        limit_s: seconds after which the step sizes have faded, however many steps that were.
        stop: asked before each step; where it says so, the last one was taken.

    Returns:
        How many steps it took.
    """
    num_steps, began_s = config.final_passes * len(keyframes), time.monotonic()
    for step in range(num_steps):
        if step % len(keyframes) == 0:
            order = rng.permutation(len(keyframes))
        done, time_used = step / num_steps, (time.monotonic() - began_s) / max(limit_s, 1e-9)
        if time_used > (step + 1) / num_steps:  # else the clock changes nothing, so that runs repeat bit for bit
            done = time_used
        if done >= 1 or stop():
            return step
        posed = keyframes[order[step % len(keyframes)]]
        _step_fused(gaussian_map, posed, rasterizer, config, _final_rates(config, done))
    return num_steps


def _final_rates(config: MappingConfig, done: float) -> Rates:
    fade = FINAL_FIRST * (FINAL_LAST / FINAL_FIRST) ** done
    usual = rates(config)
    return Rates(
        FINAL_MEANS * fade * usual.means, FINAL_SCALES * fade * usual.log_scales, fade * usual.logit_opacities,
        fade * usual.rgb, fade * usual.rotations,
    )  # fmt: skip


def prunable(gaussian_map: GaussianMap, min_opacity: float, max_scale_m: float) -> Tensor:
    """[N] Gaussians that are too faint to matter or too wide to be surface."""
    logits, widest = gaussian_map.logit_opacities.detach(), _widest(gaussian_map.log_scales.detach())
    faintest, limit = _logit(min_opacity), _log(max_scale_m)
    if is_on_host(logits):  # a fifth of torch's time: it looks at all of a large map on every frame
        return torch.from_numpy((logits.numpy() < faintest) | (widest.numpy() > limit))
    return (logits < faintest) | (widest > limit)


def _widest(log_scales: Tensor) -> Tensor:
    return log_scales[:, 0] if log_scales.shape[1] == 1 else log_scales.amax(dim=1)  # which for one copies


def _logit(p: float) -> float:
    return _log(p) - _log(1 - p)


def _log(x: float) -> float:
    return math.log(x) if x > 0 else -math.inf
