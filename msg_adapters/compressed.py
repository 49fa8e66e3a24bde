"""Reads and makes ``sensor_msgs/CompressedImage`` as image_transport's plugins do: JPEG and PNG, and PNG or RVL depth.

The format field is ``rgb8; jpeg compressed bgr8``, ``16UC1; png compressed``, ``32FC1; compressedDepth png``,
``16UC1; compressedDepth rvl`` or just ``jpeg``. The compressedDepth data start with 12 bytes: an int32 and the floats
A and B. Stored counts are millimetres for 16UC1; for 32FC1 they are inverse depth, ``count = A / metres + B``, 0 = no reading.
"""

from __future__ import annotations

import struct
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from msg_adapters import rvl, stamps
from msg_adapters.encodings import Depth, DepthEncoding, Rgb, clean_metres, metres_from_counts
from msg_adapters.errors import MessageError
from msg_adapters.factory import MessageFactory
from msg_adapters.image_headers import JPEG, PNG, Size, is_cut, stated_size
from msg_adapters.image_size import check_color_size, check_depth_size
from msg_adapters.pixels import checked_depth, checked_rgb, millimetres

_CONFIG = struct.Struct('<iff')
_LARGEST_COUNT = 65535


def decode_color(message: Any, camera_size: Size | None = None) -> Rgb:
    """Decode a JPEG or PNG to [H, W, 3] RGB, without turning it as its EXIF data say.

    Args:
        message: the image.
        camera_size: width and height of the camera's images, if known.

    Raises:
        MessageError: the message holds depth, another codec, or damaged data, or states another size.
    """
    if 'compressedDepth' in message.format:
        raise MessageError(f"colour image has format '{message.format}', which is depth; check the topics' remapping")
    data = bytes(message.data)
    check_color_size(_size(data, message.format), camera_size)
    bgr = _decoded(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION, message.format)
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)


def decode_depth(message: Any, metres_per_count: float, camera_size: Size | None = None) -> Depth:
    """Decode a PNG or RVL image to [H, W] metres, 0 = no reading.

    Args:
        message: the image.
        metres_per_count: length of one count of 16UC1 and mono16.
        camera_size: width and height of the camera's images, if known.

    Raises:
        MessageError: the message holds colour, another codec, or damaged data, or states a much larger size.
    """
    data, depth_format = bytes(message.data), message.format
    if 'compressedDepth' not in depth_format:
        return metres_from_counts(metres_per_count, _depth_counts(data, depth_format, camera_size))
    if len(data) < _CONFIG.size:
        raise MessageError(f"depth image with format '{depth_format}' has {len(data)} bytes; it is truncated")
    _, a, b = _CONFIG.unpack_from(data)
    counts = _depth_counts(data[_CONFIG.size :], depth_format, camera_size)
    encoding = depth_format.split(';')[0].strip()
    if encoding in ('16UC1', 'mono16'):
        return metres_from_counts(metres_per_count, counts)
    if encoding == '32FC1':
        return _metres_from_inverse(counts, a, b)
    raise MessageError(f"depth image has format '{depth_format}'; it must begin with 16UC1, mono16 or 32FC1")


def _metres_from_inverse(counts: NDArray[np.uint16], a: float, b: float) -> Depth:
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        depth_m = np.float32(a) / (counts.astype(np.float32) - np.float32(b))
    return clean_metres(np.where(counts > 0, depth_m, np.float32(0)))


def _depth_counts(data: bytes, depth_format: str, camera_size: Size | None) -> NDArray[np.uint16]:
    if 'rvl' in depth_format.lower():
        check_depth_size(rvl.stated_size(data), camera_size)
        return rvl.decode(data)
    check_depth_size(_size(data, depth_format), camera_size)
    counts = _decoded(data, cv2.IMREAD_UNCHANGED, depth_format)
    if counts.ndim != 2 or counts.dtype != np.uint16:
        raise MessageError(
            f"depth image with format '{depth_format}' holds {counts.dtype} pixels of shape {counts.shape}; "
            'depth must be one 16-bit channel; is this the depth topic?'
        )
    return counts


def _size(data: bytes, image_format: str) -> Size:
    """Returns the size that the image states in its header."""
    if not data.startswith((JPEG, PNG)):
        raise MessageError(f"compressed image with format '{image_format}' holds neither JPEG nor PNG data")
    size = stated_size(data)
    if size is None:
        raise _damaged(data, image_format)
    return size


def _decoded(data: bytes, flags: int, image_format: str) -> NDArray[Any]:
    if is_cut(data) or not _is_complete(data):
        raise _damaged(data, image_format)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:
        image = None
    if image is None or image.shape[1::-1] != stated_size(data):
        raise _damaged(data, image_format)
    return image


def _damaged(data: bytes, image_format: str) -> MessageError:
    return MessageError(f"compressed image with format '{image_format}' ({len(data)} bytes) is truncated or damaged")


def _is_complete(data: bytes) -> bool:
    """Returns True if an end marker follows the pixels; OpenCV before 4.12 fills missing pixels with grey."""
    end, start = (b'\xff\xd9', b'\xff\xda') if data.startswith(JPEG) else (b'IEND', b'IDAT')
    return data.rfind(end) > data.find(start) > 0 and data.rfind(end) > data.rfind(start)


def compressed_color_message(
    factory: MessageFactory,
    rgb: Rgb,
    stamp_ns: int,
    frame_id: str,
    format: Literal['jpeg', 'png'] = 'jpeg',
    jpeg_quality: int = 95,
) -> Any:
    """Make a ``sensor_msgs/CompressedImage`` of [H, W, 3] uint8 RGB, as image_transport's compressed plugin does.

    Raises:
        MessageError: the image has another shape or type, or the format is neither jpeg nor png.
    """
    if format not in ('jpeg', 'png'):
        raise MessageError(f"compressed colour format '{format}' must be jpeg or png")
    options = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if format == 'jpeg' else []
    _, data = cv2.imencode(f'.{format}', cv2.cvtColor(checked_rgb(rgb), cv2.COLOR_RGB2BGR), options)
    return _message(factory, stamp_ns, frame_id, f'rgb8; {format} compressed bgr8', data)


def compressed_depth_message(
    factory: MessageFactory,
    depth_m: Depth,
    stamp_ns: int,
    frame_id: str,
    encoding: DepthEncoding = '16UC1',
) -> Any:
    """Make a ``sensor_msgs/CompressedImage`` of [H, W] metres, as image_transport's compressedDepth plugin does.

    16UC1 rounds to whole millimetres (beyond 65.535 m: no reading). 32FC1 stores inverse depth: with the nearest
    reading at ``z0``, the rounding error at depth ``z`` is at most ``z**2 / (131070 z0)``.

    Raises:
        MessageError: the image has another shape or type, or the encoding is neither of the two.
    """
    depth_m = clean_metres(checked_depth(depth_m))
    if encoding == '16UC1':
        a, counts = 0.0, millimetres(depth_m)
    elif encoding == '32FC1':
        a, counts = _inverse_counts(depth_m)
    else:
        raise MessageError(f"compressed depth encoding '{encoding}' must be 16UC1 or 32FC1")
    _, png = cv2.imencode('.png', counts)
    data = np.concatenate([np.frombuffer(_CONFIG.pack(0, a, 0.0), np.uint8), png.reshape(-1)])
    return _message(factory, stamp_ns, frame_id, f'{encoding}; compressedDepth png', data)


def _inverse_counts(depth_m: Depth) -> tuple[float, NDArray[np.uint16]]:
    """Returns A and [H, W] counts with ``metres = A / count``; the nearest reading has the largest count."""
    is_reading = depth_m > 0
    if not is_reading.any():
        return 0.0, np.zeros(depth_m.shape, np.uint16)
    a = float(np.float32(_LARGEST_COUNT * float(depth_m[is_reading].min())))
    inverse = np.divide(a, depth_m, out=np.zeros(depth_m.shape), where=is_reading)
    return a, np.minimum(np.rint(inverse), _LARGEST_COUNT).astype(np.uint16)


def _message(factory: MessageFactory, stamp_ns: int, frame_id: str, image_format: str, data: NDArray[np.uint8]) -> Any:
    return factory.make(
        'sensor_msgs/msg/CompressedImage',
        header=stamps.header(factory, stamp_ns, frame_id),
        format=image_format,
        data=data.reshape(-1),
    )
