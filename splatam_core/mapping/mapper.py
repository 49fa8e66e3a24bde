"""The map's side of SLAM: add what a frame shows anew, choose what to fit it with, fit, keep a keyframe now and then."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splatam_core.config import SlamConfig
from splatam_core.device import pose_tensor
from splatam_core.images.view import View, narrowing
from splatam_core.mapping.densification import densify
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.mapping.keyframes import KeyframeStore, PosedView, is_due, select_keyframes
from splatam_core.mapping.optimizers import refine, refit
from splatam_core.rasterizer import Rasterizer
from splatam_core.stopwatch import Stopwatch
from splatam_core.types import Arrays

Matrix = NDArray[np.float64]

_GROWN = 2.0
"""Times its first radius: so wide a Gaussian may become when it is fitted, however near the first frame's surfaces were."""


class Mapper:
    """A map, and the keyframes it is fitted to.

    Attributes:
        config: all settings.
        map: the Gaussians.
        keyframes: all there are.
        rng: of all choices.
        scene_radius: metres; 0 before the first frame.
    """

    def __init__(self, config: SlamConfig, rasterizer: Rasterizer, device: torch.device, num_frames: int | None) -> None:
        """Begin with an empty map.

        Args:
            config: all settings.
            rasterizer: draws the map.
            device: where it is computed.
            num_frames: how many frames will come, where that is known.
        """
        self.config = config
        self.map = GaussianMap(config.mapping.anisotropic, device)
        self.keyframes = KeyframeStore(device, config.keyframes)
        self.rng = np.random.default_rng(config.seed)
        self.scene_radius = 0.0
        self._rasterizer, self._device, self._num_frames = rasterizer, device, num_frames

    def use(self, config: SlamConfig) -> None:
        """Other settings from the next frame on; the seed stays as it is."""
        self.config, self.keyframes.config = config, config.keyframes

    def add(self, index: int, kept: View, view: View, T_cam_world: Matrix, visible_fraction: float, clock: Stopwatch) -> bool:
        """Densify, choose a window, refine; keep the view that was fitted if it is due.

        Args:
            index: the frame's number, from 0.
            kept: the frame, in the host's memory.
            view: the same on the device.
            T_cam_world: [4, 4] where it was taken from.
            visible_fraction: fraction of its pixels with depth that see the map.
            clock: is told when a stage ends.

        Returns:
            Whether the frame became a keyframe.
        """
        config = self.config
        if not config.mapping.enabled or config.mapping.is_held_out(index):
            return False
        index -= config.mapping.num_held_out(index)  # what is held out leaves the rhythm of the others as it is
        self._measure(kept)
        current = _posed(view, T_cam_world)
        keyframe = _posed(kept.narrowed(config.mapping.scale, config.mapping.max_width), T_cam_world)
        to_fit = current if keyframe.view is kept else keyframe.to(self._device)
        mapped, every = divmod(index, config.mapping.every)
        if every == 0:
            if mapped % config.densification.every == 0 or visible_fraction < config.densification.when_unsure:
                densify(self.map, view, current.T_cam_world, self._rasterizer, config.densification)
                clock.lap('densify')
            if not len(self.map):
                return False
            chosen = select_keyframes(_posed(kept, T_cam_world), self.keyframes, config.keyframes, self.rng)
            window = self.keyframes.window([*chosen, to_fit])
            clock.lap('keyframes')
            more = config.mapping.first_iterations if index == 0 else 0
            refine(self.map, window, self._rasterizer, config, self.scene_radius, self.rng, more)
            clock.lap('map')
        is_keyframe = is_due(index, config.keyframes, self._num_frames)
        if is_keyframe:
            self.keyframes.append(keyframe.bare(), to_fit)
        return is_keyframe

    def finish(self, limit_s: float, stop: Callable[[], bool]) -> int:
        """Fit the map to all keyframes once more; see ``Slam.finish``."""
        if not self.config.mapping.enabled:
            return 0
        window = self.keyframes.window(self.keyframes)
        return refit(self.map, window, self._rasterizer, self.config.mapping, self.rng, limit_s, stop)

    def restore(self, arrays: Arrays, keyframes: Iterable[PosedView], rng: dict[str, Any], scene_radius: float) -> None:
        """Go on where another was.

        Args:
            arrays: of its map.
            keyframes: all.
            rng: state of the generator of its choices.
            scene_radius: metres.

        Raises:
            ValueError: the arrays are not of such a map.
        """
        self.map.restore(arrays)
        for keyframe in keyframes:
            self.keyframes.append(keyframe)
        self.rng.bit_generator.state = rng
        self.scene_radius = scene_radius

    def _measure(self, view: View) -> None:
        """The scene's radius, by the first frame; more where a later one sees so far that new Gaussians would be too wide."""
        config, deepest_m = self.config.mapping, float(view.depth.max())
        self.scene_radius = self.scene_radius or deepest_m / config.scene_radius_ratio
        if config.prune_scale > 0:
            added = self.config.densification
            focal = view.camera.fx * narrowing(view.camera.width, added.scale, added.max_width)
            self.scene_radius = max(self.scene_radius, _GROWN * deepest_m / focal / config.prune_scale)


def _posed(view: View, T_cam_world: Matrix) -> PosedView:
    return PosedView(view, pose_tensor(T_cam_world, view.depth.device))
