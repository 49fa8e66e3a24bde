"""SplaTAM (Keetha et al., CVPR 2024): splat, track and map, one frame at a time."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from splatam_core import se3
from splatam_core.backend import choose_backend, finish, pose_tensor
from splatam_core.camera import PinholeCamera
from splatam_core.checkpoints import SlamState
from splatam_core.config import SlamConfig
from splatam_core.densification import densify
from splatam_core.errors import ConfigError, FrameError, SplatamError
from splatam_core.gaussian_map import GaussianMap
from splatam_core.keyframes import KeyframeStore, PosedView, is_due, select_keyframes
from splatam_core.mapping import refine, refit
from splatam_core.motion import MotionModel, MotionPrior
from splatam_core.rasterizer import Gaussians, make_rasterizer
from splatam_core.tracking import make_tracker
from splatam_core.types import FrameResult, MapSnapshot, RenderedView, RgbdFrame, StageTimings, Status
from splatam_core.view import View

Matrix = NDArray[np.float64]


class Slam:
    """The algorithm, synchronous and without threads of its own.

    Attributes:
        config: all settings.
        backend: where it is computed.
        map: the Gaussians, there.
        camera: of the frames; None before the first.
    """

    def __init__(
        self, config: SlamConfig, motion_prior: MotionPrior | None = None, *,
        true_motion: MotionPrior | None = None, num_frames: int | None = None,
    ) -> None:  # fmt: skip
        """Begin with an empty map.

        Args:
            config: all settings.
            motion_prior: how another sensor saw the camera move.
            true_motion: how the camera truly moved, for ``tracking.method: truth``; known for every frame.
            num_frames: how many frames will come, where that is known.

        Raises:
            ConfigError: the true poses are asked for, or a device or rasterizer, and are not there.
        """
        check_truth(config, true_motion)
        self.config = config
        self.backend = choose_backend(config)
        self._motion_prior, self._true_motion, self._all_frames = motion_prior, true_motion, num_frames
        self._rasterizer = make_rasterizer(self.backend.rasterizer, config.threads)
        self._tracker = make_tracker(self._rasterizer, config.tracking, config.threads, self.backend.device)
        self.reset()

    def reset(self) -> None:
        """Forget map, poses and camera; the next frame starts a new world."""
        self.map = GaussianMap(self.config.mapping.anisotropic, self.backend.device)
        self.camera: PinholeCamera | None = None
        self._keyframes = KeyframeStore(self.backend.device, self.config.keyframes.on_device)
        self._motion = self._motion_model()
        self._rng = np.random.default_rng(self.config.seed)
        self._scene_radius = 0.0
        self._num_frames = 0
        self._last_stamp_ns: int | None = None

    @property
    def num_gaussians(self) -> int:
        """Size of the map."""
        return len(self.map)

    def process(self, frame: RgbdFrame) -> FrameResult:
        """Find where a frame was taken from, and teach the map what it shows.

        Raises:
            FrameError: the frame is of another camera than the first, or not later than the last.
        """
        self._check(frame)
        clock = _Stopwatch(self.backend.device)
        index, self._num_frames, self._last_stamp_ns = self._num_frames, self._num_frames + 1, frame.stamp_ns
        kept = View.from_frame(frame, self.config.depth)
        view = kept.to(self.backend.device)
        if self.num_gaussians == 0:
            return self._initialize(index, frame, kept, view, clock)

        guess = se3.inverse(self._motion.predict(frame.stamp_ns))
        before = se3.inverse(self._motion.last_pose)
        view_to_track = view.scaled(self.config.tracking.scale)
        tracking = self._tracker.track(view_to_track, self.map.gaussians, guess, before)
        clock.lap('track')
        if tracking.failure:
            self._motion.stop()
            return self._result(index, frame, Status.LOST, None, False, clock, tracking.failure,
                                tracking.sure_fraction, tracking.inlier_fraction)  # fmt: skip

        T_world_cam = se3.inverse(tracking.T_cam_world)
        # Depth sets the pace: a colour frame that comes late, or twice, says little about how the camera moves.
        self._motion.observe(frame.stamp_ns, se3.inverse(tracking.T_cam_world_depth))
        is_keyframe = self._map(index, kept, view, tracking.T_cam_world, tracking.sure_fraction, clock)
        return self._result(index, frame, Status.TRACKED, T_world_cam, is_keyframe, clock, '',
                            tracking.sure_fraction, tracking.inlier_fraction)  # fmt: skip

    def configure(self, config: SlamConfig) -> None:
        """Use other settings from the next frame on; seed, threads, device, rasterizer and motion model stay as they are.

        Raises:
            ConfigError: the true poses are asked for, and are not there.
        """
        check_truth(config, self._true_motion)
        self.config = config
        self._keyframes.limit = config.keyframes.on_device
        self._tracker = make_tracker(self._rasterizer, config.tracking, config.threads, self.backend.device)

    def load(self, gaussians: Gaussians, T_world_cam: Matrix) -> None:
        """Go on in a map made earlier.

        Args:
            gaussians: the map.
            T_world_cam: [4, 4] about where the camera is in it.

        Raises:
            ConfigError: they are anisotropic, and the configuration is not.
        """
        if gaussians.rotations is not None and not self.config.mapping.anisotropic:
            raise ConfigError('the map is of anisotropic Gaussians: set mapping.anisotropic=true')
        self.reset()
        self.map.append(gaussians)
        self._motion.place(T_world_cam)

    def state(self) -> SlamState:
        """All that the frames to come depend on; ``restore`` goes on from it, bit for bit."""
        return SlamState(
            self.config, self.camera, self.map.arrays(), tuple(self._keyframes), self._motion.state(),
            dict(self._rng.bit_generator.state), self._scene_radius, self._num_frames, self._last_stamp_ns,
        )  # fmt: skip

    def restore(self, state: SlamState) -> None:
        """Go on where another Slam of the same configuration was.

        Raises:
            ValueError: the state is not one of this configuration's.
        """
        self.reset()
        self.map.restore(state.map)
        self._motion.restore(state.motion)
        self._rng.bit_generator.state = state.rng
        for keyframe in state.keyframes:
            self._keyframes.append(keyframe)
        self.camera, self._scene_radius = state.camera, state.scene_radius
        self._num_frames, self._last_stamp_ns = state.num_frames, state.last_stamp_ns

    def rest(self) -> None:
        """Take the camera to be where it was last, at rest; the next frame may have any stamp."""
        self._motion.place(self._motion.last_pose)
        self._last_stamp_ns = None

    def render(self, T_world_cam: Matrix) -> RenderedView:
        """What the map looks like from a pose, through the frames' camera.

        Raises:
            SplatamError: no frame has been processed yet.
        """
        if self.camera is None:
            raise SplatamError('nothing can be rendered before the first frame: the camera is not known')
        T_cam_world = pose_tensor(se3.inverse(T_world_cam), self.backend.device)
        with torch.no_grad():
            return self._rasterizer.render(self.map.gaussians.detached(), self.camera, T_cam_world).images()

    def finish(self, limit_s: float = math.inf) -> int:
        """Fit the map to all keyframes once more, after the last frame (``mapping.final_passes``; 0 leaves all as it is).

        Args:
            limit_s: seconds it may take.

        Returns:
            How many steps it took.
        """
        if not self.config.mapping.enabled:
            return 0
        keyframes = self._keyframes.window(self._keyframes)
        return refit(self.map, keyframes, self._rasterizer, self.config.mapping, self._rng, limit_s)

    def snapshot(self) -> MapSnapshot:
        """A copy of the map."""
        return self.map.snapshot()

    def _check(self, frame: RgbdFrame) -> None:
        if self.camera is not None and frame.camera != self.camera:
            raise FrameError(f'the camera changed from {self.camera} to {frame.camera}; reset to start a new map')
        if self._last_stamp_ns is not None and frame.stamp_ns <= self._last_stamp_ns:
            raise FrameError(
                f'frame stamp {frame.stamp_ns} ns is not after the last one, {self._last_stamp_ns} ns; '
                'reset to go back in time'
            )
        self.camera = frame.camera

    def _initialize(self, index: int, frame: RgbdFrame, kept: View, view: View, clock: _Stopwatch) -> FrameResult:
        if reason := self._why_not_to_start(index, view):
            reason = f'the map cannot start: {reason}'
            return self._result(index, frame, Status.LOST, None, False, clock, reason, 0.0, 0.0)
        self._motion.observe(frame.stamp_ns, np.eye(4))
        self._map(0, kept, view, np.eye(4), 0.0, clock)
        return self._result(index, frame, Status.INITIALIZED, np.eye(4), True, clock, '', 1.0, 1.0)

    def _why_not_to_start(self, index: int, view: View) -> str:
        if not self.config.mapping.enabled:
            return 'mapping.enabled is off'
        if self.config.mapping.is_held_out(index):
            return 'this frame is held out of it (mapping.hold_out)'
        return '' if view.valid.any() else 'no pixel has a usable depth reading'

    def _map(
        self, index: int, kept: View, view: View, T_cam_world: Matrix, sure_fraction: float, clock: _Stopwatch
    ) -> bool:
        """Densify, choose a window, refine; keep the view that was fitted, on the host, if it is due. Whether it was."""
        config = self.config
        if not config.mapping.enabled or config.mapping.is_held_out(index):
            return False
        index -= config.mapping.num_held_out(index)  # what is held out leaves the rhythm of the others as it is
        self._scene_radius = self._scene_radius or float(kept.depth.max()) / config.mapping.scene_radius_ratio
        current = _posed(view, T_cam_world)
        keyframe = _posed(kept.narrowed(config.mapping.scale, config.mapping.max_width), T_cam_world)
        to_fit = current if keyframe.view is kept else keyframe.to(self.backend.device)
        mapped, every = divmod(index, config.mapping.every)
        if every == 0:
            if mapped % config.densification.every == 0 or sure_fraction < config.densification.when_unsure:
                self.map.append(
                    densify(self.map.gaussians, current.view, current.T_cam_world, self._rasterizer, config.densification)
                )
                clock.lap('densify')
            chosen = select_keyframes(_posed(kept, T_cam_world), self._keyframes, config.keyframes, self._rng)
            window = self._keyframes.window([*chosen, to_fit])
            clock.lap('keyframes')
            more = config.mapping.first_iterations if index == 0 else 0
            refine(self.map, window, self._rasterizer, config, self._scene_radius, self._rng, more)
            clock.lap('map')
        is_keyframe = is_due(index, config.keyframes, self._all_frames)
        if is_keyframe:
            without_cached = PosedView(replace(keyframe.view), keyframe.T_cam_world)
            self._keyframes.append(without_cached, to_fit)
        return is_keyframe

    def _motion_model(self) -> MotionModel:
        if self.config.tracking.method == 'truth':
            return MotionModel(False, self._true_motion)
        return MotionModel(self.config.tracking.motion_model == 'constant_velocity', self._motion_prior)

    def _result(
        self, index: int, frame: RgbdFrame, status: Status, T_world_cam: Matrix | None, is_keyframe: bool,
        clock: _Stopwatch, reason: str, sure_fraction: float, inlier_fraction: float,
    ) -> FrameResult:  # fmt: skip
        return FrameResult(
            index, frame.stamp_ns, status, T_world_cam, is_keyframe, self.num_gaussians,
            sure_fraction, inlier_fraction, reason, clock.timings(),
        )  # fmt: skip


def check_truth(config: SlamConfig, true_motion: MotionPrior | None) -> None:
    """Make sure that true poses are there where they are asked for.

    Raises:
        ConfigError: they are not.
    """
    if config.tracking.method == 'truth' and true_motion is None:
        raise ConfigError(
            "tracking.method = truth: there are no true poses here; only 'splatam run' on a recording that has them takes it. "
            'Choose render_and_compare or align'
        )


def _posed(view: View, T_cam_world: Matrix) -> PosedView:
    return PosedView(view, pose_tensor(T_cam_world, view.depth.device))


@dataclass(slots=True)
class _Stopwatch:
    device: torch.device
    started: float = field(default_factory=time.perf_counter)
    lapped: float = field(default_factory=time.perf_counter)
    laps: dict[str, float] = field(default_factory=dict)

    def lap(self, stage: str) -> None:
        finish(self.device)
        now = time.perf_counter()
        self.laps[stage] = 1e3 * (now - self.lapped)
        self.lapped = now

    def timings(self) -> StageTimings:
        finish(self.device)
        return StageTimings(**self.laps, total=1e3 * (time.perf_counter() - self.started))
