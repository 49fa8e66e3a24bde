"""The paper's optimizer: Adam through autograd, restarted on every mapped frame (section 3.4)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from splatam_core.config import MappingConfig
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.mapping.loss import mapping_loss
from splatam_core.mapping.optimizers.base import TimeLimit, drop_unusable, prune, rates
from splatam_core.mapping.posed import PosedView
from splatam_core.rasterizer import Rasterizer


class PaperOptimizer:
    """Renders, compares by L1 and SSIM, and steps along autograd's gradients."""

    def __init__(self, rasterizer: Rasterizer, config: MappingConfig) -> None:
        self._rasterizer, self._config = rasterizer, config

    def fit(self, gaussian_map: GaussianMap, views: Iterable[PosedView], scene_radius: float) -> None:
        """See ``MapOptimizer.fit``."""
        gaussian_map.start_optimization(rates(self._config))
        for step, posed in enumerate(views):
            render = self._rasterizer.render(gaussian_map.gaussians, posed.view.camera, posed.T_cam_world)
            mapping_loss(render, posed.view, self._config).backward()
            if self._prunes(step):
                prune(gaussian_map, self._config, scene_radius)
            gaussian_map.step()
        gaussian_map.stop_optimization()
        drop_unusable(gaussian_map)

    def finish(
        self, gaussian_map: GaussianMap, keyframes: Sequence[PosedView], rng: np.random.Generator, limit: TimeLimit, *,
        is_corrected: bool,
    ) -> int:  # fmt: skip
        """Leaves the map as it is, as in the paper; ``splatam refine`` optimizes a finished map."""
        return 0

    def _prunes(self, step: int) -> bool:
        every, until = self._config.paper.prune_every, self._config.paper.prune_until
        return every > 0 and step <= until and step % every == 0
