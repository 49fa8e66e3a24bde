"""The fused optimizer: render, compare and step in one call of the rasterizer (``Rasterizer.fit``)."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence

import numpy as np

from splatam_core.config import MappingConfig
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.mapping.optimizers.base import TimeLimit, prune, rates
from splatam_core.mapping.posed import PosedView
from splatam_core.rasterizer import Gaussians, Moments, Rasterizer, Rates, Target
from splatam_core.rasterizer.base import COLOR_LIMIT

CORRECTED_PASSES = 2
"""Times as many final passes where loops have moved Gaussians: they were fitted at other poses."""

LEAST_STEPS, MOST_TIMES = 150, 3
"""Where the final passes have fewer steps, because there are few keyframes, there are up to three times as many passes: a Gaussian
has its share of the steps, however short the recording is."""

FINAL_FIRST, FINAL_LAST = 5.0, 0.1
"""Step sizes at the beginning and at the end of ``finish``, relative to those of ``fit``; half a cosine lies between them."""

FINAL_MEANS, FINAL_SCALES, FINAL_COLORS = 0.1, 3.0, 2.0
"""Additional factors of the centres, the log scales and the colours in ``finish``."""


class FusedOptimizer:
    """Huber loss without SSIM; moments live as long as their Gaussians; only visible Gaussians move.

    Colour far from every reading is not compared (``PosedView.comparable``): Gaussians at the edge of a roof would grow into the
    sky to explain it.
    """

    def __init__(self, rasterizer: Rasterizer, config: MappingConfig) -> None:
        self._rasterizer, self._config = rasterizer, config

    def fit(self, gaussian_map: GaussianMap, views: Iterable[PosedView], scene_radius: float) -> None:
        """See ``MapOptimizer.fit``."""
        gaussians, moments, usual = gaussian_map.gaussians, gaussian_map.moments, rates(self._config)
        for posed in views:
            self._step(gaussians, moments, posed, usual, self._config.fused.tolerance)
        prune(gaussian_map, self._config, scene_radius, self._config.fused.prune_fraction)

    def finish(
        self, gaussian_map: GaussianMap, keyframes: Sequence[PosedView], rng: np.random.Generator, limit: TimeLimit, *,
        is_corrected: bool,
    ) -> int:  # fmt: skip
        """See ``MapOptimizer.finish``. Decreasing step sizes bring back what few steps a frame had forgotten."""
        gaussians, moments = gaussian_map.gaussians, gaussian_map.moments
        num_steps, began_s = self._num_passes(len(keyframes), is_corrected) * len(keyframes), time.monotonic()
        for step in range(num_steps):
            if step % len(keyframes) == 0:
                order = rng.permutation(len(keyframes))
            done, time_used = step / num_steps, (time.monotonic() - began_s) / max(limit.seconds, 1e-9)
            if time_used > (step + 1) / num_steps:  # else wall time changes nothing, so that runs repeat bit for bit
                done = time_used
            if done >= 1 or limit.stop():
                return step
            posed = keyframes[int(order[step % len(keyframes)])]
            self._step(gaussians, moments, posed, _final_rates(self._config, done), tolerance=0.0)
        return num_steps

    def _num_passes(self, num_keyframes: int, is_corrected: bool) -> int:
        passes = self._config.fused.final_passes * (CORRECTED_PASSES if is_corrected else 1)
        wanted = math.ceil(LEAST_STEPS / max(1, num_keyframes))
        return min(max(passes, wanted), MOST_TIMES * passes)

    def _step(self, gaussians: Gaussians, moments: Moments, posed: PosedView, rates: Rates, tolerance: float) -> None:
        view, config = posed.view, self._config
        enough = config.color_weight * tolerance**2 / (2 * COLOR_LIMIT)  # the Huber loss of an error of colour alone
        target = Target(
            camera=view.camera,
            rgb8=view.rgb8,
            depth=view.depth,
            T_cam_world=posed.T_cam_world,
            color_weight=config.color_weight,
            depth_weight=config.depth_weight,
            enough=enough,
        )
        self._rasterizer.fit(gaussians, moments, rates, target)


def _final_rates(config: MappingConfig, done: float) -> Rates:
    fade = FINAL_LAST + (FINAL_FIRST - FINAL_LAST) * 0.5 * (1 + math.cos(math.pi * done))
    usual = rates(config)
    return Rates(
        means=FINAL_MEANS * fade * usual.means,
        log_scales=FINAL_SCALES * fade * usual.log_scales,
        logit_opacities=fade * usual.logit_opacities,
        rgb=FINAL_COLORS * fade * usual.rgb,
        rotations=fade * usual.rotations,
    )
