"""SplaTAM (Keetha et al., CVPR 2024): splat, track and map, one frame at a time."""

from __future__ import annotations

import numpy as np

from splatam_core.geometry import se3
from splatam_core.images.observation import Observation
from splatam_core.lifecycle import CurrentFrame, SlamLifecycle
from splatam_core.mapping.posed import PosedFrame
from splatam_core.tracking.verdict import verify
from splatam_core.types import FrameResult, RgbdFrame, Status

MIN_SIDE = 8  # pixels


class Slam(SlamLifecycle):
    """The algorithm on one page; ``SlamLifecycle`` holds the rest."""

    def process(self, frame: RgbdFrame) -> FrameResult:
        """Finds the pose of a frame, then adds what the frame shows to the map.

        Raises:
            FrameError: the frame has another camera than the first one, or is not later than the last one.
        """
        current = self._admit(frame)
        seen = self._observe(frame)
        if self.num_gaussians == 0:
            return self._initialize(current, seen)

        predicted = se3.inverse(self._motion.predict(frame.stamp_ns))
        last = se3.inverse(self._motion.last_pose)
        view = seen.device.scaled(self.config.tracking.scale)
        tracked = self._tracker.track(view, self.map.gaussians, predicted, last, self._motion.time_offset)
        current.clock.lap('track')
        if reason := verify(tracked, self.config.tracking):
            self._motion.stop()
            return current.result(Status.LOST, None, self, tracking=tracked, reason=reason)

        # Depth sets the pace: colour that comes late, or twice, says little about how the camera moves.
        self._motion.observe(frame.stamp_ns, se3.inverse(tracked.T_cam_world_depth))
        self._motion.time_offset = tracked.time_offset
        posed = PosedFrame(seen, tracked.T_cam_world, self.config.mapping)
        plan = self._mapper.schedule.plan(current.index, tracked.visible_fraction)
        self._mapper.densify(posed, plan)
        current.clock.lap('densify')
        window = self._mapper.select(posed, plan)
        current.clock.lap('keyframes')
        self._mapper.optimize(window, plan)
        current.clock.lap('map')
        T_world_cam, is_keyframe = se3.inverse(tracked.T_cam_world), plan.is_keyframe
        return current.result(Status.TRACKED, T_world_cam, self, tracking=tracked, is_keyframe=is_keyframe)

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
            posed, plan = PosedFrame(seen, np.eye(4), self.config.mapping), self._mapper.schedule.plan(0, visible_fraction=0.0)
            self._mapper.densify(posed, plan)
            current.clock.lap('densify')
            self._mapper.optimize(self._mapper.select(posed, plan), plan)
            current.clock.lap('map')
            if self.num_gaussians == 0:
                reason = 'no reading lies where Gaussians would be added (densification.scale)'
        if reason:
            return current.result(Status.LOST, None, self, reason=f'the map cannot start: {reason}')
        self._motion.observe(current.frame.stamp_ns, np.eye(4))
        return current.result(Status.INITIALIZED, np.eye(4), self, is_keyframe=True)
