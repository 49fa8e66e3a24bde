"""The map and its keyframes: add what a frame shows anew, choose what to fit it with, fit."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import takewhile
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatam_core.config import SlamConfig
from splatam_core.geometry import se3
from splatam_core.images.filters import nearest
from splatam_core.images.observation import Observation
from splatam_core.images.view import View, narrowing
from splatam_core.interruption import Pressure, PressureGauge, Stop, never, no_pressure
from splatam_core.mapping.backlog import StepBacklog
from splatam_core.mapping.densification import densify
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.mapping.ghosts import moved_in
from splatam_core.mapping.keyframes import KeyframeStore, Window, select_keyframes, views_to_fit
from splatam_core.mapping.optimizers import TimeLimit, make_optimizer
from splatam_core.mapping.posed import Before, PosedFrame, PosedView
from splatam_core.mapping.schedule import MappingPlan, MappingSchedule
from splatam_core.rasterizer import Rasterizer
from splatam_core.rasterizer.base import NOT_COMPARED
from splatam_core.types import Arrays

_log = logging.getLogger(__name__)

_KEPT = 0.9
"""Fraction of the largest number of Gaussians that is kept when it is exceeded, so that few frames copy the map."""

_SEEN_BEFORE = 3  # keyframes that are asked what was free
_MAX_GROWTH = 2.0
"""A Gaussian may grow to this many times its first radius, however near the surfaces of the first frame were."""


class Mapper:
    """Changes the map: densify, select, optimize, in this order for every frame.

    Attributes:
        map: the Gaussians.
        keyframes: all keyframes.
        schedule: decides what each frame is used for.
        rng: draws every random choice.
        scene_radius: metres; 0 before the first frame.
        backlog: the optimization steps that were postponed.
    """

    def __init__(
        self, config: SlamConfig, rasterizer: Rasterizer, device: torch.device, num_frames: int | None, stop: Stop = never
    ) -> None:
        """Begins with an empty map.

        Args:
            config: every setting.
            rasterizer: draws the map.
            device: where the map is computed.
            num_frames: number of frames of the recording; None where that is unknown.
            stop: asked before each step of ``optimize``.
        """
        self.map = GaussianMap(config.mapping.anisotropic, device)
        self.keyframes = KeyframeStore(device, config.keyframes)
        self.rng = np.random.default_rng(config.seed)
        self.scene_radius = 0.0
        self.backlog = StepBacklog()
        self._owed_window: Window | None = None  # a frame is held only while steps on it are owed
        self._rasterizer, self._num_frames, self._stop = rasterizer, num_frames, stop
        self.configure(config)

    def configure(self, config: SlamConfig) -> None:
        """Uses other settings from the next frame on; the seed stays as it is."""
        self._config, self.keyframes.config = config, config.keyframes
        self.schedule = MappingSchedule(config, self._num_frames)
        self._optimizer = make_optimizer(self._rasterizer, config.mapping)
        if not (config.mapping.enabled and config.mapping.iterations):
            self.backlog.forgive()

    def still(self, frame: PosedFrame, plan: MappingPlan) -> PosedFrame:
        """Returns a frame in which nothing is compared where something moves into space that was seen to be free."""
        added = self._config.densification
        if not (plan.densifies and added.depth_noise_ratio > 0 and len(self.keyframes)):
            return frame
        view = frame.device.view.narrowed(added.scale, added.max_width)
        posed = PosedView(view, frame.device.T_cam_world)
        earlier = [self.keyframes.on_device(keyframe) for keyframe in self.keyframes[-_SEEN_BEFORE:]]
        with torch.no_grad():
            render = self._rasterizer.render(self.map.gaussians.detached(), view.camera, posed.T_cam_world)
            moving = moved_in(render, posed, earlier)
        if moving is None:
            return replace(frame, before=Before(view, render))
        _log.info('frame %d: something moves in %.0f %% of the view', frame.index, 100 * moving.float().mean())
        host = frame.observation.host
        size = host.camera.width, host.camera.height
        mask = nearest(moving.float().to(host.depth.device), *size) > 0.5
        host = replace(host, depth=torch.where(mask, NOT_COMPARED, host.depth))
        device = host.to(frame.observation.device.depth.device)
        before = Before(device.narrowed(added.scale, added.max_width), render)
        return replace(frame, observation=Observation(host, device), before=before)

    def densify(self, frame: PosedFrame, plan: MappingPlan) -> None:
        """Adds Gaussians where the frame shows what the map lacks."""
        if not plan.is_used:
            return
        self._measure_scene(frame.observation.host)
        if plan.densifies:
            self.map.frame = frame.index
            view, T_cam_world = frame.device.view, frame.device.T_cam_world
            gone = densify(self.map, view, T_cam_world, self._rasterizer, self._config.densification, frame.before)
            if len(gone):
                _log.info('frame %d sees through %d Gaussians: what they showed has gone', frame.index, len(gone))
                self.keyframes.forget(gone)
            self._limit_size(frame.device.T_cam_world)

    def _limit_size(self, T_cam_world: Tensor) -> None:
        """Drops the Gaussians farthest from the camera, if there are too many."""
        limit, size = self._config.mapping.max_gaussians, len(self.map)
        if not 0 < limit < size:
            return
        camera = -T_cam_world[:3, :3].T @ T_cam_world[:3, 3]
        distance = torch.linalg.vector_norm(self.map.means.detach() - camera, dim=1)
        num_kept = max(1, round(_KEPT * limit))
        kept = torch.zeros(size, dtype=torch.bool, device=distance.device)
        kept[torch.topk(distance, num_kept, largest=False).indices] = True
        farthest_m = float(distance[kept].max())
        self.map.keep(kept)
        _log.warning(
            'the map has reached mapping.max_gaussians = %d: the %d farthest from the camera, more than %.1f m away, are dropped',
            limit, size - num_kept, farthest_m,
        )  # fmt: skip

    def select(self, frame: PosedFrame, plan: MappingPlan) -> Window:
        """Returns the views to fit the map to, the frame last; keeps the frame as a keyframe where the plan says so."""
        if not plan.is_used or len(self.map) == 0:
            return self.keyframes.window([])
        chosen = None
        if plan.steps is not None:
            chosen = select_keyframes(frame.host, self.keyframes, self._config.keyframes, self.rng)
        if plan.is_keyframe:
            self.keyframes.append(frame.keyframe.bare(), frame.to_fit)
        return self.keyframes.window([]) if chosen is None else self.keyframes.window(chosen, frame)

    def optimize(self, window: Window, plan: MappingPlan, pressure: PressureGauge = no_pressure) -> int:
        """Fits the map to the window, one random view a step, and prunes.

        Args:
            window: the views.
            plan: says how many steps.
            pressure: asked before each step; while something waits, most steps are postponed until ``catch_up``.

        Returns:
            The number of steps that were postponed.
        """
        if plan.steps is None or not window:
            return 0
        self._fit(window, self.backlog.due(range(plan.first_step, plan.first_step + plan.steps), pressure))
        self._owed_window = window if self.backlog.owed else None
        return self.backlog.postponed

    def catch_up(self, pressure: PressureGauge) -> None:
        """Takes the steps that were postponed, on the views of the last frame that was mapped, until something waits."""
        if self.backlog.owed and self._owed_window is not None and pressure() is Pressure.NONE:
            self._fit(self._owed_window, self.backlog.overdue(pressure))

    def _fit(self, window: Window, steps: Iterable[int]) -> None:
        views = views_to_fit(window, steps, self._config, self.rng)
        self._optimizer.fit(self.map, takewhile(lambda _: not self._stop(), views), self.scene_radius)

    def retract(self, first: int) -> int:
        """Removes what the frames from a number on have added: Gaussians and keyframes. Returns the number of Gaussians.

        What those frames have moved stays where it is; the steps that follow, on other views, move it back.
        """
        self._owed_window = None
        added_before = self.map.added_by < first
        self.keyframes.drop_from(first)
        removed = len(added_before) - int(added_before.sum())
        if removed:
            self.map.keep(added_before)
        return removed

    def correct(self, motion_of: Callable[[NDArray[np.int64]], NDArray[np.float64]]) -> None:
        """Moves Gaussians and keyframes together.

        Args:
            motion_of: returns the motions [K, 4, 4] in the world of frames [K].
        """
        self._owed_window = None  # its views are where they were
        self.map.move(motion_of)
        frames = np.array([keyframe.frame for keyframe in self.keyframes], dtype=np.int64)
        T_cam_world = [keyframe.T_cam_world.double().numpy(force=True) for keyframe in self.keyframes]
        moved = np.array(T_cam_world).reshape(-1, 4, 4) @ se3.inverse(motion_of(frames))
        self.keyframes.place([torch.from_numpy(T.astype(np.float32)) for T in moved])

    def finish(self, limit: TimeLimit, *, is_corrected: bool) -> int:
        """Fits the map to all keyframes once more, after the last frame. Returns the number of steps.

        Args:
            limit: says when to stop.
            is_corrected: True if Gaussians were moved to other poses than those they were fitted at.
        """
        if not self._config.mapping.enabled:
            return 0
        window = self.keyframes.window(self.keyframes)
        return self._optimizer.finish(self.map, window, self.rng, limit, is_corrected=is_corrected)

    def restore(self, arrays: Arrays, keyframes: Iterable[PosedView], rng: dict[str, Any], scene_radius: float) -> None:
        """Continues from the state of another mapper.

        Args:
            arrays: see ``GaussianMap.arrays``.
            keyframes: all keyframes.
            rng: state of the random number generator.
            scene_radius: metres.

        Raises:
            ValueError: the arrays are not those of such a map.
        """
        self.map.restore(arrays)
        self.adopt(keyframes)
        self.rng.bit_generator.state = rng
        self.scene_radius = scene_radius

    def adopt(self, keyframes: Iterable[PosedView]) -> None:
        """Keeps the keyframes of another mapper."""
        for keyframe in keyframes:
            self.keyframes.append(keyframe.comparable() if self._config.mapping.optimizer == 'fused' else keyframe)

    def _measure_scene(self, view: View) -> None:
        """Sets the scene radius from the first frame; a later frame that sees so far that new Gaussians are too wide raises it."""
        config, deepest_m = self._config.mapping, float(view.depth.numpy().max())
        self.scene_radius = self.scene_radius or deepest_m / config.scene_radius_ratio
        if config.prune_scale > 0:
            added = self._config.densification
            focal = view.camera.fx * narrowing(view.camera.width, added.scale, added.max_width)
            self.scene_radius = max(self.scene_radius, _MAX_GROWTH * view.spacing * deepest_m / focal / config.prune_scale)
