"""Reads the size that a compressed image states, and checks it, before anything is decoded or allocated."""

from __future__ import annotations

import struct

from msg_adapters.errors import MessageError

JPEG, PNG = b'\xff\xd8', b'\x89PNG'
MAX_SIDE = 16384
"""Largest width and height in pixels. OpenCV rectifies at most twice as many."""

MAX_PIXELS = 2**26
MAX_DEPTH_SIDES = 4
"""Depth may be this many times as wide and high as the camera's images."""

Size = tuple[int, int]
"""Width and height in pixels."""

_START_OF_FRAME = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
_STANDALONE = {0x01, *range(0xD0, 0xD8)}
_START_OF_SCAN, _END_OF_IMAGE = 0xDA, 0xD9


def check_size(what: str, size: Size) -> None:
    """Check a size against what can be processed.

    Args:
        what: names the image, or who states the size.
        size: the size.

    Raises:
        MessageError: it is empty or too large.
    """
    width, height = size
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and width * height <= MAX_PIXELS):
        raise MessageError(
            f'{what} is {width}x{height}; both sides must be from 1 to {MAX_SIDE} pixels, and at most {MAX_PIXELS} pixels in all'
        )


def check_color_size(size: Size, camera: Size | None) -> None:
    """Check the size of a colour image against its camera's.

    Raises:
        MessageError: it is another one, or too large.
    """
    check_size('colour image', size)
    if camera is not None and size != camera:
        raise MessageError(
            f'colour image is {size[0]}x{size[1]} but the camera is calibrated for {camera[0]}x{camera[1]}; '
            'does the camera info belong to this image?'
        )


def check_depth_size(size: Size, camera: Size | None) -> None:
    """Check the size of a depth image, which may differ from its camera's.

    Raises:
        MessageError: it is too large.
    """
    check_size('depth image', size)
    if camera is not None and (size[0] > MAX_DEPTH_SIDES * camera[0] or size[1] > MAX_DEPTH_SIDES * camera[1]):
        raise MessageError(
            f'depth image is {size[0]}x{size[1]}, more than {MAX_DEPTH_SIDES} times as large as the '
            f'{camera[0]}x{camera[1]} images of the camera; does the camera info belong to this image?'
        )


def stated_size(data: bytes) -> Size | None:
    """Returns the size that a JPEG or PNG states; None if it states none."""
    if data.startswith(PNG):
        return _png_size(data)
    return _jpeg_size(data) if data.startswith(JPEG) else None


def _png_size(data: bytes) -> Size | None:
    if len(data) < 24 or data[12:16] != b'IHDR':
        return None
    width, height = struct.unpack_from('>II', data, 16)
    return width, height


def _jpeg_size(data: bytes) -> Size | None:
    at = data.find(b'\xff', 2)
    while 0 <= at < len(data) - 9:
        marker = data[at + 1]
        if marker in _START_OF_FRAME:
            height, width = struct.unpack_from('>HH', data, at + 5)
            return width, height
        if marker in (_START_OF_SCAN, _END_OF_IMAGE):
            return None
        if marker == 0xFF:  # fill bytes before a marker
            skip = 1
        else:
            skip = 2 if marker in _STANDALONE or marker == 0 else 2 + int.from_bytes(data[at + 2 : at + 4], 'big')
        at = data.find(b'\xff', at + skip)
    return None
