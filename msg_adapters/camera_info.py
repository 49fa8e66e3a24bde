"""Reads and makes ``sensor_msgs/CameraInfo``: the camera of the image as it was sent, binned and cropped.

A pixel's centre is its integer index: cropping subtracts the offset, binning by ``b`` maps
``f' = f / b`` and ``c' = (c + 0.5) / b - 0.5``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from msg_adapters import stamps
from msg_adapters.errors import MessageError
from msg_adapters.factory import MessageFactory
from msg_adapters.image_size import check_size

# Number of coefficients of each model; missing ones are zero.
COEFFICIENTS = {'plumb_bob': 5, 'rational_polynomial': 8, 'equidistant': 4}

# Names that recorders use, in the form of ``_plain_name``. RealSense's ROS driver publishes its models under the same names.
_SAME_MODELS = {
    'plumb_bob': 'plumb_bob', 'brown_conrady': 'plumb_bob', 'modified_brown_conrady': 'plumb_bob',
    'inverse_brown_conrady': 'plumb_bob',
    'rational_polynomial': 'rational_polynomial', 'equidistant': 'equidistant', 'kannala_brandt4': 'equidistant',
}  # fmt: skip
_MAX_PIXELS = 1e6


@dataclass(frozen=True, slots=True)
class CameraParameters:
    """What a CameraInfo states about its image.

    Attributes:
        width, height: size of the image in pixels, after binning and cropping.
        fx, fy: focal lengths in those pixels.
        cx, cy: principal point; a pixel's centre is its integer index.
        distortion_model: none, plumb_bob, rational_polynomial or equidistant.
        distortion: 0, 5, 8 or 4 coefficients in OpenCV's order.
        frame_id: the optical frame of the camera.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion_model: str = 'none'
    distortion: tuple[float, ...] = ()
    frame_id: str = ''


def parameters(message: Any, *, is_rectified: bool = False) -> CameraParameters:
    """Read a ``sensor_msgs/CameraInfo``: K and D, after binning and cropping to the region of interest.

    For images that are already rectified (``image_rect``), P is the camera; K and D describe the raw images. P is also
    used if K is all zero.

    A model whose coefficients are all zero is 'none'. This includes 'equidistant': exact zeros do not come from a
    calibration, but from a driver that publishes rectified images.

    Args:
        message: the CameraInfo.
        is_rectified: True if its images are rectified.

    Raises:
        MessageError: K (or P, for rectified images) is not calibrated, the size is zero or too large, the distortion model is
            unknown or has too many coefficients, or the region of interest is not within the image.
    """
    is_rectified = is_rectified or has_only_p(message)
    fx, cx, fy, cy = _intrinsics('P', message.p, 4) if is_rectified else _intrinsics('K', message.k, 3)
    model, coefficients = ('none', ()) if is_rectified else _distortion(message)
    full = CameraParameters(
        width=int(message.width), height=int(message.height), fx=fx, fy=fy, cx=cx, cy=cy,
        distortion_model=model, distortion=coefficients, frame_id=message.header.frame_id,
    )  # fmt: skip
    if full.width < 1 or full.height < 1:
        raise MessageError(f'CameraInfo states that the image is {full.width}x{full.height}; fill in width and height')
    camera = _binned(_cropped(full, message.roi), int(message.binning_x), int(message.binning_y))
    check_size('the image that CameraInfo states', (camera.width, camera.height))
    return camera


def has_only_p(message: Any) -> bool:
    """Returns True if K is all zero and P is not, as with cameras that publish only rectified images."""
    k, p = ([float(value) for value in matrix] for matrix in (message.k, message.p))
    return not any(k) and any(p)


def _intrinsics(name: str, matrix: Sequence[float], columns: int) -> list[float]:
    """Returns fx, cx, fy, cy of a matrix given row by row, checked."""
    values = [float(value) for value in matrix]
    if len(values) != 3 * columns:
        raise MessageError(f'CameraInfo {name} has {len(values)} values; it must have {3 * columns}')
    fx, cx, fy, cy = values[0], values[2], values[columns + 1], values[columns + 2]
    if not (np.isfinite(values).all() and fx > 0 and fy > 0):
        raise MessageError(
            f'CameraInfo {name} = {values}: focal lengths must be positive and all values finite; '
            'the camera is not calibrated, or its driver does not publish the calibration'
        )
    if any(values[index] for index in (columns, 2 * columns, 2 * columns + 1)):
        raise MessageError(
            f'CameraInfo {name} = {values}: expected fx 0 cx, 0 fy cy, 0 0 1, row by row; it is given column by column, or its '
            'pixels are not square'
        )
    if max(fx, fy, abs(cx), abs(cy)) > _MAX_PIXELS:
        raise MessageError(
            f'CameraInfo {name} = {values}: focal lengths and principal point are in pixels, at most {_MAX_PIXELS:g}; '
            'calibrate the camera'
        )
    return [fx, cx, fy, cy]


def _distortion(message: Any) -> tuple[str, tuple[float, ...]]:
    values = [float(value) for value in message.d]
    if not any(values):
        return 'none', ()
    if not np.isfinite(values).all():
        raise MessageError(f'CameraInfo D = {values}: coefficients must be finite; calibrate the camera')
    model = _SAME_MODELS.get(_plain_name(message.distortion_model))
    if model is None:
        raise MessageError(
            f"CameraInfo distortion model '{message.distortion_model}' with D = {values} is not supported; "
            f'supported are {", ".join(COEFFICIENTS)}, or any name with D all zero; rectify the images first'
        )
    count = COEFFICIENTS[model]
    if any(values[count:]):
        raise MessageError(f'CameraInfo D = {values}: {model} has {count} coefficients, the others must be zero')
    return model, tuple((values + [0.0] * count)[:count])


def _plain_name(model: str) -> str:
    return '_'.join(model.lower().replace('_', ' ').replace('-', ' ').split())


def _cropped(camera: CameraParameters, roi: Any) -> CameraParameters:
    x, y, width, height = int(roi.x_offset), int(roi.y_offset), int(roi.width), int(roi.height)
    if width == height == 0:  # in ROS: the whole image
        return camera
    if not (0 < width <= camera.width - x and 0 < height <= camera.height - y):
        raise MessageError(
            f'CameraInfo region of interest {width}x{height} at ({x}, {y}) is not within the '
            f'{camera.width}x{camera.height} image; width and height 0 mean the whole image'
        )
    return replace(camera, width=width, height=height, cx=camera.cx - x, cy=camera.cy - y)


def _binned(camera: CameraParameters, binning_x: int, binning_y: int) -> CameraParameters:
    bx, by = max(1, binning_x), max(1, binning_y)  # 0 means 1 in ROS
    if bx > camera.width or by > camera.height:
        raise MessageError(f'CameraInfo binning {bx}x{by} leaves no pixel of the {camera.width}x{camera.height} image')
    return replace(
        camera, width=camera.width // bx, height=camera.height // by, fx=camera.fx / bx, fy=camera.fy / by,
        cx=(camera.cx + 0.5) / bx - 0.5, cy=(camera.cy + 0.5) / by - 0.5,
    )  # fmt: skip


def info_message(factory: MessageFactory, camera: CameraParameters, stamp_ns: int) -> Any:
    """Make the ``sensor_msgs/CameraInfo`` of a monocular camera: R is the identity, P holds K.

    An undistorted camera is 'plumb_bob' with five zeros, as rectified ROS cameras publish it.
    """
    is_distorted = camera.distortion_model != 'none'
    k = np.array([camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1], dtype=np.float64)
    roi = factory.make('sensor_msgs/msg/RegionOfInterest', x_offset=0, y_offset=0, width=0, height=0, do_rectify=False)
    return factory.make(
        'sensor_msgs/msg/CameraInfo',
        header=stamps.header(factory, stamp_ns, camera.frame_id),
        height=camera.height,
        width=camera.width,
        distortion_model=camera.distortion_model if is_distorted else 'plumb_bob',
        d=np.array(camera.distortion if is_distorted else [0.0] * 5, dtype=np.float64),
        k=k,
        r=np.eye(3).reshape(-1),
        p=np.hstack([k.reshape(3, 3), np.zeros((3, 1))]).reshape(-1),
        binning_x=0,
        binning_y=0,
        roi=roi,
    )
