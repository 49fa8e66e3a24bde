"""SplaTAM (Keetha et al., CVPR 2024): splat, track and map, one frame at a time."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from splatam_core.config import SlamConfig
from splatam_core.device import choose_backend, pose_tensor
from splatam_core.errors import ConfigError, FrameError, SplatamError
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.images.view import View
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.mapping.mapper import Mapper
from splatam_core.rasterizer import Gaussians, make_rasterizer
from splatam_core.state import SlamState
from splatam_core.stopwatch import Stopwatch
from splatam_core.tracking import make_tracker
from splatam_core.tracking.motion import MotionModel, MotionPrior
from splatam_core.types import FrameResult, MapSnapshot, RenderedView, RgbdFrame, Status

Matrix = NDArray[np.float64]


class Slam:
    """The algorithm, synchronous and without threads of its own.

    Attributes:
        config: all settings.
        backend: where it is computed.
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
        self._mapper = self._new_mapper()
        self._motion = self._motion_model()
        self.camera: PinholeCamera | None = None
        self._num_frames = 0
        self._last_stamp_ns: int | None = None

    @property
    def map(self) -> GaussianMap:
        """The Gaussians, on the backend's device."""
        return self._mapper.map

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
        clock = Stopwatch(self.backend.device)
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
                                tracking.visible_fraction, tracking.inlier_fraction)  # fmt: skip

        T_world_cam = se3.inverse(tracking.T_cam_world)
        # Depth sets the pace: a colour frame that comes late, or twice, says little about how the camera moves.
        self._motion.observe(frame.stamp_ns, se3.inverse(tracking.T_cam_world_depth))
        is_keyframe = self._mapper.add(index, kept, view, tracking.T_cam_world, tracking.visible_fraction, clock)
        return self._result(index, frame, Status.TRACKED, T_world_cam, is_keyframe, clock, '',
                            tracking.visible_fraction, tracking.inlier_fraction)  # fmt: skip

    def configure(self, config: SlamConfig) -> None:
        """Use other settings from the next frame on; seed, threads, device, rasterizer and motion model stay as they are.

        Raises:
            ConfigError: the true poses are asked for, and are not there.
        """
        check_truth(config, self._true_motion)
        self.config = config
        self._mapper.use(config)
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
            self.config, self.camera, self.map.arrays(), tuple(self._mapper.keyframes), self._motion.state(),
            dict(self._mapper.rng.bit_generator.state), self._mapper.scene_radius, self._num_frames, self._last_stamp_ns,
        )  # fmt: skip

    def restore(self, state: SlamState) -> None:
        """Go on where another Slam of the same configuration was.

        Raises:
            ValueError: the state is not one of this configuration's.
        """
        self.reset()
        self._mapper.restore(state.map, state.keyframes, state.rng, state.scene_radius)
        self._motion.restore(state.motion)
        self.camera = state.camera
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

    def finish(self, limit_s: float = math.inf, stop: Callable[[], bool] = lambda: False) -> int:
        """Fit the map to all keyframes once more, after the last frame (``mapping.final_passes``; 0 leaves all as it is).

        Args:
            limit_s: seconds it may take.
            stop: asked before each step; where it says so, this was the last.

        Returns:
            How many steps it took.
        """
        return self._mapper.finish(limit_s, stop)

    def snapshot(self) -> MapSnapshot:
        """A copy of the map."""
        return self.map.snapshot()

    def _check(self, frame: RgbdFrame) -> None:
        if self.camera is not None and frame.camera != self.camera:
            raise FrameError(f'the camera changed from {self.camera} to {frame.camera}; reset to start a new map')
        if self._last_stamp_ns is not None and frame.stamp_ns <= self._last_stamp_ns:
            raise FrameError(
                f'frame stamp {frame.stamp_ns} ns is not after the last one, {self._last_stamp_ns} ns; reset to go back in time'
            )
        self.camera = frame.camera

    def _initialize(self, index: int, frame: RgbdFrame, kept: View, view: View, clock: Stopwatch) -> FrameResult:
        reason = self._why_not_to_start(index, view)
        if not reason:
            self._mapper = self._new_mapper()
            self._mapper.add(0, kept, view, np.eye(4), 0.0, clock)
            if self.num_gaussians == 0:
                reason = 'no reading lies where Gaussians would be added (densification.scale)'
        if reason:
            reason = f'the map cannot start: {reason}'
            return self._result(index, frame, Status.LOST, None, False, clock, reason, 0.0, 0.0)
        self._motion.observe(frame.stamp_ns, np.eye(4))
        return self._result(index, frame, Status.INITIALIZED, np.eye(4), True, clock, '', 1.0, 1.0)

    def _why_not_to_start(self, index: int, view: View) -> str:
        if not self.config.mapping.enabled:
            return 'mapping.enabled is off'
        if self.config.mapping.is_held_out(index):
            return 'this frame is held out of it (mapping.hold_out)'
        return '' if view.valid.any() else 'no pixel has a usable depth reading'

    def _new_mapper(self) -> Mapper:
        return Mapper(self.config, self._rasterizer, self.backend.device, self._all_frames)

    def _motion_model(self) -> MotionModel:
        if self.config.tracking.method == 'truth':
            return MotionModel(False, self._true_motion)
        return MotionModel(self.config.tracking.motion_model == 'constant_velocity', self._motion_prior)

    def _result(
        self, index: int, frame: RgbdFrame, status: Status, T_world_cam: Matrix | None, is_keyframe: bool,
        clock: Stopwatch, reason: str, visible_fraction: float, inlier_fraction: float,
    ) -> FrameResult:  # fmt: skip
        return FrameResult(
            index, frame.stamp_ns, status, T_world_cam, is_keyframe, self.num_gaussians,
            visible_fraction, inlier_fraction, reason, clock.timings(),
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
