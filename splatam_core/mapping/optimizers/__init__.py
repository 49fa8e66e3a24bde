"""Optimizers of the map: one file each, and a line in the table below."""

from __future__ import annotations

from collections.abc import Callable

from splatam_core.config import MappingConfig
from splatam_core.mapping.optimizers.base import MapOptimizer, TimeLimit, drop_unusable, prunable, prune, rates
from splatam_core.mapping.optimizers.fused import FusedOptimizer
from splatam_core.mapping.optimizers.paper import PaperOptimizer
from splatam_core.rasterizer import Rasterizer

__all__ = [
    'FusedOptimizer', 'MapOptimizer', 'PaperOptimizer', 'TimeLimit', 'drop_unusable', 'make_optimizer', 'prunable', 'prune',
    'rates',
]  # fmt: skip

_OPTIMIZERS: dict[str, Callable[[Rasterizer, MappingConfig], MapOptimizer]] = {'paper': PaperOptimizer, 'fused': FusedOptimizer}


def make_optimizer(rasterizer: Rasterizer, config: MappingConfig) -> MapOptimizer:
    """Returns the optimizer that ``mapping.optimizer`` names."""
    return _OPTIMIZERS[config.optimizer](rasterizer, config)
