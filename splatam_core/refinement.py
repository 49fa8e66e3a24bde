"""Offline optimisation of a finished map: every frame again and again, poses fixed, step sizes fading.

The original's ``post_splatam_opt.py`` does the same, with the same losses as in mapping.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict

import numpy as np
import torch
from numpy.typing import NDArray

from splatam_core import se3
from splatam_core.config import SlamConfig
from splatam_core.datasets.base import Sequence, frame_or_none
from splatam_core.errors import RunFolderError
from splatam_core.gaussian_map import GaussianMap
from splatam_core.keyframes import PosedView
from splatam_core.losses import mapping_loss
from splatam_core.mapping import prunable, rates
from splatam_core.rasterizer import Gaussians, Rasterizer, Rates
from splatam_core.view import View

LAST_RATE = 0.01
"""Of the step sizes at the end, relative to the beginning."""

PRUNE_EVERY = 500


def refine_map(
    gaussians: Gaussians,
    sequence: Sequence,
    poses: Mapping[int, NDArray[np.float64]],
    rasterizer: Rasterizer,
    config: SlamConfig,
    iterations: int,
    progress: Callable[[range], Iterable[int]],
) -> Gaussians:
    """Fit a map to the frames of a run.

    Args:
        gaussians: the map; stays as it is.
        sequence: where the frames are; each is read when its turn comes, so that memory does not grow.
        poses: T_world_cam of the frames to fit, by stamp.
        rasterizer: draws the map.
        config: the run's; weights, rates and pruning are those of its mapping.
        iterations: steps, one frame each.
        progress: wraps the loop over the steps.

    Raises:
        RunFolderError: none of the poses is that of a frame.
    """
    gaussian_map = GaussianMap(gaussians.rotations is not None)
    gaussian_map.append(gaussians.detached())
    views = _endless(sequence, poses, config)
    first = next(views)
    scene_radius = float(first.view.depth.max()) / config.mapping.scene_radius_ratio
    gaussian_map.start_optimization(rates(config.mapping))
    for step in progress(range(iterations)):
        posed, weights = next(views), config.mapping
        gaussian_map.set_rates(_faded(rates(weights), LAST_RATE ** (step / iterations)))
        render = rasterizer.render(gaussian_map.gaussians, posed.view.camera, posed.T_cam_world)
        mapping_loss(render, posed.view, weights).backward()
        if weights.prune_every and step % PRUNE_EVERY == 0:
            gaussian_map.keep(~prunable(gaussian_map, weights.prune_opacity, weights.prune_scale * scene_radius))
        gaussian_map.step()
    gaussian_map.stop_optimization()
    return gaussian_map.gaussians.detached()


def _faded(rates: Rates, factor: float) -> Rates:
    return Rates(**{name: factor * rate for name, rate in asdict(rates).items()})


def _endless(sequence: Sequence, poses: Mapping[int, NDArray[np.float64]], config: SlamConfig) -> Iterator[PosedView]:
    """All frames in random order, then all in another, and so on."""
    rng, indices = np.random.default_rng(config.seed), np.arange(len(sequence))
    while len(indices):
        usable = []
        for index in rng.permutation(indices):
            frame = frame_or_none(sequence, int(index))
            if frame is not None and frame.stamp_ns in poses:
                usable.append(index)
                T_cam_world = torch.from_numpy(se3.inverse(poses[frame.stamp_ns])).float()
                yield PosedView(View.from_frame(frame, config.depth), T_cam_world)
        indices = np.sort(np.array(usable, dtype=np.intp))  # the others need not be read again
    raise RunFolderError(f'none of the {len(poses)} frames to refine with is in {sequence.name}')
