"""Decodes RVL, the lossless compression of 16-bit depth that ``compressed_depth_image_transport`` offers.

Source: A. D. Wilson, "Fast Lossless Depth Image Compression", ISS 2017. The stream is a sequence of numbers: how many
pixels without reading follow, how many with one, then for each of these the difference from the reading before it, and so on
until every pixel is known. A difference ``d`` is stored as ``2 d`` or, if negative, ``-2 d - 1``. A number is
stored in nibbles of three bits each, the lowest bits first; bit 3 of a nibble says that another one follows. Nibbles fill 32-bit
words from the highest bits down. The transport puts width and height before the stream; all words are little-endian.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from msg_adapters.errors import MessageError

_SIZE = struct.Struct('<II')
_LONGEST_NUMBER = 11  # nibbles in a number of 32 bits


def stated_size(data: bytes) -> tuple[int, int]:
    """Returns the width and height that the data state.

    Raises:
        MessageError: there are too few bytes.
    """
    if len(data) < _SIZE.size:
        raise MessageError(f'RVL depth image has {len(data)} bytes; it is truncated')
    width, height = _SIZE.unpack_from(data)
    return width, height


def decode(data: bytes) -> NDArray[np.uint16]:
    """Decode an image to [H, W] counts; 0 = no reading. Check ``stated_size`` before: so many pixels are allocated.

    Raises:
        MessageError: the data are truncated or damaged.
    """
    width, height = stated_size(data)
    numbers = _numbers(data[_SIZE.size :])
    zeros, readings, is_difference = _runs(numbers, width * height)
    counts = np.zeros(width * height, np.uint16)
    is_reading = np.repeat(np.tile([False, True], len(zeros)), np.stack([zeros, readings], axis=1).reshape(-1))
    stored = numbers[: len(is_difference)][is_difference]
    counts[is_reading] = np.cumsum((stored >> 1) ^ -(stored & 1)) & 0xFFFF
    return counts.reshape(height, width)


def _numbers(data: bytes) -> NDArray[np.int64]:
    """Returns the numbers of the stream. Zeros at its end may be padding."""
    words = np.frombuffer(data[: len(data) // 4 * 4], '<u4').astype('>u4').view(np.uint8)
    nibbles = np.stack([words >> 4, words & 15], axis=1).reshape(-1)
    last = np.flatnonzero(nibbles < 8)
    if not last.size:
        raise _damaged('no number is complete')
    first = np.concatenate([[0], last[:-1] + 1])
    if int((last - first).max()) >= _LONGEST_NUMBER:
        raise _damaged('a number has more than 32 bits')
    nibbles = nibbles[: last[-1] + 1]
    place = np.arange(nibbles.size) - np.repeat(first, last - first + 1)
    return np.asarray(np.add.reduceat((nibbles & 7).astype(np.int64) << (3 * place), first), np.int64)


def _runs(numbers: NDArray[np.int64], num_pixels: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Returns the lengths of the runs without and with readings, and which of the numbers are differences."""
    values = numbers.tolist()
    zeros: list[int] = []
    readings: list[int] = []
    at, left = 0, num_pixels
    while left > 0:
        if at + 1 >= len(values) or values[at] + values[at + 1] > left or at + 2 + values[at + 1] > len(values):
            raise _damaged(f'{left} of {num_pixels} pixels are missing')
        zeros.append(values[at])
        readings.append(values[at + 1])
        left -= values[at] + values[at + 1]
        at += 2 + values[at + 1]
    is_difference = np.ones(at, np.bool_)
    starts = np.cumsum([0, *(2 + count for count in readings)])[:-1]
    is_difference[starts] = is_difference[starts + 1] = False
    return np.array(zeros, np.int64), np.array(readings, np.int64), is_difference


def _damaged(why: str) -> MessageError:
    return MessageError(f'RVL depth image is truncated or damaged: {why}')
