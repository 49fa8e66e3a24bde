"""Optimizes a finished map offline: every frame many times, with fixed poses and decreasing step sizes.

The original's ``post_splatam_opt.py`` does the same with the losses of mapping, optionally with adaptive density control.
After a run with ``tracking.method: truth`` it is 3D Gaussian splatting with known poses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict

import numpy as np
from numpy.typing import NDArray

from splatam_core.config import SlamConfig
from splatam_core.datasets.base import Sequence, frame_or_none
from splatam_core.device import HOST, pose_tensor
from splatam_core.errors import RunFolderError
from splatam_core.geometry import se3
from splatam_core.images.view import View
from splatam_core.mapping.adaptive_density import ScreenSpaceGradient, clone_and_split
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.mapping.loss import mapping_loss
from splatam_core.mapping.optimizers import drop_unusable, prunable, rates
from splatam_core.mapping.posed import PosedView
from splatam_core.rasterizer import Gaussians, Rasterizer, Rates

RESET_OPACITY = 0.01
"""Opacity that the original gives all Gaussians when it resets them, as 3D Gaussian splatting does."""

LAST_RATE = 0.01
"""Step sizes at the end, relative to the beginning."""

PRUNE_EVERY = 500
DENSIFY_FROM, DENSIFY_EVERY, DENSIFY_UNTIL = 500, 100, 0.5
"""When Gaussians are added: first step, interval, and the fraction of all steps after which none is added any more."""

RESET_EVERY = 3000
"""Interval in steps at which opacities are reset, so that superfluous Gaussians stay transparent and are pruned."""


def refine_map(
    gaussians: Gaussians,
    sequence: Sequence,
    poses: Mapping[int, NDArray[np.float64]],
    rasterizer: Rasterizer,
    config: SlamConfig,
    iterations: int,
    progress: Callable[[range], Iterable[int]],
    densify: bool = False,
) -> Gaussians:
    """Fits a map to the frames of a run.

    Args:
        gaussians: the map, on the rasterizer's device; it is not changed.
        sequence: the frames; each is read when it is used, so that memory does not grow.
        poses: T_world_cam [4, 4] of the frames to fit, by stamp.
        rasterizer: draws the map.
        config: the run's settings; its mapping section gives weights, step sizes and pruning.
        iterations: number of steps, one frame each.
        progress: wraps the loop over the steps.
        densify: whether to add Gaussians in the first half of the steps.

    Raises:
        RunFolderError: no frame has a pose.
    """
    gaussian_map = GaussianMap(gaussians.rotations is not None, gaussians.means.device)
    gaussian_map.append(gaussians.detached())
    views, mapping = _endless(sequence, poses, config), config.mapping
    posed = next(views)
    scene_radius = float(posed.view.depth.max()) / mapping.scene_radius_ratio
    density = _AdaptiveDensity(gaussian_map, scene_radius, iterations, config.seed) if densify else None
    gaussian_map.start_optimization(rates(mapping))
    for step in progress(range(iterations)):
        posed = next(views).to(gaussians.means.device)
        gaussian_map.set_rates(_faded(rates(mapping), LAST_RATE ** (step / iterations)))
        render = rasterizer.render(gaussian_map.gaussians, posed.view.camera, posed.T_cam_world)
        mapping_loss(render, posed.view, mapping).backward()
        if density is not None:
            density.observe(posed)
        if mapping.paper.prune_every and step % PRUNE_EVERY == 0:
            kept = ~prunable(gaussian_map, mapping.prune_opacity, mapping.prune_scale * scene_radius)
            gaussian_map.keep(kept)
            if density is not None:
                density.gradient.keep(kept)
        gaussian_map.step()
        if density is not None:
            density.after(step)
    gaussian_map.stop_optimization()
    drop_unusable(gaussian_map)
    return gaussian_map.gaussians.detached()


class _AdaptiveDensity:
    """Adds Gaussians and resets opacities in their rhythm."""

    def __init__(self, gaussian_map: GaussianMap, scene_radius: float, iterations: int, seed: int) -> None:
        self.gradient = ScreenSpaceGradient(len(gaussian_map), gaussian_map.means.device)
        self._map, self._scene_radius, self._until = gaussian_map, scene_radius, DENSIFY_UNTIL * iterations
        self._rng = np.random.default_rng(seed)

    def observe(self, posed: PosedView) -> None:
        """Adds the gradients of a view."""
        means = self._map.means
        assert means.grad is not None
        self.gradient.observe(means.grad, means.detach(), posed.view.camera, posed.T_cam_world)

    def after(self, step: int) -> None:
        """Clones and splits, or resets opacities, where it is time to."""
        if step > self._until or step == 0:
            return
        if step >= DENSIFY_FROM and step % DENSIFY_EVERY == 0:
            clone_and_split(self._map, self.gradient.mean(), self._scene_radius, self._rng)
            self.gradient = ScreenSpaceGradient(len(self._map), self._map.means.device)
        if step % RESET_EVERY == 0:
            self._map.set_opacities(RESET_OPACITY)


def _faded(rates: Rates, factor: float) -> Rates:
    return Rates(**{name: factor * rate for name, rate in asdict(rates).items()})


def _endless(sequence: Sequence, poses: Mapping[int, NDArray[np.float64]], config: SlamConfig) -> Iterator[PosedView]:
    """Yields all frames in random order, again and again, each time in another order."""
    rng, indices = np.random.default_rng(config.seed), np.arange(len(sequence))
    while len(indices):
        usable = []
        for index in rng.permutation(indices):
            frame = frame_or_none(sequence, int(index))
            if frame is not None and frame.stamp_ns in poses:
                usable.append(index)
                T_cam_world = pose_tensor(se3.inverse(poses[frame.stamp_ns]), HOST)
                yield PosedView(View.from_frame(frame, config.depth), T_cam_world)
        indices = np.sort(np.array(usable, dtype=np.intp))  # the other frames are not read again
    raise RunFolderError(f'none of the {len(poses)} frames to refine with is in {sequence.name}')
