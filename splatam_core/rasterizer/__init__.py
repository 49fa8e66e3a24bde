"""Differentiable rasterizers behind one contract (``base``)."""

from __future__ import annotations

import torch

from splatam_core.config import SlamConfig
from splatam_core.device import choose_backend
from splatam_core.rasterizer.base import Gaussians, Moments, Rasterizer, Rates, Render, Target, joined

__all__ = [
    'Gaussians', 'Moments', 'Rasterizer', 'Rates', 'Render', 'Target', 'joined', 'make_rasterizer', 'rasterizer_for',
]  # fmt: skip


def make_rasterizer(name: str, threads: int = 0) -> Rasterizer:
    """A backend by its name.

    Args:
        name: ``cpu``, ``reference`` or ``triton``; what the configuration's ``auto`` means, ``rasterizer_for`` knows.
        threads: CPU threads of ``cpu``; 0 = all cores.
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


def _triton(threads: int) -> Rasterizer:
    from splatam_core.rasterizer.triton.rasterizer import TritonRasterizer

    return TritonRasterizer()


_BACKENDS = {'cpu': _cpu, 'reference': _reference, 'triton': _triton}
