"""Bounds of runs of Gaussians, by which a rasterizer skips what is out of view."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from splatam_core.images.filters import is_on_host

BLOCK = 1024


def block_bounds(means: Tensor, log_scales: Tensor) -> Tensor:
    """[ceil(N / BLOCK), 7] as ``Gaussians.bounds``; at least one Gaussian."""
    widest = log_scales.amax(dim=1, keepdim=True)
    return _by_numpy(means, widest) if is_on_host(means) else _by_torch(means, widest)


def _by_numpy(means: Tensor, log_scales: Tensor) -> Tensor:
    """A fifth of torch's time on a processor."""
    starts = np.arange(0, len(means), BLOCK)
    places, scales = means.numpy(), log_scales.numpy()
    least, most = np.fmin.reduceat(places, starts), np.fmax.reduceat(places, starts)  # what is not a number bounds nothing
    return torch.from_numpy(np.concatenate([least, most, np.fmax.reduceat(scales, starts)], axis=1))


def _by_torch(means: Tensor, log_scales: Tensor) -> Tensor:
    filled = -len(means) % BLOCK  # with copies of the last Gaussian, which change no bound
    places, scales = (torch.cat([v, v[-1:].expand(filled, -1)]) for v in (means, log_scales))
    places = places.view(-1, BLOCK, 3)
    return torch.cat([places.amin(dim=1), places.amax(dim=1), scales.view(-1, BLOCK, 1).amax(dim=1)], dim=1)
