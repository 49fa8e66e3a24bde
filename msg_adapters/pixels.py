"""Checks and converts arrays that are put into image messages."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from msg_adapters.encodings import MILLIMETRES_PER_METRE, Depth, Rgb
from msg_adapters.errors import MessageError
from msg_adapters.image_size import check_size


def checked_rgb(image: NDArray[Any]) -> Rgb:
    """Returns the image if it is [H, W, 3] uint8 of a size that can be read back, else raises ``MessageError``."""
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8 or not image.size:
        raise _wrong('colour image', image, '[H, W, 3] uint8')
    return _of_a_size('colour image', image)


def checked_mono(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Returns the image if it is [H, W] uint8 of a size that can be read back, else raises ``MessageError``."""
    if image.ndim != 2 or image.dtype != np.uint8 or not image.size:
        raise _wrong('mono image', image, '[H, W] uint8')
    return _of_a_size('mono image', image)


def checked_depth(image: NDArray[Any]) -> NDArray[np.floating[Any]]:
    """Returns the image if it is [H, W], floating-point and of a size that can be read back, else raises ``MessageError``."""
    if image.ndim != 2 or image.dtype.kind != 'f' or not image.size:
        raise _wrong('depth image', image, '[H, W] float32 metres')
    return _of_a_size('depth image', image)


def millimetres(depth_m: Depth) -> NDArray[np.uint16]:
    """Round [H, W] clean metres to whole millimetres; values that do not fit 16 bits become 0, no reading."""
    depth_mm = np.rint(depth_m * MILLIMETRES_PER_METRE)
    return np.where(depth_mm < 2**16, depth_mm, 0).astype(np.uint16)


def _of_a_size(name: str, image: NDArray[Any]) -> NDArray[Any]:
    check_size(name, image.shape[1::-1])
    return image


def _wrong(name: str, image: NDArray[Any], expected: str) -> MessageError:
    return MessageError(f'{name} has shape {image.shape} and type {image.dtype}; expected {expected}')
