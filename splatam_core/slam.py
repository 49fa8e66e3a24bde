"""SplaTAM (Keetha et al., CVPR 2024): splat, track and map, one frame at a time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from splatam_core.correction import correct
from splatam_core.errors import FrameError
from splatam_core.geometry import se3
from splatam_core.graph.relocalisation import unknown
from splatam_core.images.observation import Observation
from splatam_core.images.view import View
from splatam_core.interruption import PressureGauge, no_pressure
from splatam_core.lifecycle import CurrentFrame, SlamLifecycle
from splatam_core.mapping.posed import PosedFrame
from splatam_core.tracking import TrackingResult
from splatam_core.tracking.motion import Prediction
from splatam_core.tracking.verdict import Verdict
from splatam_core.types import FrameResult, RgbdFrame, Status

MIN_SIDE = 8  # pixels


@contextmanager
def _solvable() -> Iterator[None]:
    """Raises FrameError for a view so odd that rounding leaves no system of equations to solve: it costs only itself."""
    try:
        yield
    except np.linalg.LinAlgError as error:
        raise FrameError(f'it cannot be tracked: {error}; is the calibration that of the camera?') from None


class Slam(SlamLifecycle):
    """The algorithm on one page; ``SlamLifecycle`` holds the rest."""

    def process(self, frame: RgbdFrame, pressure: PressureGauge = no_pressure) -> FrameResult:
        """Finds the pose of a frame, then adds what it shows to the map; steps of that are postponed as ``pressure`` says.

        Raises:
            FrameError: the frame has another camera than the first one, or is not later than the last one.
        """
        current = self._admit(frame)
        if self._relocaliser.is_resting(self.config.tracking):
            return current.result(self._relocaliser.rest(), None, self)
        seen = self._observe(frame)
        if self.num_gaussians == 0:
            return self._initialize(current, seen)

        view = seen.device.scaled(self.config.tracking.scale)
        with _solvable():
            tracked, verdict = self._find(view, self._motion.predictions(frame.stamp_ns))
            found = self._relocaliser.recover(self._sight(seen, view, frame.stamp_ns), tracked, verdict)
        if found is not None:
            tracked, verdict = found.result, self._judge.relocate(found.judge, found.verdict)
            current = self._leave(current, found.T_world_cam)
            self._motion.place(found.T_world_cam)
        current.clock.lap('track')
        if verdict.status is Status.LOST:
            return self._begin_elsewhere(current, seen) or self._lose(current, verdict, tracked)

        # Depth sets the pace: colour that comes late, or twice, says little about how the camera moves.
        T_world_cam_depth, T_world_cam = se3.inverse(tracked.T_cam_world_depth), se3.inverse(tracked.T_cam_world)
        self._motion.observe(frame.stamp_ns, T_world_cam_depth, is_trusted=verdict.status.is_trusted, readout=tracked.readout)
        self._last_seen = seen
        if not verdict.status.is_trusted:
            return current.result(verdict, T_world_cam, self, tracking=tracked)
        self._motion.time_offset = tracked.time_offset
        if verdict.corrects:
            with _solvable():
                correct(self._mapper, self.graph, self._tracker, self.config.tracking, current.index)
        posed = PosedFrame(seen, tracked.T_cam_world, self.config.mapping, current.index)
        plan = self._mapper.schedule.plan(current.index, tracked.visible_fraction)
        posed = self._mapper.still(posed, plan)
        self._mapper.densify(posed, plan)
        current.clock.lap('densify')
        window = self._mapper.select(posed, plan)
        current.clock.lap('keyframes')
        postponed = self._mapper.optimize(window, plan, pressure)
        current.clock.lap('map')
        if plan.is_keyframe or verdict.corrects:
            self._note_place(seen, current.index)
        self._follow_graph(current, T_world_cam, tracked.evidence, None if found is None else found.keyframe)
        current.clock.lap('graph')
        return current.result(
            verdict, T_world_cam, self, tracking=tracked, is_keyframe=plan.is_keyframe, is_relocalised=found is not None,
            postponed_steps=postponed,
        )  # fmt: skip

    def _find(self, view: View, predictions: list[Prediction]) -> tuple[TrackingResult, Verdict]:
        """Finds the pose of a view: from the last pose, and where that is uncertain, also from the last one to be trusted."""
        if self._relocaliser.state.is_anywhere:
            return unknown()
        gaussians, time_offset = self.map.gaussians, self._motion.time_offset
        found = [
            self._tracker.track(view, gaussians, at.T_cam_world, se3.inverse(at.T_world_cam_before), time_offset, pace=at.pace)
            for at in predictions
        ]
        return self._judge.choose(found, self._with_motion_seen(predictions, found[0], view), self.config.tracking)

    def _initialize(self, current: CurrentFrame, seen: Observation) -> FrameResult:
        """Starts the map at the identity pose."""
        reason = self._mapper.schedule.why_not_mapped(current.index)
        camera = current.frame.camera
        if not reason and min(camera.width, camera.height) < MIN_SIDE:
            reason = (
                f'frames of {camera.width}x{camera.height} pixels are too small to track, at least {MIN_SIDE}x{MIN_SIDE} are needed'
            )
        if not reason and not seen.device.valid.any():
            reason = 'no pixel has a usable depth reading'
        if not reason:
            self._mapper = self._new_mapper()
            posed = PosedFrame(seen, np.eye(4), self.config.mapping, current.index)
            plan = self._mapper.schedule.plan(0, visible_fraction=0.0)
            self._mapper.densify(posed, plan)
            current.clock.lap('densify')
            self._mapper.optimize(self._mapper.select(posed, plan), plan)
            current.clock.lap('map')
            if self.num_gaussians == 0:
                reason = 'no reading lies where Gaussians would be added (densification.scale)'
        if reason:
            return current.result(Verdict(Status.LOST, f'the map cannot start: {reason}'), None, self)
        self._motion.observe(current.frame.stamp_ns, np.eye(4))
        self._last_seen = seen
        self._note_place(seen, current.index)
        self._follow_graph(current, np.eye(4))
        return current.result(self._judge.start(), np.eye(4), self, is_keyframe=True)
