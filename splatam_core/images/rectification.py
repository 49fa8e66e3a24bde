"""Turns recorded images into frames of an ideal camera: rectifies, registers and resizes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from msg_adapters.image_headers import MAX_PIXELS
from splatam_core.errors import CameraError, FrameError
from splatam_core.geometry.camera import MAX_SIDE, CameraCalibration, PinholeCamera
from splatam_core.images.spacing import reading_spacing, shrunk_readings
from splatam_core.types import RgbdFrame

Value = TypeVar('Value', np.uint8, np.float32)
MIN_SIDE = 16


@dataclass(frozen=True)
class FrameFactory:
    """Makes frames of one ideal camera from the images of one real camera.

    Rectifies (colour bilinear, depth nearest) and resizes (colour by area when shrinking, depth nearest; where depth is a grid
    with holes, the nearest reading). Depth is measured along the optical axis, so rectification moves readings but keeps their
    values.

    Attributes:
        calibration: the camera that took the images.
        width: width of the frames in pixels; None keeps the recorded size. The height keeps the aspect ratio.
        depth_camera: the ideal camera of the depth images, if it differs from that of colour. It has the same centre and axes,
            so that readings only move to other pixels.
        rectified: the ideal camera to rectify to, in the recorded size, if it is not the calibration's own. With it, images
            whose cameras differ slightly become frames of one camera.
    """

    calibration: CameraCalibration
    width: int | None = None
    depth_camera: PinholeCamera | None = None
    rectified: PinholeCamera | None = None

    def __post_init__(self) -> None:
        if self.width is not None and not MIN_SIDE <= self.width <= MAX_SIDE:
            raise CameraError(f'width {self.width}: frames must be at least {MIN_SIDE} and at most {MAX_SIDE} pixels wide')
        camera = self.camera
        if camera.width * camera.height > MAX_PIXELS:
            raise CameraError(f'frames would be {camera.width}x{camera.height}: at most {MAX_PIXELS} pixels; choose another width')

    @cached_property
    def camera(self) -> PinholeCamera:
        """The ideal camera of every frame made here."""
        pinhole = self._pinhole
        if self.width is None or self.width == pinhole.width:
            return pinhole
        return pinhole.resized(self.width, max(1, round(pinhole.height * self.width / pinhole.width)))

    @property
    def _pinhole(self) -> PinholeCamera:
        return self.rectified or self.calibration.pinhole

    @cached_property
    def _maps(self) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
        """The position in a recorded image of each rectified pixel: x and y, [H, W] each; None if nothing moves."""
        calibration, pinhole = self.calibration, self._pinhole
        if not calibration.is_distorted and pinhole == calibration.pinhole:
            return None
        undistort = (
            cv2.fisheye.initUndistortRectifyMap if calibration.distortion_model == 'equidistant' else cv2.initUndistortRectifyMap
        )
        distortion = np.array(calibration.distortion if calibration.is_distorted else [0.0] * 4)
        size = pinhole.width, pinhole.height
        x, y = undistort(calibration.pinhole.matrix, distortion, np.eye(3), pinhole.matrix, size, cv2.CV_32FC1)
        return np.asarray(x, np.float32), np.asarray(y, np.float32)

    @cached_property
    def _depth_maps(self) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
        """As ``_maps``, for depth images."""
        if self.depth_camera is None:
            return self._maps
        to, of = self._pinhole, self.depth_camera
        x = (np.arange(to.width) - to.cx) / to.fx * of.fx + of.cx
        y = (np.arange(to.height) - to.cy) / to.fy * of.fy + of.cy
        x, y = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
        return x, y

    def make(self, stamp_ns: int, rgb: NDArray[np.uint8], depth_m: NDArray[np.float32]) -> RgbdFrame:
        """Makes one frame.

        Args:
            stamp_ns: time of the exposure, nanoseconds.
            rgb: [H, W, 3] in the recorded size.
            depth_m: [H, W] metres, registered to colour; its resolution may differ. With a ``depth_camera``, it has that
                camera's size. 0, NaN and inf are no reading.

        Raises:
            FrameError: colour does not have the size of the calibration, or depth not its aspect ratio or camera's size.
        """
        pinhole = self.calibration.pinhole
        if rgb.shape[:2] != (pinhole.height, pinhole.width):
            raise FrameError(
                f'colour image is {_size(rgb)} but the camera is calibrated for {pinhole.width}x{pinhole.height}; '
                'does the camera info belong to this image?'
            )
        if self.depth_camera is None:
            depth_m = self._at_colour_size(depth_m)
        else:
            _check_depth_size(depth_m, self.depth_camera)
        if self._maps is not None:
            rgb = _remapped(rgb, self._maps, cv2.INTER_LINEAR)
        if self._depth_maps is not None:
            depth_m = _remapped(depth_m, self._depth_maps, cv2.INTER_NEAREST)
        size, spacing = (self.camera.width, self.camera.height), 1.0
        if size != (self._pinhole.width, self._pinhole.height):
            shrinking = size[0] < self._pinhole.width
            rgb = _resized(rgb, size, cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR)
            spacing = reading_spacing(depth_m) if shrinking else 1.0
            if spacing == 1.0:
                depth_m = _resized(depth_m, size, cv2.INTER_NEAREST_EXACT)
            else:
                depth_m = shrunk_readings(_clean(depth_m), *size)
        return RgbdFrame(stamp_ns, np.ascontiguousarray(rgb), _clean(depth_m), self.camera, depth_spacing=spacing)

    def _at_colour_size(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        width, height = self.calibration.pinhole.width, self.calibration.pinhole.height
        if depth_m.shape == (height, width):
            return depth_m
        if abs(depth_m.shape[0] - height * depth_m.shape[1] / width) >= 1:  # one row: halving an odd size rounds
            raise FrameError(
                f'depth image is {_size(depth_m)}, which does not have the aspect ratio of the {width}x{height} colour image, so '
                'it is not registered to it; use the depth that the driver aligns to colour (RealSense: '
                'aligned_depth_to_color, Azure Kinect: depth_to_rgb)'
            )
        return _resized(depth_m, (width, height), cv2.INTER_NEAREST_EXACT)


class FrameFactories:
    """Gives frames of one ideal camera while the calibration of the real one changes slightly, as with autofocus.

    The first calibration states the ideal camera. One that differs more is another camera, with frames of its own.
    """

    NUM_CAMERAS = 8

    def __init__(self, width: int | None = None) -> None:
        """Start without cameras.

        Args:
            width: width of the frames in pixels; None keeps the recorded size.
        """
        self._width = width
        self._cameras: list[CameraCalibration] = []
        self._newest: FrameFactory | None = None

    def of(self, calibration: CameraCalibration) -> FrameFactory:
        """Returns the factory for images of a calibration.

        Raises:
            CameraError: the width cannot be used.
        """
        if self._newest is None or self._newest.calibration != calibration:
            first = next((camera for camera in self._cameras if camera.is_close_to(calibration)), None)
            if first is None:
                first = calibration
                self._cameras = [*self._cameras, calibration][-self.NUM_CAMERAS :]
            self._newest = FrameFactory(calibration, self._width, rectified=first.pinhole)
        return self._newest


def _size(image: NDArray[Any]) -> str:
    return f'{image.shape[1]}x{image.shape[0]}'


def _check_depth_size(depth_m: NDArray[np.float32], camera: PinholeCamera) -> None:
    if depth_m.shape != (camera.height, camera.width):
        raise FrameError(f'depth image is {_size(depth_m)} but its camera is calibrated for {camera.width}x{camera.height}')


def kept(depth_m: NDArray[np.floating[Any]], chosen: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Returns [H, W] the chosen readings, 0 elsewhere; numpy takes ten times as long where the chosen ones are scattered."""
    return np.asarray(cv2.copyTo(depth_m.astype(np.float32, copy=False), chosen.view(np.uint8)), np.float32)


def _clean(depth_m: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    """Returns [H, W] with 0 where there is no reading; the image itself where that is so already, as decoders leave it."""
    if depth_m.dtype == np.float32 and depth_m.flags.carray and depth_m.min() >= 0 and depth_m.max() < np.inf:  # false for NaN
        return np.asarray(depth_m, np.float32)
    return kept(depth_m, (depth_m > 0) & (depth_m < np.inf))


def _resized(image: NDArray[Value], size: tuple[int, int], interpolation: int) -> NDArray[Value]:
    """Resizes to (width, height). INTER_NEAREST_EXACT is by pixel centres; INTER_NEAREST would shift by half a pixel."""
    return np.asarray(cv2.resize(image, size, interpolation=interpolation), image.dtype)


def _remapped(image: NDArray[Value], maps: tuple[NDArray[np.float32], NDArray[np.float32]], interpolation: int) -> NDArray[Value]:
    return np.asarray(cv2.remap(image, *maps, interpolation), image.dtype)
