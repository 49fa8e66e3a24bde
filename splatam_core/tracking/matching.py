"""Matches the descriptors of two images: those that are each other's nearest."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from splatam_core.rasterizer.native import has_extension, match_descriptors


@dataclass(frozen=True, slots=True, eq=False)
class DescriptorPairs:
    """Descriptors that belong together, in the order of the first image.

    Attributes:
        first: [K] which of the first image.
        second: [K] which of the second.
        distance: [K] how many of their 256 bits differ.
    """

    first: NDArray[np.intp]
    second: NDArray[np.intp]
    distance: NDArray[np.int32]


def matched(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> DescriptorPairs:
    """Returns the mutually nearest descriptors of two images, [N, 32] and [M, 32]; of equally near ones the first counts."""
    if has_extension():
        partners, distances = match_descriptors(first, second)
        found = np.flatnonzero(partners >= 0)
        return DescriptorPairs(found, partners[found].astype(np.intp), distances[found])
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)  # the same in four times the time
    pairs = matcher.match(first, second) if len(second) else ()  # which OpenCV refuses
    indices = np.array([(pair.queryIdx, pair.trainIdx) for pair in pairs], np.intp).reshape(-1, 2)
    return DescriptorPairs(indices[:, 0], indices[:, 1], np.array([pair.distance for pair in pairs], np.int32))
