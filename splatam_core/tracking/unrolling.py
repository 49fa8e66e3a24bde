"""Images of a camera that moves while it takes them, resampled as if all of each was taken at once."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np

from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.geometry.se3 import Vector
from splatam_core.tracking.aligner import Array
from splatam_core.tracking.pyramid import EDGE, Level
from splatam_core.tracking.read_motion import ReadMotion

Pixels = tuple[Array, Array]
_STEPS = 2  # the flow changes by less than a tenth of itself over its own length
_LEAST_MOTION = 2e-3  # m and rad: the first and the last row are off by half of that, a tenth of a pixel of 120


def unrolled(level: Level, motion: ReadMotion) -> Level:
    """Returns an image on the host as if all of it was taken when the middle row of its colour is read.

    Depth is NaN where nothing of that was seen. Where depth is missing, colour moves as if it was at the median depth.
    """
    depth = np.asarray(level.depth)
    known = depth > 0  # False for NaN
    if not known.any() or max(np.abs(motion.rows).max(), np.abs(motion.delay).max()) < _LEAST_MOTION:
        return level
    camera, median = level.camera, np.median(depth[known])
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)]).astype(np.float32)
    still = _carried(rays * np.where(known, depth, median), motion.rows, -_times(v, camera))
    still = _carried(still, motion.delay, np.float32(1))
    depth = _sampled_depth(np.where(known, still[2], np.float32(np.nan)), _came_from(_projected(still, camera), (u, v)))
    points, at = rays * np.where(np.isnan(depth), median, depth), (u, v)
    for _ in range(_STEPS):
        at = _projected(_carried(points, motion.rows, _times(at[1], camera)), camera)
    outside = (at[0] < 0) | (at[1] < 0) | (at[0] > camera.width - 1) | (at[1] > camera.height - 1)
    brightness = cv2.remap(np.asarray(level.brightness), *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return replace(level, brightness=brightness.astype(np.float32, copy=False), depth=np.where(outside, np.float32(np.nan), depth))


def _times(rows: Array, camera: PinholeCamera) -> Array:
    """Returns when rows are read: from -0.5 for the first to 0.5 for the last."""
    return rows / np.float32(max(1, camera.height - 1)) - np.float32(0.5 * (camera.height > 1))


def _projected(points: Array, camera: PinholeCamera) -> Pixels:
    """Returns [H, W] columns and rows of points [3, H, W]."""
    x, y, z = points
    z = np.maximum(z, np.float32(1e-3))
    return np.float32(camera.fx) * x / z + np.float32(camera.cx), np.float32(camera.fy) * y / z + np.float32(camera.cy)


def _carried(points: Array, twist: Vector, times: Array | np.float32) -> Array:
    """Moves points [3, H, W] by a twist [6] times [H, W], to second order, as ``csrc/readout.hpp`` does."""
    speed, turn = twist[:3, None, None].astype(np.float32), se3.skew(twist[3:]).astype(np.float32)
    rate = np.tensordot(turn, points, axes=1) + speed
    return points + times * (rate + np.float32(0.5) * times * np.tensordot(turn, rate, axes=1))


def _came_from(moved: Pixels, pixels: Pixels) -> Pixels:
    """Returns [H, W] from which column and row each pixel was moved, from where each of them is moved to."""
    flow, source = np.stack([moved[0] - pixels[0], moved[1] - pixels[1]], axis=-1), pixels
    for _ in range(_STEPS):
        step = cv2.remap(flow, *source, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        source = pixels[0] - step[..., 0], pixels[1] - step[..., 1]
    return source


def _sampled_depth(depth: Array, at: Pixels) -> Array:
    """Returns depth at columns and rows: that of the nearest pixel beside NaN and between two surfaces; NaN outside."""
    between, nearest = (
        cv2.remap(depth, *at, method, borderMode=cv2.BORDER_CONSTANT, borderValue=math.nan)
        for method in (cv2.INTER_LINEAR, cv2.INTER_NEAREST)
    )
    return np.where(np.abs(between - nearest) < EDGE * nearest, between, nearest).astype(np.float32)
