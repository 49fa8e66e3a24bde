"""Render once, align many times: Gauss-Newton between the frame and one render of the map.

The paper's tracker differentiates the renderer in every step. This one renders the map once, at the predicted pose, and uses
that image as a reference: each pixel where the map is opaque is a point with a colour. The camera moves until the points
land on equal brightness and equal depth in the frame (direct alignment as in DVO, Kerl et al. 2013). Colour and depth share
one linear system, so that rotation and translation, which look alike to first order in either one, can be told apart.

Three more unknowns are solved for: gain and bias of the brightness, for automatic exposure, and the time offset between
colour and depth. Few cameras take both at once, and a moving camera sees them from different places
(docs/decisions/0005-time-offset.md). The pose of a frame is that of its colour image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from splatam_core.config import TrackingConfig
from splatam_core.device import pose_tensor
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.geometry.se3 import Matrix
from splatam_core.images.view import View
from splatam_core.interruption import Stop, never
from splatam_core.rasterizer import Gaussians, Rasterizer, Render
from splatam_core.rasterizer.native import make_native_aligner
from splatam_core.tracking.aligner import Aligner
from splatam_core.tracking.base import TrackingResult
from splatam_core.tracking.features import features_of, pose_by_features
from splatam_core.tracking.gauss_newton import GaussNewton
from splatam_core.tracking.motion import SeenMotion
from splatam_core.tracking.newest import OfNewestViews
from splatam_core.tracking.pace import Pace
from splatam_core.tracking.pyramid import Level, frame_level, full_pyramid, half_pyramid, render_level
from splatam_core.tracking.time_offset import TimeOffset
from splatam_core.tracking.torch_aligner import TorchAligner
from splatam_core.tracking.verdict import better, verify, widened

_LEAST_ERROR_PX = 0.1  # of the motion between two images, along and about each axis: interpolation is no better
_FAR = 0.05  # m and rad: alignment that has come so far may have found another minimum, and features are asked, too


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """What one call of ``track`` works on.

    Attributes:
        view: the frame.
        pyramid: the frame at a half, a quarter, ... of its resolution.
        gaussians: the map.
        T_cam_world_before: [4, 4] the last pose; None if not known.
        time_offset: between colour and depth, before this frame.
        pace: see ``Tracker.track``.
    """

    view: View
    pyramid: list[Level]
    gaussians: Gaussians
    T_cam_world_before: Matrix | None
    time_offset: TimeOffset
    pace: Pace


class AlignmentTracker:
    """Aligns frames to renders of the map."""

    def __init__(
        self, rasterizer: Rasterizer, config: TrackingConfig, threads: int, device: torch.device, stop: Stop = never
    ) -> None:
        self._rasterizer = rasterizer
        self._config = config
        self._aligner = make_aligner(threads, device)
        self._gauss_newton = GaussNewton(self._aligner, config)
        # Colour is as late in one frame as in the next, so that both images move alike.
        self._between_frames = GaussNewton(self._aligner, replace(config, align=replace(config.align, time_offset=False)))
        self._pyramids = OfNewestViews(lambda view: half_pyramid(frame_level(view, self._aligner), self._aligner))
        self._features = OfNewestViews(features_of)

    def track(
        self,
        view: View,
        gaussians: Gaussians,
        T_cam_world: Matrix,
        T_cam_world_before: Matrix | None = None,
        time_offset: TimeOffset | None = None,
        pace: Pace | None = None,
    ) -> TrackingResult:
        """See ``Tracker.track``."""
        frame = _Frame(view, self._pyramids.of(view), gaussians, T_cam_world_before, time_offset or TimeOffset(), pace or Pace())
        found = self._align_twice(frame, T_cam_world)
        if not self._config.align.features or (self._is_good(found) and not _is_far(found, T_cam_world)):
            return found
        start = self._pose_by_features(frame, T_cam_world if T_cam_world_before is None else T_cam_world_before)
        if start is None:
            return found
        other = self._align_twice(frame, start)
        return widened(better(found, other, self._config), [found, other], self._config)

    def motion(self, view: View, before: View, T_now_before: Matrix) -> SeenMotion | None:
        """See ``Tracker.motion``."""
        if torch.equal(view.rgb8, before.rgb8):
            return None  # the same picture sent twice is no sign of rest
        references, frames = self._pyramids.of(before), self._pyramids.of(view)
        found = self._between_frames.align(references, frames, None, TimeOffset(), T_now_before)
        evidence = found.evidence
        if evidence.explained < self._config.min_explained_fraction:
            return None
        off_rad = _LEAST_ERROR_PX * evidence.pixel_rad
        off_m = off_rad * float(before.depth[before.valid].median())
        return SeenMotion(found.state.depth_motion, evidence.covariance + np.diag(np.repeat([off_m, off_rad], 3) ** 2))

    def _align_twice(self, frame: _Frame, T_cam_world: Matrix) -> TrackingResult:
        """Aligns from a pose, and where the result is poor once more, from a render at the pose found."""
        found = self._align(frame, T_cam_world)
        return found if self._is_good(found) else self._better(found, self._align(frame, found.T_cam_world_depth))

    def _align(self, frame: _Frame, T_cam_world: Matrix) -> TrackingResult:
        """Renders the map at a pose and aligns the frame to that."""
        references = self._reference_pyramid(frame, T_cam_world)
        before = frame.T_cam_world_before
        predicted_motion = None if before is None else T_cam_world @ se3.inverse(before)
        alignment = self._gauss_newton.align(references, frame.pyramid, predicted_motion, frame.time_offset, pace=frame.pace)
        state, system = alignment.state, alignment.system
        num_readings = int((frame.pyramid[0].depth > 0).sum())
        return TrackingResult(
            T_cam_world=state.color_motion @ T_cam_world,
            T_cam_world_depth=state.depth_motion @ T_cam_world,
            num_readings=num_readings,
            visible_fraction=system.compared / max(1, num_readings),
            inlier_fraction=system.agreeing / max(1, system.compared),
            time_offset=alignment.time_offset,
            evidence=alignment.evidence,
            readout=alignment.readout,
        )

    def _reference_pyramid(self, frame: _Frame, T_cam_world: Matrix) -> list[Level]:
        """Returns the map rendered at a pose, at the resolutions of the frame's pyramid."""
        camera, finest = frame.view.camera, frame.pyramid[0].camera
        renders_half = 0 < self._config.align.half_render_from <= camera.width and finest != camera
        if renders_half:
            camera = finest
        level = self._rendered(frame.gaussians, camera, T_cam_world)
        return full_pyramid(level, self._aligner) if renders_half else half_pyramid(level, self._aligner)

    def _rendered(self, gaussians: Gaussians, camera: PinholeCamera, T_cam_world: Matrix) -> Level:
        """Returns the map rendered at a pose; the images of the render go."""
        render = self._render(gaussians, camera, T_cam_world)
        return render_level(render, camera, self._config.silhouette_threshold, self._aligner)

    def _pose_by_features(self, frame: _Frame, T_cam_world: Matrix) -> Matrix | None:
        """Returns the frame's pose by its features in common with the map at a pose; None if there are too few."""
        render = self._render(frame.gaussians, frame.view.camera, T_cam_world)
        motion = pose_by_features(render, frame.view.camera, self._features.of(frame.view))
        return None if motion is None else motion @ T_cam_world

    def _render(self, gaussians: Gaussians, camera: PinholeCamera, T_cam_world: Matrix) -> Render:
        with torch.no_grad():
            return self._rasterizer.render(gaussians, camera, pose_tensor(T_cam_world, gaussians.means.device))

    def _is_good(self, result: TrackingResult) -> bool:
        return result.inlier_fraction >= self._config.align.again_below

    def _better(self, first: TrackingResult, second: TrackingResult) -> TrackingResult:
        """Returns the result that is not lost and has more inliers; the first one of two equals."""
        return max(first, second, key=lambda result: (not verify(result, self._config), result.inlier_fraction))


def _is_far(found: TrackingResult, T_cam_world: Matrix) -> bool:
    """Returns whether a pose is far from where alignment began."""
    return bool(np.linalg.norm(se3.log(found.T_cam_world_depth @ se3.inverse(T_cam_world)).reshape(2, 3), axis=1).max() > _FAR)


def make_aligner(threads: int, device: torch.device) -> Aligner[Any]:
    """Returns the aligner for images on a device. threads: CPU threads; 0 = one per core."""
    return make_native_aligner(threads) if device.type == 'cpu' else TorchAligner()
