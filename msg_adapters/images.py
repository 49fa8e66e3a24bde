"""Converts images to and from ``sensor_msgs/Image`` and ``sensor_msgs/CompressedImage``.

Colour is [H, W, 3] uint8 RGB, depth [H, W] float32 metres with 0 = no reading. Decoded depth has no NaN, inf or
negative values.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters import compressed, encodings, stamps
from msg_adapters.compressed import compressed_color_message, compressed_depth_message
from msg_adapters.encodings import MILLIMETRE, Depth, DepthEncoding, Rgb
from msg_adapters.errors import MessageError
from msg_adapters.factory import MessageFactory
from msg_adapters.image_headers import Size
from msg_adapters.pixels import checked_depth, checked_mono, checked_rgb, millimetres

__all__ = [
    'color_message',
    'compressed_color_message',
    'compressed_depth_message',
    'decode_color',
    'decode_depth',
    'depth_message',
    'mono_message',
]


def decode_color(message: Any, *, camera_size: Size | None = None, rgb_encoding: str | None = None) -> Rgb:
    """Decode an Image or CompressedImage to [H, W, 3] uint8 RGB; a contiguous copy, not a view of the message.

    Pixels stay as they are stored: an orientation in a JPEG is ignored, because CameraInfo describes the stored image.

    Args:
        message: the image.
        camera_size: width and height of the camera's images, if known. Others are refused before they are decoded.
        rgb_encoding: how to read 8UC3 and 8UC4: ``bgr8`` (also if None) or ``rgb8``.

    Raises:
        MessageError: the encoding or format is no supported colour one, or the data do not fit it.
    """
    if _is_raw(message):
        return encodings.decode(message, encodings.color_encodings(rgb_encoding), 'colour')
    return compressed.decode_color(message, camera_size)


def decode_depth(message: Any, metres_per_count: float = MILLIMETRE, *, camera_size: Size | None = None) -> Depth:
    """Decode an Image or CompressedImage to [H, W] float32 metres, 0 = no reading; a copy, not a view of the message.

    Args:
        message: the image.
        metres_per_count: length of one count of 16UC1 and mono16; a millimetre by REP 118. 32FC1 is always in metres.
        camera_size: width and height of the camera's images, if known. Much larger ones are refused before they are decoded.

    Raises:
        MessageError: the encoding or format is no supported depth one, or the data do not fit it.
    """
    if _is_raw(message):
        return encodings.decode(message, encodings.depth_encodings(metres_per_count), 'depth')
    return compressed.decode_depth(message, metres_per_count, camera_size)


def _is_raw(message: Any) -> bool:
    """Returns True for an Image. rclpy and rosbags have different classes, but only Image has an encoding."""
    return hasattr(message, 'encoding')


def color_message(factory: MessageFactory, rgb: Rgb, stamp_ns: int, frame_id: str) -> Any:
    """Make an rgb8 ``sensor_msgs/Image`` of [H, W, 3] uint8.

    Raises:
        MessageError: the image has another shape or type.
    """
    return _image(factory, checked_rgb(rgb), 'rgb8', stamp_ns, frame_id)


def mono_message(factory: MessageFactory, image: NDArray[np.uint8], stamp_ns: int, frame_id: str) -> Any:
    """Make a mono8 ``sensor_msgs/Image`` of [H, W] uint8.

    Raises:
        MessageError: the image has another shape or type.
    """
    return _image(factory, checked_mono(image), 'mono8', stamp_ns, frame_id)


def depth_message(
    factory: MessageFactory,
    depth_m: Depth,
    stamp_ns: int,
    frame_id: str,
    encoding: DepthEncoding = '32FC1',
) -> Any:
    """Make a depth ``sensor_msgs/Image`` of [H, W] metres, 0 = no reading.

    32FC1 keeps every value; 16UC1 rounds to whole millimetres (beyond 65.535 m: no reading).

    Raises:
        MessageError: the image has another shape or type, or the encoding is neither of the two.
    """
    depth_m = encodings.clean_metres(checked_depth(depth_m))
    if encoding == '32FC1':
        return _image(factory, depth_m, encoding, stamp_ns, frame_id)
    if encoding == '16UC1':
        return _image(factory, millimetres(depth_m), encoding, stamp_ns, frame_id)
    raise MessageError(f"depth encoding '{encoding}' must be 32FC1 or 16UC1")


def _image(factory: MessageFactory, pixels: NDArray[Any], encoding: str, stamp_ns: int, frame_id: str) -> Any:
    """Make an unpadded little-endian image of [H, W, ...] pixels, contiguous or not."""
    little_endian = np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder('<'))
    height, width = pixels.shape[:2]
    return factory.make(
        'sensor_msgs/msg/Image',
        header=stamps.header(factory, stamp_ns, frame_id),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=0,
        step=little_endian.nbytes // height,
        data=little_endian.reshape(-1).view(np.uint8),
    )
