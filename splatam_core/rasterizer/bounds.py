"""Bounds of blocks of Gaussians, by which a rasterizer skips blocks out of view."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from splatam_core.images.filters import is_on_host

BLOCK = 1024


def block_bounds(means: Tensor, log_scales: Tensor) -> Tensor:
    """Returns [ceil(N / BLOCK), 7] as ``Gaussians.bounds``, of at least one Gaussian."""
    widest = log_scales.amax(dim=1, keepdim=True)
    return _by_numpy(means, widest) if is_on_host(means) else _by_torch(means, widest)


def _by_numpy(means: Tensor, log_scales: Tensor) -> Tensor:
    """Takes a fifth of the time that torch takes on a CPU."""
    starts = np.arange(0, len(means), BLOCK)
    centres, scales = means.numpy(), log_scales.numpy()
    least, most = np.fmin.reduceat(centres, starts), np.fmax.reduceat(centres, starts)  # ignores NaN
    return torch.from_numpy(np.concatenate([least, most, np.fmax.reduceat(scales, starts)], axis=1))


def _by_torch(means: Tensor, log_scales: Tensor) -> Tensor:
    padding = -len(means) % BLOCK  # copies of the last Gaussian, which change no bound
    centres, scales = (torch.cat([v, v[-1:].expand(padding, -1)]) for v in (means, log_scales))
    centres = centres.view(-1, BLOCK, 3)
    return torch.cat([centres.amin(dim=1), centres.amax(dim=1), scales.view(-1, BLOCK, 1).amax(dim=1)], dim=1)
