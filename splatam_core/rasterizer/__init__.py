"""Differentiable rasterizers behind one contract (``base``)."""

from __future__ import annotations

import torch

from splatam_core.backend import choose_backend
from splatam_core.config import SlamConfig
from splatam_core.rasterizer.base import Gaussians, Moments, Rasterizer, Rates, Render, Target, joined

__all__ = [
    'Gaussians', 'Moments', 'Rasterizer', 'Rates', 'Render', 'Target', 'joined', 'make_rasterizer', 'rasterizer_for',
]  # fmt: skip


def make_rasterizer(name: str, threads: int = 0) -> Rasterizer:
    """A backend by its name.

    Args:
        name: as in the configuration, but not ``auto``.
        threads: CPU threads; 0 = all cores.
    """
    return _BACKENDS[name](threads)


def rasterizer_for(config: SlamConfig) -> tuple[Rasterizer, torch.device]:
    """What draws maps by a configuration, and where they have to be.

    Raises:
        ConfigError: it asks for what is not there.
    """
    backend = choose_backend(config)
    return make_rasterizer(backend.rasterizer, config.threads), backend.device


def _cpu(threads: int) -> Rasterizer:
    from splatam_core.rasterizer.cpu import CpuRasterizer

    return CpuRasterizer(threads)


def _reference(threads: int) -> Rasterizer:
    from splatam_core.rasterizer.reference import ReferenceRasterizer

    return ReferenceRasterizer()


_BACKENDS = {'cpu': _cpu, 'reference': _reference}
