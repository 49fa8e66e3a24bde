"""Differentiable rasterizers behind one contract (``base``)."""

from __future__ import annotations

from splatam_core.rasterizer.base import Gaussians, Moments, Rasterizer, Rates, Render, Target, joined

__all__ = ['Gaussians', 'Moments', 'Rasterizer', 'Rates', 'Render', 'Target', 'joined', 'make_rasterizer']


def make_rasterizer(name: str, threads: int = 0) -> Rasterizer:
    """A backend by its name in the configuration.

    Args:
        name: ``cpu``, ``reference`` or ``triton``.
        threads: CPU threads of ``cpu``; 0 = all cores.
    """
    return _BACKENDS[name](threads)


def _cpu(threads: int) -> Rasterizer:
    from splatam_core.rasterizer.cpu import CpuRasterizer

    return CpuRasterizer(threads)


def _reference(threads: int) -> Rasterizer:
    from splatam_core.rasterizer.reference import ReferenceRasterizer

    return ReferenceRasterizer()


def _triton(threads: int) -> Rasterizer:
    from splatam_core.rasterizer.triton import TritonRasterizer

    return TritonRasterizer()


_BACKENDS = {'cpu': _cpu, 'reference': _reference, 'triton': _triton}
