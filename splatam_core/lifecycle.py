"""Everything about ``Slam`` but the algorithm: start, reset, settings, state, loading, rendering, the end."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splatam_core.config import SlamConfig
from splatam_core.device import HOST, choose_backend, pose_tensor
from splatam_core.errors import ConfigError, FrameError, RasterizerError, SplatamError
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.graph.corrections import Corrections
from splatam_core.graph.keyframe_graph import KeyframeGraph, TrackedFrame
from splatam_core.graph.places import Places, shows_a_place
from splatam_core.graph.relocalisation import Relocaliser, RelocaliserState, Sight
from splatam_core.images.observation import Observation
from splatam_core.images.spacing import describe_spacing
from splatam_core.images.view import View
from splatam_core.interruption import PressureGauge, Stop, never
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.mapping.mapper import Mapper
from splatam_core.mapping.optimizers.base import TimeLimit
from splatam_core.mapping.posed import PosedFrame, PosedView
from splatam_core.rasterizer import Gaussians, make_rasterizer
from splatam_core.state import NO_KEYFRAMES, SavedKeyframes, SlamState
from splatam_core.stopwatch import Stopwatch
from splatam_core.tracking import Tracker, TrackingResult, make_tracker
from splatam_core.tracking.aligner import Aligner
from splatam_core.tracking.alignment import make_aligner
from splatam_core.tracking.evidence import Evidence
from splatam_core.tracking.motion import MotionModel, MotionPrior, Prediction
from splatam_core.tracking.verdict import Judge, Verdict, is_weak
from splatam_core.types import FrameResult, MapSnapshot, RenderedView, RgbdFrame, Status

Matrix = NDArray[np.float64]
_log = logging.getLogger(__name__)

_APART_M = 30.0  # from an old map to a new one: more than any camera sees


@dataclass(frozen=True, slots=True, eq=False)
class CurrentFrame:
    """The frame that is being processed.

    Attributes:
        index: its number among those processed, from 0.
        frame: its images.
        clock: measures its stages.
        T_world_odom: [4, 4] see ``FrameResult``.
    """

    index: int
    frame: RgbdFrame
    clock: Stopwatch
    T_world_odom: Matrix

    def result(
        self, verdict: Verdict, T_world_cam: Matrix | None, slam: SlamLifecycle, *,
        tracking: TrackingResult | None = None, is_keyframe: bool = False, is_relocalised: bool = False,
        postponed_steps: int = 0,
    ) -> FrameResult:  # fmt: skip
        """Returns the result of this frame."""
        is_first = verdict.status is Status.INITIALIZED
        return FrameResult(
            index=self.index,
            stamp_ns=self.frame.stamp_ns,
            status=verdict.status,
            T_world_cam=T_world_cam,
            is_keyframe=is_keyframe,
            num_gaussians=slam.num_gaussians,
            visible_fraction=float(is_first) if tracking is None else tracking.visible_fraction,
            inlier_fraction=float(is_first) if tracking is None else tracking.inlier_fraction,
            reason=verdict.reason,
            timings=self.clock.timings(),
            covariance=verdict.covariance,
            num_held=verdict.num_held,
            is_relocalised=is_relocalised,
            T_world_odom=self.T_world_odom,
            postponed_steps=postponed_steps,
        )


class SlamLifecycle:
    """What surrounds the algorithm. Synchronous, without threads of its own.

    Attributes:
        config: every setting.
        backend: where SLAM is computed.
        camera: camera of the frames; None before the first.
        graph: of the keyframes.
    """

    def __init__(
        self, config: SlamConfig, motion_prior: MotionPrior | None = None, *,
        true_motion: MotionPrior | None = None, num_frames: int | None = None, stop: Stop = never,
    ) -> None:  # fmt: skip
        """Begins with an empty map.

        Args:
            config: every setting.
            motion_prior: the camera's motion as another sensor measured it.
            true_motion: the camera's true motion, for ``tracking.method: truth``; known for every frame.
            num_frames: number of frames of the recording; None where that is unknown.
            stop: asked before each step of a frame. Once it returns True, tracking gives the frame up with a FrameError, and
                mapping takes no further step.

        Raises:
            ConfigError: the configuration asks for ground truth, a device or a rasterizer that is not there.
        """
        check_truth(config, true_motion)
        self.config = config
        self.backend = choose_backend(config)
        self._motion_prior, self._true_motion, self._recording_length = motion_prior, true_motion, num_frames
        self._stop = stop
        self._rasterizer = make_rasterizer(self.backend.rasterizer, config.threads)
        self._tracker = self._new_tracker()
        self._told_spacing = False
        self.reset()

    def reset(self) -> None:
        """Forgets map, poses and camera; the next frame starts a new world."""
        self._mapper = self._new_mapper()
        self._motion = self._new_motion_model()
        self._judge = Judge()
        self._relocaliser = Relocaliser(Places())
        self.graph = self._new_graph()
        self._last_seen: Observation | None = None
        self.camera: PinholeCamera | None = None
        self._num_frames = 0
        self._last_stamp_ns: int | None = None

    @property
    def map(self) -> GaussianMap:
        """The Gaussians, on the backend's device."""
        return self._mapper.map

    @property
    def keyframes(self) -> Sequence[PosedView]:
        """All keyframes, in the host's memory."""
        return tuple(self._mapper.keyframes)

    @property
    def places(self) -> Places:
        """The keyframes as places at which a lost camera is looked for."""
        return self._relocaliser.places

    @property
    def _knows_places(self) -> bool:
        return self.config.tracking.relocalises or self.graph.is_used

    @property
    def num_gaussians(self) -> int:
        """Size of the map."""
        return len(self.map)

    def configure(self, config: SlamConfig) -> None:
        """Uses other settings from the next frame on; seed, threads, device, rasterizer and motion model stay as they are.

        Raises:
            ConfigError: the configuration asks for ground truth that is not there.
        """
        check_truth(config, self._true_motion)
        self.config = config
        self._mapper.configure(config)
        self.graph.configure(config, self._new_graph_aligner() if self.graph.lacks_aligner else None)
        self._tracker = self._new_tracker()

    def load(self, gaussians: Gaussians, T_world_cam: Matrix | None, saved: SavedKeyframes = NO_KEYFRAMES) -> None:
        """Continues in a map made earlier.

        Args:
            gaussians: the map.
            T_world_cam: [4, 4] approximate pose of the camera in it; None = it is looked for by the keyframes.
            saved: the keyframes of the map, with negative numbers.

        Raises:
            ConfigError: as ``check_map``, or there is neither a pose nor a way to find it; nothing has changed.
        """
        self.check_map(gaussians)
        if T_world_cam is None and not (saved.keyframes and self.config.tracking.relocalises):
            raise ConfigError(
                'the camera cannot be found in the map without keyframes and tracking.align.relocalisation.enabled: state its pose'
            )
        mapper = self._new_mapper()
        mapper.map.append(replace(gaussians, anchors=None))  # of frames of another run
        mapper.adopt(saved.keyframes)
        self.reset()
        self._mapper = mapper
        self.graph.load(self.keyframes)
        self._motion.place(np.eye(4) if T_world_cam is None else T_world_cam)
        self._relocaliser.state = RelocaliserState(is_anywhere=T_world_cam is None)
        if self._knows_places:
            self.places.restore(saved.places)
            self.places.follow(self._mapper.keyframes)  # those within the budget

    def suggest(self, T_world_cam: Matrix) -> None:
        """Tries a pose [4, 4] that a person gave, on the next frame; the log says if the camera is not there."""
        self._relocaliser.tell(T_world_cam)

    def check_map(self, gaussians: Gaussians) -> None:
        """Checks that a map made earlier can be loaded.

        Raises:
            ConfigError: the map is empty, or it is anisotropic and the configuration is not.
        """
        if len(gaussians) == 0:
            raise ConfigError('the map has no Gaussians, so no camera can be found in it')
        if gaussians.rotations is not None and not self.config.mapping.anisotropic:
            raise ConfigError('the map has anisotropic Gaussians: set mapping.anisotropic=true')

    def state(self) -> SlamState:
        """Returns everything that later frames depend on; ``restore`` continues from it bit for bit."""
        return SlamState(
            config=self.config,
            camera=self.camera,
            map=self.map.arrays(),
            keyframes=tuple(self.keyframes),
            motion=self._motion.state(),
            judge=self._judge.state,
            relocaliser=self._relocaliser.state,
            places=self.places.arrays() if self._knows_places else {},
            graph=self.graph.arrays(),
            rng=dict(self._mapper.rng.bit_generator.state),
            scene_radius=self._mapper.scene_radius,
            num_frames=self._num_frames,
            last_stamp_ns=self._last_stamp_ns,
            last_view=None if self._last_seen is None else replace(self._last_seen.host),
        )

    def restore(self, state: SlamState) -> None:
        """Continues from the state of another Slam with the same configuration.

        Raises:
            ValueError: the state does not fit this configuration.
        """
        self.reset()
        self._mapper.restore(state.map, state.keyframes, state.rng, state.scene_radius)
        self._motion.restore(state.motion)
        self._judge.state = state.judge
        self._relocaliser.state = state.relocaliser
        self.graph.restore(state.graph)
        if self._knows_places:
            if state.places:
                self.places.restore(state.places)
            self.places.follow(self._mapper.keyframes)
        self.camera = state.camera
        last = state.last_view
        self._last_seen = None if last is None else Observation(last, last.to(self.backend.device))
        self._num_frames, self._last_stamp_ns = state.num_frames, state.last_stamp_ns

    def rest(self, *, is_new_time: bool = False) -> None:
        """Assumes that the camera is at its last pose, at rest; the next frame may have any stamp.

        Args:
            is_new_time: True if stamps begin anew, so that frames so far have no place among those that follow.
        """
        if is_new_time:
            self.graph.rest()
        else:
            self.graph.interrupt(self._newest())
        self._motion.place(self._motion.last_pose)
        self._relocaliser.interrupt()
        self._last_stamp_ns = self._last_seen = None

    def render(self, T_world_cam: Matrix) -> RenderedView:
        """Renders the map from a pose [4, 4], through the camera of the frames.

        Raises:
            SplatamError: no frame has been processed yet.
        """
        if self.camera is None:
            raise SplatamError('nothing can be rendered before the first frame: the camera is not known')
        T_cam_world = pose_tensor(se3.inverse(T_world_cam), self.backend.device)
        with torch.no_grad():
            return self._rasterizer.render(self.map.gaussians.detached(), self.camera, T_cam_world).images()

    def finish(self, limit_s: float = math.inf, stop: Stop = never) -> int:
        """Makes poses and map agree with all that the graph has measured, then fits the map to all keyframes once more.

        Both after the last frame (``graph.enabled``, ``mapping.fused.final_passes``).

        Args:
            limit_s: longest time, seconds.
            stop: asked before each step; no further step is taken once it returns True.

        Returns:
            The number of steps taken.
        """
        self.optimize_graph()
        return self._mapper.finish(TimeLimit(limit_s, stop), is_corrected=self.graph.num_corrections > 0)

    def optimize_graph(self) -> float:
        """Corrects poses and map so that they agree best with all that the graph has measured.

        Returns:
            The largest distance, in metres, by which a keyframe was moved.
        """
        before = self.graph.nodes.T_world_cam
        self._correct(self.graph.settle(self._newest()))
        after = self.graph.nodes.T_world_cam[: len(before)]
        return float(np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1).max(initial=0.0))

    def _newest(self) -> TrackedFrame | None:
        """Returns the last frame, at the last pose to be trusted; None if no frame has come since the last rest."""
        if self._last_stamp_ns is None:
            return None
        return TrackedFrame(self._num_frames - 1, self._last_stamp_ns, self._motion.trusted_pose, np.zeros((6, 6)))

    def _lose(self, current: CurrentFrame, verdict: Verdict, tracked: TrackingResult) -> FrameResult:
        """Returns the result of a lost frame."""
        self._motion.stop()
        return current.result(verdict, None, self, tracking=tracked)

    def _begin_elsewhere(self, current: CurrentFrame, seen: Observation) -> FrameResult | None:
        """Starts a new map where the camera is, if it was lost for long and sees enough. Returns None if it does not.

        The new map lies beside the old one, far enough that neither sees the other, until a place of both is recognised.
        """
        config = self.config.tracking.align.relocalisation
        is_due = config.on_lost == 'new_map' and self._relocaliser.state.num_in_doubt >= config.new_map_after
        if not is_due or self.config.tracking.method == 'truth' or not self.graph.is_used or not len(self.graph.nodes):
            return None
        if not (self._mapper.schedule.plan(current.index, 0.0).is_used and shows_a_place(seen.host)):
            return None
        T_world_cam = self._motion.trusted_pose.copy()
        T_world_cam[0, 3] = float(self.map.means.detach()[:, 0].max()) + _APART_M
        current = self._leave(current, T_world_cam, begins=True)
        posed = PosedFrame(seen, se3.inverse(T_world_cam), self.config.mapping, current.index)
        plan = self._mapper.schedule.plan(0, visible_fraction=0.0)
        self._mapper.densify(posed, plan)
        self._mapper.optimize(self._mapper.select(posed, plan), plan)
        current.clock.lap('map')
        self._motion.place(T_world_cam)
        self._motion.observe(current.frame.stamp_ns, T_world_cam)
        self._relocaliser.state, self._last_seen = RelocaliserState(), seen
        self._note_place(seen, current.index)
        self._follow_graph(current, T_world_cam, begins=True)
        _log.warning('frame %d: the camera is in a place that the map does not show: a new map starts beside it', current.index)
        return current.result(self._judge.start(), T_world_cam, self, is_keyframe=True)

    def _leave(self, current: CurrentFrame, T_world_cam: Matrix, *, begins: bool = False) -> CurrentFrame:
        """Notes that the camera is elsewhere than it was last: frames until now move with the keyframes before them.

        Nobody knows the way there. So it is no motion of the odometry, but as if the world had been corrected.

        Args:
            current: the first frame there.
            T_world_cam: [4, 4] its pose.
            begins: True if a new map begins there.

        Returns:
            The frame.
        """
        graph, T_before = self.graph, self._motion.trusted_pose
        if graph.is_used and len(graph.nodes) and (begins or graph.nodes.frames[-1] >= 0):
            graph.interrupt(TrackedFrame(current.index - 1, current.frame.stamp_ns - 1, T_before, np.zeros((6, 6))))
        graph.T_world_odom = T_world_cam @ se3.inverse(T_before) @ graph.T_world_odom
        return replace(current, T_world_odom=graph.T_world_odom)

    def _follow_graph(
        self, current: CurrentFrame, T_world_cam: Matrix, evidence: Evidence | None = None, found_at: int | None = None, *,
        begins: bool = False,
    ) -> None:  # fmt: skip
        """Tells the graph of a tracked frame; corrects map, keyframes and the poses from which tracking goes on, if it says so."""
        if not self.graph.is_used or not len(self._mapper.keyframes):
            return
        covariance = np.zeros((6, 6)) if evidence is None else evidence.covariance
        frame = TrackedFrame(
            current.index, current.frame.stamp_ns, T_world_cam, covariance,
            found_at=found_at, begins=begins, motion=self._motion.read_motion,
        )  # fmt: skip
        try:
            self._correct(self.graph.follow(frame, self._mapper.keyframes, self.places))
        except np.linalg.LinAlgError as error:  # the frame is tracked and mapped: only its edges are missing
            _log.warning('frame %d is not joined to the keyframe graph: %s', current.index, error)

    def _correct(self, corrections: Corrections | None) -> None:
        if corrections is not None:
            self._mapper.correct(corrections.at)
            self._motion.correct(corrections.motions[-1])
            self.places.follow(self._mapper.keyframes)

    def catch_up(self, pressure: PressureGauge) -> None:
        """After a frame that was mapped: takes the optimization steps that were postponed, until something waits."""
        self._mapper.catch_up(pressure)

    def snapshot(self) -> MapSnapshot:
        """Returns a copy of the map."""
        return self.map.snapshot()

    def _admit(self, frame: RgbdFrame) -> CurrentFrame:
        """Checks a frame, numbers it and starts its clock."""
        _check_images(frame)
        if self.camera is not None and frame.camera != self.camera:
            raise FrameError(f'the camera changed from {self.camera} to {frame.camera}; reset to start a new map')
        if self._last_stamp_ns is not None and frame.stamp_ns <= self._last_stamp_ns:
            raise FrameError(
                f'frame stamp {frame.stamp_ns} ns is not after the last one, {self._last_stamp_ns} ns; reset to go back in time'
            )
        self.camera = frame.camera
        index, self._num_frames, self._last_stamp_ns = self._num_frames, self._num_frames + 1, frame.stamp_ns
        return CurrentFrame(index, frame, Stopwatch(self.backend.device), self.graph.T_world_odom)

    def _observe(self, frame: RgbdFrame) -> Observation:
        """Returns the frame's images; says once that the depth has a grid of holes."""
        seen = Observation.from_frame(frame, self.config.depth, self.backend.device)
        spacing = max(frame.depth_spacing, seen.host.spacing)
        if spacing > 1 and not self._told_spacing:
            _log.warning('%s', describe_spacing(spacing))
            self._told_spacing = True
        return seen

    def _sight(self, seen: Observation, view: View, stamp_ns: int) -> Sight:
        """Returns what is needed to look for a frame anywhere in the map. view: as it is tracked."""
        return Sight(
            stamp_ns=stamp_ns,
            view=view,
            host=seen.host,
            gaussians=self.map.gaussians,
            tracker=self._tracker,
            time_offset=self._motion.time_offset,
            config=self.config.tracking,
        )

    def _note_place(self, seen: Observation, index: int) -> None:
        """Makes the keyframes the places that are recognised. seen: the frame that has just been mapped."""
        if self._knows_places:
            if self.keyframes and self.keyframes[-1].frame == index:
                self.places.add(index, seen.host, self._motion.last_pose)
            self.places.follow(self._mapper.keyframes)

    def _with_motion_seen(self, predictions: list[Prediction], found: TrackingResult, view: View) -> list[Prediction]:
        """Returns the predictions, with the motion that the last two frames show where the map says too little about a pose."""
        last, (first, *others) = self._last_seen, predictions
        if last is None or not is_weak(found, self.config.tracking):
            return predictions
        T_now_before = first.T_cam_world @ first.T_world_cam_before
        seen = self._tracker.motion(view, last.device.scaled(self.config.tracking.scale), T_now_before)
        return [replace(first, seen=seen), *others]

    def _new_mapper(self) -> Mapper:
        return Mapper(self.config, self._rasterizer, self.backend.device, self._recording_length, self._stop)

    def _new_graph(self) -> KeyframeGraph:
        return KeyframeGraph(self.config, self._new_graph_aligner())

    def _new_graph_aligner(self) -> Aligner[Any] | None:
        """Returns what aligns keyframes, which are in the host's memory; None if there is no graph."""
        if not self.config.graph.enabled or self.config.tracking.method == 'truth':  # true poses need no correction
            return None
        try:
            return make_aligner(self.config.threads, HOST)
        except RasterizerError as error:
            _log.warning('there is no keyframe graph, as if graph.enabled were false: %s', error)
            return None

    def _new_tracker(self) -> Tracker:
        return make_tracker(self._rasterizer, self.config.tracking, self.config.threads, self.backend.device, self._stop)

    def _new_motion_model(self) -> MotionModel:
        if self.config.tracking.method == 'truth':
            return MotionModel(constant_velocity=False, prior=self._true_motion)
        return MotionModel(self.config.tracking.motion_model == 'constant_velocity', self._motion_prior)


def check_truth(config: SlamConfig, true_motion: MotionPrior | None) -> None:
    """Checks that ground truth is there where the configuration asks for it.

    Raises:
        ConfigError: it is not.
    """
    if config.tracking.method == 'truth' and true_motion is None:
        raise ConfigError(
            "tracking.method = truth: there is no ground truth here; only 'splatam run' on a recording that has it can use it. "
            'Choose render_and_compare or align'
        )


def _check_images(frame: RgbdFrame) -> None:
    """Checks that the images are what ``RgbdFrame`` promises.

    Raises:
        FrameError: one has another size than the camera, or another type.
    """
    size = frame.camera.height, frame.camera.width
    expected = (('rgb', frame.rgb, (*size, 3), np.uint8), ('depth_m', frame.depth_m, size, np.float32))
    for name, image, shape, dtype in expected:
        if image.shape != shape or image.dtype != dtype:
            raise FrameError(f'{name} of the frame is {image.shape} {image.dtype}; expected {shape} {np.dtype(dtype)}')
