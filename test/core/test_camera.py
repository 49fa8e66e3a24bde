"""The pixel convention, rectification, and calibration files."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from splatam_core.datasets.camera_file import read_camera_file
from splatam_core.errors import CameraError, FrameError
from splatam_core.geometry.camera import CameraCalibration, PinholeCamera
from splatam_core.images.rectification import FrameFactory

CAMERA = PinholeCamera(64, 48, 60.0, 61.0, 31.0, 24.5)


def test_resized_keeps_what_a_pixel_centre_sees() -> None:
    """Halved, pixel (u, v) covers the old pixels 2u and 2u + 1: its centre is at 2u + 0.5."""
    half = CAMERA.resized(32, 24)
    ray = lambda camera, u: (u - camera.cx) / camera.fx  # noqa: E731
    assert ray(half, 10) == pytest.approx(ray(CAMERA, 20.5))


def test_resized_image_matches_resized_camera() -> None:
    """A ramp in viewing direction stays that ramp, to the colour's 1/255 and half a step of rounding."""
    u = np.arange(64)
    ramp = np.round(255 * (0.5 + 0.5 * (u - CAMERA.cx) / CAMERA.fx)).astype(np.uint8)
    rgb = np.repeat(np.tile(ramp, (48, 1))[..., None], 3, axis=2)
    frame = FrameFactory(CameraCalibration(CAMERA), width=32).make(1, rgb, np.ones((48, 64), np.float32))
    expected = 255 * (0.5 + 0.5 * (np.arange(32) - frame.camera.cx) / frame.camera.fx)
    np.testing.assert_allclose(frame.rgb[10, :, 0], expected, atol=1.0)


def test_depth_is_resized_without_mixing() -> None:
    """Rectification does not invent readings."""
    depth = np.random.default_rng(0).choice([0.0, 1.0, 3.0], size=(48, 64)).astype(np.float32)
    frame = FrameFactory(CameraCalibration(CAMERA), width=40).make(1, np.zeros((48, 64, 3), np.uint8), depth)
    assert set(np.unique(frame.depth_m)) <= {0.0, 1.0, 3.0}
    assert frame.depth_m.shape == (30, 40)


@pytest.mark.parametrize(
    ('model', 'coefficients'),
    [
        ('plumb_bob', (0.26, -0.95, -0.005, 0.0026, 1.16)),
        ('rational_polynomial', (0.3, -0.1, 0.001, -0.001, 0.02, 0.1, 0.01, 0.001)),
        ('equidistant', (0.05, -0.02, 0.01, -0.001)),
    ],
)
def test_rectified_pixels_see_straight(model: str, coefficients: tuple[float, ...]) -> None:
    """A distorted image of a smooth pattern, rectified, is the pattern seen by a pinhole."""
    camera = PinholeCamera(160, 120, 130.0, 131.0, 80.2, 59.1)
    u, v = np.meshgrid(np.arange(160.0), np.arange(120.0))
    pixels = np.stack([u, v], -1).reshape(-1, 1, 2)
    undistort = cv2.fisheye.undistortPoints if model == 'equidistant' else cv2.undistortPoints
    rays = undistort(pixels, camera.matrix, np.array(coefficients)).reshape(120, 160, 2)
    seen = _pattern(rays[..., 0], rays[..., 1])
    frame = FrameFactory(CameraCalibration(camera, model, coefficients)).make(
        1, np.repeat(seen[..., None], 3, axis=2), np.ones((120, 160), np.float32)
    )
    expected = _pattern((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
    inner = (slice(20, 100), slice(20, 140))
    # Bilinear interpolation of the pattern's curvature and two roundings: up to 3 of 255.
    assert np.abs(frame.rgb[..., 0][inner].astype(int) - expected[inner].astype(int)).max() <= 3


def _pattern(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.round(127 + 60 * np.sin(8 * x) + 60 * np.cos(9 * y)).astype(np.uint8)


@pytest.mark.parametrize('none', [np.nan, np.inf, -np.inf, -1.0, 0.0])
def test_readings_that_are_none_become_zero(none: float) -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    depth[0, :4] = none
    frame = FrameFactory(CameraCalibration(CAMERA)).make(1, np.zeros((48, 64, 3), np.uint8), depth)
    assert not frame.depth_m[0, :4].any()
    assert (frame.depth_m[1:] == 2.0).all()
    assert (frame.depth_m is depth) == (none == 0)  # copied only where something changes


def test_wrong_sizes_are_named() -> None:
    factory = FrameFactory(CameraCalibration(CAMERA))
    with pytest.raises(FrameError, match='colour image is 32x24 .* calibrated for 64x48'):
        factory.make(1, np.zeros((24, 32, 3), np.uint8), np.ones((48, 64), np.float32))
    with pytest.raises(FrameError, match='depth image is 64x40.* 64x48 .*aligned_depth_to_color'):
        factory.make(1, np.zeros((48, 64, 3), np.uint8), np.ones((40, 64), np.float32))


@pytest.mark.parametrize('size', [(24, 32), (96, 128), (36, 48), (12, 17)])
def test_depth_of_another_resolution_is_brought_to_colour_s(size: tuple[int, int]) -> None:
    height, width = size
    v, u = np.mgrid[:height, :width].astype(np.float32)
    depth = 1 + 1000 * v + u
    frame = FrameFactory(CameraCalibration(CAMERA)).make(1, np.zeros((48, 64, 3), np.uint8), depth)
    assert frame.depth_m.shape == (48, 64) and set(frame.depth_m.flat) <= set(depth.flat)  # no reading is interpolated
    # A pixel's centre is its integer index: the nearest centre of the other grid, at most half a pixel of it away.
    y, x = (np.indices((48, 64)) + 0.5) * np.array([height / 48, width / 64])[:, None, None] - 0.5
    found_v, found_u = np.divmod(frame.depth_m - 1, 1000)
    assert np.abs(found_v - y).max() <= 0.5 and np.abs(found_u - x).max() <= 0.5


@pytest.mark.parametrize('values', [(0.0, 1.0), (np.nan, 1.0), (-5.0, 1.0)])
def test_uncalibrated_cameras_are_refused(values: tuple[float, float]) -> None:
    with pytest.raises(CameraError, match='calibrated'):
        PinholeCamera(64, 48, *values, 32, 24)


def test_camera_file(tmp_path: Path) -> None:
    path = tmp_path / 'camera.yaml'
    path.write_text('width: 64\nheight: 48\nfx: 60\nfy: 61\ncx: 31\ncy: 24.5\ndepth_scale: 5000\n')
    assert read_camera_file(path).calibration == CameraCalibration(CAMERA)
    assert read_camera_file(path).depth_scale == 5000.0


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('width: 64', 'missing cx, cy, fx, fy, height'),
        ('[1, 2]', 'expected a mapping'),
        ('width: 64\nheight: 48\nfx: 60\nfy: x\ncx: 31\ncy: 24', 'could not convert'),
        ('width: 64\nheight: 48\nfx: 60\nfy: 61\ncx: 31\ncy: 24\nscale: 2', 'unknown scale'),
        ('width: 64\nheight: 48\nfx: 60\nfy: 61\ncx: 31\ncy: 24\ndepth_scale: 0', 'must be positive'),
        (
            'width: 64\nheight: 48\nfx: 60\nfy: 61\ncx: 31\ncy: 24\ndistortion_model: fov\ndistortion: [1]',
            "'fov' is not one of",
        ),
    ],
)
def test_broken_camera_files(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / 'camera.yaml'
    path.write_text(text)
    with pytest.raises(CameraError, match=message):
        read_camera_file(path)
