"""What every optimizer of the map does, and what they share."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from splatam_core.config import MappingConfig
from splatam_core.images.filters import is_on_host
from splatam_core.interruption import Stop, never
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.mapping.posed import PosedView
from splatam_core.rasterizer import Rates


@dataclass(frozen=True, slots=True)
class TimeLimit:
    """When fitting after the last frame has to end.

    Attributes:
        seconds: time after which the step sizes have faded, however many steps that were.
        stop: asked before each step; no further step is taken once it returns True.
    """

    seconds: float = math.inf
    stop: Stop = never


class MapOptimizer(Protocol):
    """A way to fit the Gaussians to views whose poses are known (paper, section 3.4)."""

    def fit(self, gaussian_map: GaussianMap, views: Iterable[PosedView], scene_radius: float) -> None:
        """Takes one step for each view, and prunes.

        Args:
            gaussian_map: changed in place.
            views: the view of each step, on the map's device.
            scene_radius: metres; Gaussians are too wide relative to it.
        """
        ...

    def finish(
        self, gaussian_map: GaussianMap, keyframes: Sequence[PosedView], rng: np.random.Generator, limit: TimeLimit, *,
        is_corrected: bool,
    ) -> int:  # fmt: skip
        """Fits the map to all keyframes once more, after the last frame.

        Args:
            gaussian_map: changed in place.
            keyframes: the views to fit.
            rng: draws the order of each pass.
            limit: when to end.
            is_corrected: True if Gaussians were moved to other poses than those they were fitted at.

        Returns:
            The number of steps taken.
        """
        ...


def rates(config: MappingConfig) -> Rates:
    """Returns Adam's step sizes."""
    return Rates(
        means=config.means_rate,
        log_scales=config.scale_rate,
        logit_opacities=config.opacity_rate,
        rgb=config.rgb_rate,
        rotations=config.rotation_rate,
    )


def prune(gaussian_map: GaussianMap, config: MappingConfig, scene_radius: float, min_fraction: float | None = None) -> None:
    """Drops what ``prunable`` and ``unusable`` find.

    Args:
        gaussian_map: changed in place.
        config: says what is too faint or too wide.
        scene_radius: metres.
        min_fraction: drop only if more than this fraction of the map would go, because dropping copies the map; what is not
            finite always goes. None = always.
    """
    chosen = prunable(gaussian_map, config.prune_opacity, config.prune_scale * scene_radius)
    if (broken := unusable(gaussian_map)) is not None:
        chosen = chosen | broken
        gaussian_map.refuse(int(broken.sum()))
    if broken is not None or min_fraction is None or _count(chosen) > min_fraction * len(gaussian_map):
        gaussian_map.keep(~chosen)


def prunable(gaussian_map: GaussianMap, min_opacity: float, max_scale_m: float) -> Tensor:
    """Returns [N] which Gaussians are too faint to matter or too wide to be surface."""
    logits, widest = gaussian_map.logit_opacities.detach(), _widest(gaussian_map.log_scales.detach())
    faintest, limit = _logit(min_opacity), _log(max_scale_m)
    if is_on_host(logits):  # numpy takes a fifth of torch's time, and every frame looks at the whole map
        chosen = logits.numpy() < faintest
        chosen |= widest.numpy() > limit
        return torch.from_numpy(chosen)
    return (logits < faintest) | (widest > limit)


def drop_unusable(gaussian_map: GaussianMap) -> None:
    """Drops the Gaussians that are not ``Gaussians.usable``, and counts them."""
    if (broken := unusable(gaussian_map)) is not None:
        gaussian_map.refuse(int(broken.sum()))
        gaussian_map.keep(~broken)


def unusable(gaussian_map: GaussianMap) -> Tensor | None:
    """Returns [N] which Gaussians are not ``Gaussians.usable``; None if all are, as far as a quick look at the sums shows."""
    parts = [gaussian_map.means, gaussian_map.log_scales, gaussian_map.logit_opacities, gaussian_map.rgb]
    parts = [values.detach() for values in (*parts, gaussian_map.rotations) if values is not None]
    if is_on_host(gaussian_map.means):
        total = sum(float(values.numpy().sum()) for values in parts)  # as in `prunable`
    else:
        total = float(torch.stack([values.sum() for values in parts]).sum())
    if math.isfinite(total):
        return None
    broken = ~gaussian_map.gaussians.usable()
    return broken if broken.any() else None


def _widest(log_scales: Tensor) -> Tensor:
    return log_scales[:, 0] if log_scales.shape[1] == 1 else log_scales.amax(dim=1)  # amax would copy a single column


def _count(mask: Tensor) -> int:
    return int(np.count_nonzero(mask.numpy()) if is_on_host(mask) else torch.count_nonzero(mask))


def _logit(p: float) -> float:
    return _log(p) - _log(1 - p)


def _log(x: float) -> float:
    return math.log(x) if x > 0 else -math.inf
