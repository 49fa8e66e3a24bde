"""A start for alignment where the predicted pose is poor: features of the frame, matched with a render of the map.

Alignment follows image gradients, so it must start within a few pixels of the true pose. Features (ORB, Rublee et al. 2011)
are matched however far they have moved, and those of the render have depth. The pose follows from them (EPnP, Lepetit et al.
2009, in RANSAC) to within some pixels, close enough for alignment. All of it is OpenCV's.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splatam_core.geometry.camera import PinholeCamera
from splatam_core.geometry.se3 import Matrix
from splatam_core.images.features import orb_features
from splatam_core.images.view import View
from splatam_core.rasterizer import Render
from splatam_core.tracking.matching import matched

_NUM_FEATURES = 1000
_FAST_THRESHOLD = 7  # of 255; the default, 20, finds little in a blurred frame
_MIN_SILHOUETTE = 0.9
_LARGEST_ERROR = 0.0125  # reprojection error of an inlier, as a fraction of the width: 4 pixels of 320
_RANSAC_ROUNDS = 300
_MIN_POINTS = 8


Features = tuple[Sequence[Any], NDArray[np.uint8] | None]
"""Keypoints and their descriptors, see ``orb_features``."""


def features_of(view: View) -> Features:
    """Returns the features of a frame."""
    return orb_features(view.rgb8.numpy(force=True), _NUM_FEATURES, _FAST_THRESHOLD)


def pose_by_features(render: Render, camera: PinholeCamera, of_frame: Features) -> Matrix | None:
    """Finds the pose of a frame by the features it has in common with a render.

    Args:
        render: the map, with the frame's camera.
        camera: the frame's.
        of_frame: see ``features_of``.

    Returns:
        [4, 4] from the render's camera to the frame's; None if too few features agree on one.
    """
    points, pixels = _matches(render, camera, of_frame)
    if len(points) < _MIN_POINTS:
        return None
    found, rotation, translation, agreeing = cv2.solvePnPRansac(
        points, pixels, camera.matrix, None, iterationsCount=_RANSAC_ROUNDS,
        reprojectionError=_LARGEST_ERROR * camera.width, flags=cv2.SOLVEPNP_EPNP,
    )  # fmt: skip
    if not found or agreeing is None or len(agreeing) < _MIN_POINTS:
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
    return T if np.isfinite(T).all() else None


def _matches(render: Render, camera: PinholeCamera, of_frame: Features) -> tuple[Matrix, Matrix]:
    """Returns [K, 3] points in the render's camera and [K, 2] the pixels of the frame that match them."""
    planes = np.rint(np.clip(render.rgb.numpy(force=True) * 255, 0, 255)).astype(np.uint8)
    render_keypoints, render_descriptors = orb_features(np.dstack(tuple(planes)), _NUM_FEATURES, _FAST_THRESHOLD)
    frame_keypoints, frame_descriptors = of_frame
    if render_descriptors is None or frame_descriptors is None:
        return np.empty((0, 3)), np.empty((0, 2))
    pairs = matched(render_descriptors, frame_descriptors)
    in_render = np.array([render_keypoints[index].pt for index in pairs.first]).reshape(-1, 2)
    in_frame = np.array([frame_keypoints[index].pt for index in pairs.second]).reshape(-1, 2)
    u, v = in_render.round().astype(int).T
    silhouette = render.silhouette.numpy(force=True)[v, u]
    is_opaque = silhouette > _MIN_SILHOUETTE
    z = render.depth_acc.numpy(force=True)[v, u] / np.where(is_opaque, silhouette, 1)
    x, y = (in_render[:, 0] - camera.cx) / camera.fx * z, (in_render[:, 1] - camera.cy) / camera.fy * z
    return np.stack([x, y, z], axis=1).astype(np.float64)[is_opaque], in_frame[is_opaque]
