"""Features of an image: ORB (Rublee et al. 2011), as OpenCV finds them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_PATCH_PX = 31
"""Side of what a feature describes. Smaller images have none, and OpenCV cannot shrink those of a few pixels."""


def orb_features(
    rgb: NDArray[np.uint8], max_features: int, fast_threshold: int
) -> tuple[Sequence[Any], NDArray[np.uint8] | None]:  # fmt: skip
    """Finds the features of an image.

    Args:
        rgb: [H, W, 3] uint8.
        max_features: OpenCV returns more only at a tie.
        fast_threshold: of corners, in steps of 255; the default of OpenCV, 20, finds little in a blurred image.

    Returns:
        The K keypoints and their [K, 32] descriptors; None in place of no descriptors.
    """
    if min(rgb.shape[:2]) < _PATCH_PX:
        return (), None
    orb = cv2.ORB.create(max_features, fastThreshold=fast_threshold)
    keypoints, descriptors = orb.detectAndCompute(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), None)
    return keypoints, None if descriptors is None else descriptors.astype(np.uint8, copy=False)
