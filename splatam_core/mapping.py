"""Map refinement: Adam on the Gaussians, poses fixed, one random view of the window a step (paper, section 3.4)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from splatam_core.config import MappingConfig
from splatam_core.gaussian_map import GaussianMap
from splatam_core.keyframes import PosedView
from splatam_core.losses import mapping_loss
from splatam_core.rasterizer import Rasterizer


def refine(
    gaussian_map: GaussianMap,
    window: Sequence[PosedView],
    rasterizer: Rasterizer,
    config: MappingConfig,
    scene_radius: float,
    rng: np.random.Generator,
) -> None:
    """Fit the map to the window, pruning on the way.

    Args:
        gaussian_map: changed in place.
        window: the views to fit.
        rasterizer: draws the map.
        config: steps, weights, rates, pruning.
        scene_radius: metres; Gaussians are too wide relative to it.
        rng: draws the view of each step.
    """
    gaussian_map.start_optimization(
        {
            'means': config.means_rate,
            'log_scales': config.scale_rate,
            'logit_opacities': config.opacity_rate,
            'rgb': config.rgb_rate,
        }
    )
    for step in range(config.iterations):
        posed = window[rng.integers(len(window))]
        render = rasterizer.render(gaussian_map.gaussians, posed.view.camera, posed.T_cam_world)
        mapping_loss(render, posed.view, config.ssim_weight, config.color_weight, config.depth_weight).backward()
        if config.prune_every and step % config.prune_every == 0 and step <= config.prune_until:
            gaussian_map.keep(~prunable(gaussian_map, config, scene_radius))
        gaussian_map.step()
    gaussian_map.stop_optimization()


def prunable(gaussian_map: GaussianMap, config: MappingConfig, scene_radius: float) -> Tensor:
    """[N] Gaussians that are too faint to matter or too wide to be surface."""
    faint = torch.sigmoid(gaussian_map.logit_opacities.detach()) < config.prune_opacity
    wide = gaussian_map.log_scales.detach().amax(dim=1).exp() > config.prune_scale * scene_radius
    return faint | wide
