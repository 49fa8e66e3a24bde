"""Depth with a grid of holes: how far apart its readings are, and how such an image is made smaller.

Depth that was registered by forward warping from a smaller image has a reading at every second or third row and column only. A
dense image has readings wherever the sensor sees a surface, and larger holes where it does not. Readings are also missing along
the edges of objects; where an image is small, these thin lines are a large part of it.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

WINDOW = 12
"""Side in pixels of the square in which readings are counted. Grids of every second, third or fourth pixel fit into it."""

MAX_THIN_HOLES = 0.1
"""As a fraction of the surface: more holes of one or two pixels' width may be a grid. Shadows and windows are wider."""

MIN_LOCAL_HOLES = 0.08
"""As a fraction of the surface around a pixel: half of what an empty row and an empty column take of a square of ``WINDOW``."""

MIN_SPREAD = 0.91
"""Fraction of the surface around which there are ``MIN_LOCAL_HOLES``. A grid has them all over it, edges of objects do not."""

MAX_DENSITY = 0.5
"""Mean fraction of pixels with a reading, around the readings, below which they are a grid with wider holes."""

MAX_SPACING = 8.0
"""Pixels. Readings that are farther apart are scattered, as those of a covered camera."""

DISTANCE_STEPS = 256  # of a squared pixel

REGISTER_ADVICE = (
    'if depth_image_proc registers it, set fill_upsampling_holes of its register node to true; tracking closes the holes, the map '
    'uses the readings as they are'
)


def reading_spacing(depth_m: NDArray[np.float32]) -> float:
    """Returns the mean distance in pixels between neighbouring readings of [H, W], where there are any; 1 if they are dense."""
    valid = (depth_m > 0) & (depth_m < np.inf)
    count, mask = np.count_nonzero(valid), valid.view(np.uint8)
    surface = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REFLECT)
    has_thin_holes = count < (1 - MAX_THIN_HOLES) * cv2.countNonZero(surface) and _spread(surface, mask) >= MIN_SPREAD
    if not has_thin_holes and count >= MAX_DENSITY * valid.size:  # around the readings there are more of them than on average
        return 1.0
    spacing = spacing_of_grid(valid)
    is_grid = has_thin_holes or spacing > MAX_DENSITY**-0.5
    return spacing if is_grid and spacing <= MAX_SPACING else 1.0


def spacing_of_grid(valid: NDArray[np.bool_]) -> float:
    """Returns the mean distance in pixels between neighbours where [H, W] is true, at least 1."""
    if not valid.any():
        return 1.0
    mask = valid.view(np.uint8)
    density = cv2.boxFilter(mask, cv2.CV_32F, (WINDOW, WINDOW), normalize=True, borderType=cv2.BORDER_REFLECT)
    return max(1.0, cv2.mean(density, mask=mask)[0] ** -0.5)


def _spread(surface: NDArray[Any], mask: NDArray[np.uint8]) -> float:
    """Returns over what fraction of the surface the thin holes are spread (see ``MIN_SPREAD``).

    Args:
        surface: [H, W] 1 where there is a reading or a thin hole.
        mask: [H, W] 1 where there is a reading.
    """
    count, num_holes = (
        cv2.boxFilter(image, cv2.CV_32F, (WINDOW, WINDOW), normalize=False, borderType=cv2.BORDER_REFLECT)
        for image in (surface, surface - mask)
    )
    return cv2.mean((num_holes >= MIN_LOCAL_HOLES * count).view(np.uint8), mask=surface)[0]


def shrunk_readings(depth_m: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """Shrinks depth [H, W] to [height, width]: each pixel gets the reading nearest to its centre in the area that it covers.

    The pixel nearest to the centre may be a hole in every area. No reading is used twice. 0 is no reading.
    """
    v, u = np.nonzero(depth_m)
    (rows, down), (columns, right) = _areas(v, depth_m.shape[0], height), _areas(u, depth_m.shape[1], width)
    distance = (DISTANCE_STEPS * (down**2 + right**2)).astype(np.int64)
    candidates = distance * depth_m.size + v * depth_m.shape[1] + u  # ordered by distance, then by position
    none = np.iinfo(np.int64).max
    nearest = np.full(width * height, none)
    np.minimum.at(nearest, rows * width + columns, candidates)
    found, readings = nearest < none, np.zeros(width * height, np.float32)
    readings[found] = depth_m.ravel()[nearest[found] % depth_m.size]
    return readings.reshape(height, width)


def describe_spacing(spacing: float) -> str:
    """Returns the warning about a grid of holes."""
    return f'depth has a grid of holes: of the pixels that see a surface {1 / spacing**2:.0%} have a reading; {REGISTER_ADVICE}'


def _areas(pixels: NDArray[np.int64], size: int, new_size: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Returns [K] the new pixel whose area holds each old one, and the distance from its centre in old pixels."""
    step, position = size / new_size, pixels + 0.5
    owners = np.minimum((position / step).astype(np.int64), new_size - 1)
    return owners, position - (owners + 0.5) * step
