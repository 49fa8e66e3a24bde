"""Render once, align many times: Gauss-Newton from coarse to fine between the frame and one render of the map.

Where the paper's tracker differentiates the renderer in every step, this one renders the map at the first guess and
then treats that picture as a reference: each pixel where the silhouette is sure is a point with a colour, and the
camera moves until the points land on equal brightness and equal depth in the frame (direct alignment as in DVO,
Kerl et al. 2013: Student-t weights, scales from the data). Colour and depth share one 6x6 system, so rotation and
translation, which look alike to first-order steps, are told apart at once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from splatam_core import se3
from splatam_core.camera import PinholeCamera
from splatam_core.config import TrackingConfig
from splatam_core.rasterizer import Gaussians, Rasterizer, Render
from splatam_core.tracking.base import Candidate, TrackingResult, judge
from splatam_core.view import View

Array = NDArray[np.float32]
Matrix = NDArray[np.float64]

_LUMINANCE = np.array([[0.299, 0.587, 0.114]], dtype=np.float32)
_COARSEST_PX = 32  # smaller images show too little to align
_EDGE = 0.05  # depth that changes by more than this share from pixel to pixel is an edge, not a surface
_FREEDOM = 5.0  # of the Student-t distribution of residuals
_MIN_POINTS = 50
_MIN_SCALES = 0.004, 0.001  # of brightness and of relative depth: no sensor is better


class AlignmentTracker:
    """Keeps the aligned pose where it explains the frame better than the first guess."""

    def __init__(self, rasterizer: Rasterizer, config: TrackingConfig) -> None:
        self._rasterizer = rasterizer
        self._config = config

    def track(self, view: View, gaussians: Gaussians, T_cam_world: Matrix) -> TrackingResult:
        """See ``Tracker.track``."""
        frame = _Picture.of(view.camera, view.rgb.numpy(), np.where(view.valid, view.depth, np.float32(np.nan)))
        frames = _levels(frame)
        best = self._render(view, gaussians, T_cam_world, None)
        for _ in range(self._config.renders):
            reference = _reference(view.camera, best.render, self._config.silhouette_threshold)
            motion = _align(_levels(reference), frames, self._config.iterations)
            aligned = self._render(view, gaussians, motion @ best.T_cam_world, best)
            if not aligned.cost < best.cost:
                break
            best = aligned
        return judge(best.T_cam_world, best.render, view, self._config)

    def _render(self, view: View, gaussians: Gaussians, T_cam_world: Matrix, guess: Candidate | None) -> Candidate:
        with torch.no_grad():
            pose = torch.from_numpy(T_cam_world).float()
            render = self._rasterizer.render(gaussians.detached(), view.camera, pose)
        return Candidate.of(T_cam_world, render, view, self._config, guess)


@dataclass(frozen=True, slots=True, eq=False)
class _Picture:
    """One resolution of what is aligned.

    Attributes:
        camera: its pinhole.
        brightness: [H, W].
        depth: [H, W] metres; NaN where there is none.
    """

    camera: PinholeCamera
    brightness: Array
    depth: Array

    @classmethod
    def of(cls, camera: PinholeCamera, rgb: Array, depth: Array) -> _Picture:
        brightness = cv2.transform(np.ascontiguousarray(rgb.transpose(1, 2, 0)), _LUMINANCE)
        return cls(camera, brightness, depth.astype(np.float32))


def _reference(camera: PinholeCamera, render: Render, silhouette_threshold: float) -> _Picture:
    sure = (render.silhouette > silhouette_threshold).numpy()
    return _Picture.of(camera, render.rgb.numpy(), np.where(sure, render.depth().numpy(), np.float32(np.nan)))


def _levels(picture: _Picture) -> list[_Picture]:
    """The picture at a half, a quarter, ...; itself where it is too small for that.

    The full resolution would be three quarters of the work.
    """
    return list(_halvings(picture)) or [picture]


def _halvings(picture: _Picture) -> Iterator[_Picture]:
    while min(picture.camera.width, picture.camera.height) >= 2 * _COARSEST_PX:
        height, width = picture.camera.height // 2, picture.camera.width // 2
        camera = picture.camera.cropped(2 * width, 2 * height).resized(width, height)
        blocks = picture.depth[: 2 * height, : 2 * width].reshape(height, 2, width, 2)
        depth = blocks.mean(axis=(1, 3))
        depth[np.ptp(blocks, axis=(1, 3)) > _EDGE * depth] = np.nan
        brightness = picture.brightness[: 2 * height, : 2 * width]
        picture = _Picture(camera, cv2.resize(brightness, (width, height), interpolation=cv2.INTER_AREA), depth)
        yield picture


def _align(references: list[_Picture], frames: list[_Picture], steps: int) -> Matrix:
    """[4, 4] motion from the reference's camera to the frame's, coarse to fine."""
    motion = np.eye(4)
    for reference, frame in zip(reversed(references), reversed(frames), strict=True):
        points, brightness = _points(reference)
        layers = _layers(frame)
        for _ in range(steps):
            twist = _gauss_newton_step(points, brightness, frame.camera, layers, motion)
            if twist is None:
                break
            motion = se3.exp(twist) @ motion
            if np.abs(twist).max() < 1e-5:
                break
    return motion


def _points(reference: _Picture) -> tuple[Array, Array]:
    """[3, K] camera coordinates and [K] brightness of the reference's pixels that have depth."""
    camera = reference.camera
    v, u = np.nonzero(np.isfinite(reference.depth))
    z = reference.depth[v, u]
    x, y = (u - np.float32(camera.cx)) / np.float32(camera.fx) * z, (v - np.float32(camera.cy)) / np.float32(camera.fy) * z
    return np.stack([x, y, z]).astype(np.float32), reference.brightness[v, u]


def _layers(frame: _Picture) -> tuple[Array, Array]:
    """Brightness and depth, each [H, W, 3] with its slopes along u and v; NaN off surfaces."""
    depth = _with_slopes(frame.depth)
    depth[~(np.abs(depth[..., 1:]).max(axis=2) <= _EDGE * frame.depth)] = np.nan
    return _with_slopes(frame.brightness), depth


def _with_slopes(image: Array) -> Array:
    slopes = np.zeros((*image.shape, 2), dtype=np.float32)
    slopes[:, 1:-1, 0] = (image[:, 2:] - image[:, :-2]) / 2
    slopes[1:-1, :, 1] = (image[2:] - image[:-2]) / 2
    return np.concatenate([image[..., None], slopes], axis=2)


def _gauss_newton_step(
    points: Array, brightness: Array, camera: PinholeCamera, layers: tuple[Array, Array], motion: Matrix
) -> NDArray[np.float64] | None:
    """[6] the twist that best removes the residuals at a motion; None where they do not determine one."""
    x, y, z = moved = (motion[:3, :3] @ points + motion[:3, 3:]).astype(np.float32)
    with np.errstate(divide='ignore', invalid='ignore'):
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    light, depth = (
        cv2.remap(layer, u[None].astype(np.float32), v[None].astype(np.float32), cv2.INTER_LINEAR,
                  borderMode=cv2.BORDER_CONSTANT, borderValue=(np.nan,) * 3)[0].T
        for layer in layers
    )  # fmt: skip
    with np.errstate(invalid='ignore'):
        seen = (z > 0) & np.isfinite(light[0]) & (np.abs(depth[0] - z) < 2 * _EDGE * z)  # NaN compares as false
    if seen.sum() < _MIN_POINTS:
        return None
    moved, light, depth, z = moved[:, seen], light[:, seen], depth[:, seen], z[seen]
    light_rows = _slopes_by_twist(light[1:], moved, camera)
    depth_rows = _slopes_by_twist(depth[1:], moved, camera)
    depth_rows[2] -= 1
    depth_rows[3] -= moved[1]
    depth_rows[4] += moved[0]
    systems = [
        _normal_equations(light_rows, light[0] - brightness[seen], np.ones_like(z), _MIN_SCALES[0]),
        _normal_equations(depth_rows, depth[0] - z, 1 / z, _MIN_SCALES[1]),
    ]
    H, g = sum(H for H, _ in systems), sum(g for _, g in systems)
    try:
        return -np.linalg.solve(H, g)
    except np.linalg.LinAlgError:
        return None


def _slopes_by_twist(slopes: Array, points: Array, camera: PinholeCamera) -> Array:
    """[6, K] change of an image's value under each point, by a twist of the points in front of the camera.

    Args:
        slopes: [2, K] the image's slopes along u and v.
        points: [3, K].
        camera: projects the points.
    """
    x, y, z = points
    a, b = slopes[0] * camera.fx / z, slopes[1] * camera.fy / z
    c = -(a * x + b * y) / z
    return np.stack([a, b, c, c * y - b * z, a * z - c * x, b * x - a * y])


def _normal_equations(rows: Array, residuals: Array, weights: Array, min_scale: float) -> tuple[Matrix, Matrix]:
    """[6, 6] and [6] of robust least squares, in units of the residuals' own spread."""
    residuals, rows = residuals * weights, rows * weights
    scale = max(min_scale, 1.4826 * float(np.median(np.abs(residuals))))
    robust = (_FREEDOM + 1) / (_FREEDOM + (residuals / scale) ** 2) / scale**2
    weighted = rows * robust
    return (weighted @ rows.T).astype(np.float64), (weighted @ residuals).astype(np.float64)
