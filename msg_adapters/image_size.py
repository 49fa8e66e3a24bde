"""Checks the size of an image before anything is decoded or allocated."""

from __future__ import annotations

from msg_adapters.errors import MessageError
from msg_adapters.image_headers import MAX_PIXELS, Size

MAX_SIDE = 16384
"""Largest width and height in pixels. OpenCV rectifies at most twice as many."""

MAX_DEPTH_SIDES = 4
"""Depth may be this many times as wide and high as the camera's images."""


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
