"""The supported encodings of ``sensor_msgs/Image``, and the conversion of its bytes to pixels."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from msg_adapters.errors import MessageError

Rgb = NDArray[np.uint8]
Depth = NDArray[np.float32]
DepthEncoding = Literal['16UC1', '32FC1']
"""The encodings in which depth images are made."""

MILLIMETRES_PER_METRE = np.float32(1000)
MILLIMETRE = 0.001


@dataclass(frozen=True, slots=True)
class Encoding:
    """How pixels are stored and converted.

    Attributes:
        dtype: type of one channel, without byte order.
        channels: channels per pixel.
        convert: converts [H, W] or [H, W, channels] pixels in native byte order to RGB or metres, as a new array.
        width_multiple: widths must be a multiple of this, because neighbouring pixels share their colour.
    """

    dtype: str
    channels: int
    convert: Callable[[NDArray[Any]], NDArray[Any]]
    width_multiple: int = 1


def metres_from_counts(metres_per_count: float, counts: NDArray[np.uint16]) -> Depth:
    """Convert [H, W] counts of some length to metres; 0 stays 0, no reading."""
    return counts.astype(np.float32) / np.float32(1 / metres_per_count)  # 1000 and 5000 are exact, 0.001 is not


def clean_metres(depth_m: NDArray[np.floating[Any]]) -> Depth:
    """Returns a copy in which NaN, inf and negative values are 0, no reading."""
    with np.errstate(over='ignore'):  # values beyond float32 become inf, so no reading
        depth_m = depth_m.astype(np.float32, copy=False)
    clean = np.zeros(depth_m.shape, np.float32)
    np.copyto(clean, depth_m, where=(depth_m > 0) & (depth_m < np.inf))
    return clean


def _converted(code: int, image: Rgb) -> Rgb:
    return np.asarray(cv2.cvtColor(image, code), np.uint8)


def _color(channels: int, code: int, width_multiple: int = 1) -> Encoding:
    return Encoding('u1', channels, partial(_converted, code), width_multiple)


COLOR: Mapping[str, Encoding] = {
    'rgb8': Encoding('u1', 3, np.copy),
    'bgr8': _color(3, cv2.COLOR_BGR2RGB),
    'rgba8': _color(4, cv2.COLOR_RGBA2RGB),
    'bgra8': _color(4, cv2.COLOR_BGRA2RGB),
    'mono8': _color(1, cv2.COLOR_GRAY2RGB),
    # ROS names a Bayer pattern by its first pixels, OpenCV's old names by those from the second row and column on.
    'bayer_rggb8': _color(1, cv2.COLOR_BayerBG2RGB),
    'bayer_bggr8': _color(1, cv2.COLOR_BayerRG2RGB),
    'bayer_gbrg8': _color(1, cv2.COLOR_BayerGR2RGB),
    'bayer_grbg8': _color(1, cv2.COLOR_BayerGB2RGB),
    'yuv422': _color(2, cv2.COLOR_YUV2RGB_UYVY, width_multiple=2),
    'uyvy': _color(2, cv2.COLOR_YUV2RGB_UYVY, width_multiple=2),
    'yuv422_yuy2': _color(2, cv2.COLOR_YUV2RGB_YUY2, width_multiple=2),
    'yuyv': _color(2, cv2.COLOR_YUV2RGB_YUY2, width_multiple=2),
}


ORDERED: Mapping[str, tuple[str, str]] = {'8UC3': ('bgr8', 'rgb8'), '8UC4': ('bgra8', 'rgba8')}
"""OpenCV's names of colour images, which do not say the order of the channels: the encodings they can stand for."""

RGB_ENCODINGS = ('bgr8', 'rgb8')
"""What users can state about such images."""


def color_encodings(stated: str | None) -> Mapping[str, Encoding]:
    """Returns the encodings of colour images.

    Args:
        stated: how images are read whose encoding does not say the order of its channels: ``bgr8`` (also if None) or ``rgb8``.
    """
    position = 1 if stated == 'rgb8' else 0
    return {**COLOR, '8UC1': COLOR['mono8'], **{name: COLOR[choice[position]] for name, choice in ORDERED.items()}}


def depth_encodings(metres_per_count: float) -> Mapping[str, Encoding]:
    """Returns the encodings of depth images: 16-bit counts of some length, and floats in metres."""
    counts = Encoding('u2', 1, partial(metres_from_counts, metres_per_count))
    return {'16UC1': counts, 'mono16': counts, '32FC1': Encoding('f4', 1, clean_metres)}


def decode(message: Any, encodings: Mapping[str, Encoding], what: str) -> NDArray[Any]:
    """Decode a ``sensor_msgs/Image`` whose encoding is one of those given.

    Args:
        message: the image.
        encodings: the supported ones.
        what: 'colour' or 'depth', for the error message.

    Raises:
        MessageError: the encoding is not supported, or size, step and data do not agree.
    """
    encoding = encodings.get(message.encoding)
    if encoding is None:
        raise MessageError(
            f"{what} image has encoding '{message.encoding}'; supported are {', '.join(encodings)}; is this the {what} topic?"
        )
    return encoding.convert(_pixels(message, encoding))


def _pixels(message: Any, encoding: Encoding) -> NDArray[Any]:
    """Returns [H, W] or [H, W, channels] pixels in native byte order, without the padding at the end of rows."""
    dtype = np.dtype(encoding.dtype).newbyteorder('>' if message.is_bigendian else '<')
    height, width, step = int(message.height), int(message.width), int(message.step)
    row_bytes = width * encoding.channels * dtype.itemsize
    data = np.frombuffer(message.data, np.uint8)
    _check_layout(message, encoding, row_bytes, data.size)
    rows = np.ascontiguousarray(data.reshape(height, step)[:, :row_bytes]).view(dtype)
    pixels = rows.astype(dtype.newbyteorder('='), copy=False)
    return pixels if encoding.channels == 1 else pixels.reshape(height, width, encoding.channels)


def _check_layout(message: Any, encoding: Encoding, row_bytes: int, num_bytes: int) -> None:
    height, width, step = message.height, message.width, message.step
    name = f'{width}x{height} {message.encoding} image'
    if height < 1 or width < 1:
        raise MessageError(f'{name}: both sides must be at least 1 pixel')
    if width % encoding.width_multiple:
        raise MessageError(f'{name}: the width must be a multiple of {encoding.width_multiple} in this encoding')
    if step < row_bytes:
        raise MessageError(f'{name}: step is {step} bytes, but a row has {row_bytes}; the driver sets a wrong step')
    if num_bytes != height * step:
        raise MessageError(
            f'{name}: data has {num_bytes} bytes, but {height} rows of {step} are {height * step}; '
            'the image is truncated, or the driver sets a wrong size or step'
        )
