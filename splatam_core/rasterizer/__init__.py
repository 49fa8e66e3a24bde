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
    """Returns a backend by its name.

    Args:
        name: ``cpu``, ``reference`` or ``triton``; ``rasterizer_for`` resolves the configuration's ``auto``.
        threads: CPU threads of ``cpu``; 0 = one per core.

    Raises:
        RasterizerError: what the backend needs is not installed.
    """
    return _BACKENDS[name](threads)


def rasterizer_for(config: SlamConfig) -> tuple[Rasterizer, torch.device]:
    """Returns the rasterizer of a configuration, and the device on which maps must be.

    Raises:
        ConfigError: the device or rasterizer is not available on this machine.
        RasterizerError: what the rasterizer needs is not installed.
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
