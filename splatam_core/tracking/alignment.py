"""Render once, align many times: Gauss-Newton from coarse to fine between the frame and one render of the map.

Where the paper's tracker differentiates the renderer in every step, this one renders the map at the first guess and
then treats that picture as a reference: each pixel where the silhouette is sure is a point with a colour, and the
camera moves until the points land on equal brightness and equal depth in the frame (direct alignment as in DVO,
Kerl et al. 2013: Student-t weights, scales from the data). Colour and depth share one system, so rotation and
translation, which look alike to first-order steps, are told apart at once. Two more unknowns take up what the camera's
automatic exposure does to brightness, and one the time by which colour lags depth: few cameras take both at once, and a
moving one shows them from different places (docs/decisions/0005-time-offset.md). The pose of a frame is that of its colour.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatam_core import _native
from splatam_core.config import TrackingConfig
from splatam_core.device import pose_tensor
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.images.filters import brightness, is_on_host, luminance
from splatam_core.images.view import View
from splatam_core.rasterizer import Gaussians, Rasterizer, Render
from splatam_core.tracking.base import TrackingResult
from splatam_core.tracking.features import pose_by_features
from splatam_core.tracking.torch_aligner import TorchAligner
from splatam_core.tracking.verdict import verify

Array = NDArray[np.float32]
Image = Array | Tensor  # on the host; elsewhere
Matrix = NDArray[np.float64]

_COARSEST_PX = 32  # smaller images show too little to align
_EDGE = 0.05  # depth that changes by more than this share from pixel to pixel is an edge, not a surface
_MIN_POINTS = 50
_DEPTH_LAYER = 3
_MIN_SCALES = 0.004, 0.001  # of brightness and of relative depth: no sensor is better
_FIRST_SCALES = 0.1, 0.02
_SMALL_STEP = 1e-5
_LEAST_WEIGHT = 1e-6
_PRIOR = np.array([0.3] * 6 + [0.1] * 2 + [0.5]) ** -2  # spread of a step (m, rad), of gain, bias, and lag (frames)


class AlignmentTracker:
    """Keeps the aligned pose where it explains the frame better than the first guess."""

    def __init__(self, rasterizer: Rasterizer, config: TrackingConfig, threads: int, device: torch.device) -> None:
        self._rasterizer = rasterizer
        self._config = config
        is_native = device.type == 'cpu'
        self._aligner = _native.Aligner(threads or len(os.sched_getaffinity(0))) if is_native else TorchAligner()

    def track(
        self, view: View, gaussians: Gaussians, T_cam_world: Matrix, T_cam_world_before: Matrix | None = None
    ) -> TrackingResult:
        """See ``Tracker.track``."""
        frames = self._levels(_frame(view))

        def align_from(start: Matrix) -> TrackingResult:
            found = self._track(frames, view.camera, gaussians, start, T_cam_world_before)
            if self._is_good(found):
                return found
            again = self._track(frames, view.camera, gaussians, found.T_cam_world_depth, T_cam_world_before)
            return max(found, again, key=self._rank)

        found = align_from(T_cam_world)
        if self._is_good(found) or not self._config.align.features:
            return found
        last = T_cam_world if T_cam_world_before is None else T_cam_world_before
        motion = pose_by_features(self._render(gaussians, view.camera, last), view)
        return found if motion is None else max(found, align_from(motion @ last), key=self._rank)

    def _rank(self, result: TrackingResult) -> tuple[bool, float]:
        """The larger is the better result."""
        return not verify(result, self._config), result.inlier_fraction

    def _is_good(self, result: TrackingResult) -> bool:
        return result.inlier_fraction >= self._config.align.again_below

    def _track(
        self, frames: list[_Picture], camera: PinholeCamera, gaussians: Gaussians, T_cam_world: Matrix,
        T_cam_world_before: Matrix | None,
    ) -> TrackingResult:  # fmt: skip
        """Render from the first guess, and align to that."""
        references = self._references(gaussians, camera, frames[0].camera, T_cam_world)
        before = None if T_cam_world_before is None else T_cam_world @ se3.inverse(T_cam_world_before)
        alignment = self._align(references, frames, before)
        fit = alignment.fit
        readings = int((frames[0].depth > 0).sum())
        visible_fraction, inlier_fraction = fit.compared / max(1, readings), fit.agreeing / max(1, fit.compared)
        at_color, at_depth = alignment.state.light_motion @ T_cam_world, alignment.state.motion @ T_cam_world
        return TrackingResult(at_color, at_depth, readings, visible_fraction, inlier_fraction)

    def _references(self, gaussians: Gaussians, full: PinholeCamera, finest: PinholeCamera, T_cam_world: Matrix) -> list[_Picture]:
        """The map from the first guess, at the resolutions of ``_levels``."""
        least = self._config.align.half_render_from
        camera = finest if 0 < least <= full.width else full
        render = self._render(gaussians, camera, T_cam_world)
        picture = _reference(camera, render, self._config.silhouette_threshold)
        if camera == full:
            return self._levels(picture)
        picture = self._without_edges(picture)
        return [picture, *self._halvings(picture)]

    def _render(self, gaussians: Gaussians, camera: PinholeCamera, T_cam_world: Matrix) -> Render:
        with torch.no_grad():
            return self._rasterizer.render(gaussians, camera, pose_tensor(T_cam_world, gaussians.means.device))

    def _without_edges(self, picture: _Picture) -> _Picture:
        """What a render blends across an edge is no surface; ``halve`` leaves it out on the way to the other levels."""
        layers = self._aligner.layers(picture.brightness, picture.depth, _EDGE)
        depth = layers[..., _DEPTH_LAYER]
        return replace(picture, depth=depth if isinstance(depth, Tensor) else np.ascontiguousarray(depth))

    def _levels(self, picture: _Picture) -> list[_Picture]:
        """The picture at a half, a quarter, ...; itself where it is too small for that.

        The full resolution would be three quarters of the work.
        """
        return list(self._halvings(picture)) or [picture]

    def _halvings(self, picture: _Picture) -> Iterator[_Picture]:
        while min(picture.camera.width, picture.camera.height) >= 2 * _COARSEST_PX:
            width, height = picture.camera.width // 2, picture.camera.height // 2
            camera = picture.camera.cropped(2 * width, 2 * height).resized(width, height)
            picture = _Picture(camera, *self._aligner.halve(picture.brightness, picture.depth, _EDGE))
            yield picture

    def _align(self, references: list[_Picture], frames: list[_Picture], before: Matrix | None) -> _Alignment:
        """Coarse to fine; the first guess where that explains the finest level better.

        ``before`` is the motion [4, 4] from the camera a frame ago to the first guess, if that is known.
        """
        guess = state = _State(np.eye(4))
        scales, free = _FIRST_SCALES, self._free_unknowns()
        for reference, frame in zip(reversed(references), reversed(frames), strict=True):
            layers = self._aligner.layers(frame.brightness, frame.depth, _EDGE)
            for _ in range(self._config.iterations):
                state = state if before is None else state.moving_at(se3.log(state.motion @ before))
                fit = self._fit(reference, layers, state, scales)
                step, scales = fit.step(state, free), fit.scales
                if step is None:
                    break
                state = state.moved(step)
                if np.abs(step[:6]).max() < _SMALL_STEP:
                    break
        at_guess = self._fit(references[0], layers, guess, scales)
        found = self._fit(references[0], layers, state, scales)
        unseen_cost = at_guess.cost / max(1, at_guess.seen)
        better = 2 * found.seen > at_guess.seen and found.total_cost(unseen_cost) < at_guess.total_cost(unseen_cost)
        return _Alignment(state, found) if better else _Alignment(guess, at_guess)

    def _free_unknowns(self) -> list[int]:
        return [*range(6), *[6, 7] * self._config.align.exposure, *[8] * self._config.align.time_offset]

    def _fit(self, reference: _Picture, layers: Image, state: _State, scales: tuple[float, float]) -> _Fit:
        camera, config = reference.camera, self._config
        weights = config.color_weight, config.depth_weight
        weighted = (scale / math.sqrt(max(weight, _LEAST_WEIGHT)) for scale, weight in zip(scales, weights, strict=True))
        return _Fit(
            *self._aligner.linearize(
                reference.brightness, reference.depth, layers, camera.fx, camera.fy, camera.cx, camera.cy,
                state.light_motion.astype(np.float32), state.motion.astype(np.float32), state.velocity.astype(np.float32),
                state.gain, state.bias, *weighted, 2 * _EDGE, config.inlier_color, config.inlier_depth,
            )
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _Picture:
    """One resolution of what is aligned.

    Attributes:
        camera: its pinhole.
        brightness: [H, W].
        depth: [H, W] metres; NaN where there is none.
    """

    camera: PinholeCamera
    brightness: Image
    depth: Image


@dataclass(frozen=True, slots=True, eq=False)
class _State:
    """What is sought.

    Attributes:
        motion: [4, 4] from the reference's camera to the frame's, when depth was taken.
        gain: the frame's brightness is gain times the reference's, plus bias.
        bias: see gain.
        lag: of colour behind depth, in frames.
        velocity: [6] of the points before the camera, twist a frame.
    """

    motion: Matrix
    gain: float = 1.0
    bias: float = 0.0
    lag: float = 0.0
    velocity: Matrix = field(default_factory=lambda: np.zeros(6))

    @property
    def light_motion(self) -> Matrix:
        """[4, 4] as ``motion``, when colour was taken."""
        return se3.exp(self.lag * self.velocity) @ self.motion if self.lag else self.motion

    def moving_at(self, velocity: Matrix) -> _State:
        """The same with another estimate of the velocity."""
        return replace(self, velocity=velocity)

    def moved(self, change: Matrix) -> _State:
        """After a change [9] of the unknowns."""
        return _State(
            se3.exp(change[:6]) @ self.motion,
            self.gain + change[6],
            self.bias + change[7],
            self.lag + change[8],
            self.velocity,
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """The residuals at a state, linearised.

    Attributes:
        H: [9, 9] normal equations: twist, gain, bias, lag.
        g: [9].
        cost: of the points seen, robust.
        points: points of the reference.
        compared: those that fall on a reading of the frame.
        seen: those on the same surface.
        agreeing: those that agree in brightness and depth.
        light_median: of the residuals of brightness, magnitude; NaN where nothing is seen.
        depth_median: of the relative residuals of depth.
    """

    H: Matrix
    g: Matrix
    cost: float
    points: int
    compared: int
    seen: int
    agreeing: int
    light_median: float
    depth_median: float

    @property
    def scales(self) -> tuple[float, float]:
        """The residuals' own spread."""
        return max(_MIN_SCALES[0], 1.4826 * self.light_median), max(_MIN_SCALES[1], 1.4826 * self.depth_median)

    def step(self, state: _State, free: list[int]) -> Matrix | None:
        """[9] the change of the free unknowns that best removes the residuals; None where they do not determine it.

        On a ramp of brightness a shift looks like a change of bias: what the residuals leave open, the priors settle.
        """
        if self.seen < _MIN_POINTS:
            return None
        H, g = self.H + np.diag(_PRIOR), self.g.copy()
        g[6:] += _PRIOR[6:] * (state.gain - 1, state.bias, state.lag)
        step = np.zeros(len(g))
        try:
            step[free] = -np.linalg.solve(H[np.ix_(free, free)], g[free])
        except np.linalg.LinAlgError:
            return None
        return step

    def total_cost(self, unseen_cost: float) -> float:
        """Robust cost; a state that sees less of the map is not better for it."""
        return self.cost + unseen_cost * (self.points - self.seen)


@dataclass(frozen=True, slots=True, eq=False)
class _Alignment:
    """The state found, and how the finest level fits there."""

    state: _State
    fit: _Fit


def _frame(view: View) -> _Picture:
    if not is_on_host(view.depth):
        return _Picture(view.camera, brightness(view.rgb8), torch.where(view.valid, view.depth, torch.nan))
    depth = np.where(view.valid, view.depth, np.float32(np.nan))
    return _Picture(view.camera, _brightness(view.rgb8.numpy().astype(np.float32) / 255), depth)


def _reference(camera: PinholeCamera, render: Render, silhouette_threshold: float) -> _Picture:
    if not is_on_host(render.rgb):
        depth = torch.where(render.silhouette > silhouette_threshold, render.depth(), torch.nan)
        return _Picture(camera, luminance(render.rgb.permute(1, 2, 0)), depth)
    sure = (render.silhouette > silhouette_threshold).numpy()
    depth = np.where(sure, render.depth().numpy(), np.float32(np.nan))
    return _Picture(camera, _brightness(np.ascontiguousarray(render.rgb.permute(1, 2, 0).numpy())), depth)


def _brightness(rgb: Array) -> Array:
    """[H, W] luminance of colours [H, W, 3]."""
    return cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
