"""Reads cameras and poses in nerfstudio's form, for the datasets that have a ``transforms.json``.

docs.nerf.studio, "Data conventions": ``transform_matrix`` is camera to world with OpenGL's camera axes; ``k1 k2 p1 p2``
are OpenCV's coefficients, with camera model ``OPENCV_FISHEYE`` ``k1 k2 k3 k4`` are OpenCV's fisheye coefficients.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatam_core.datasets import files
from splatam_core.geometry.camera import CameraCalibration, PinholeCamera

INTRINSICS = ('fl_x', 'fl_y', 'cx', 'cy')


def calibration(values: Mapping[str, Any]) -> CameraCalibration:
    """Returns the camera that the top of a file, or one of its frames, states.

    Raises:
        KeyError, TypeError, ValueError: a value is missing or unsuitable; ``files.parsing`` turns this into an error message.
        CameraError: the camera cannot be used.
    """
    width, height = int(values['w']), int(values['h'])
    fx, fy, cx, cy = (float(values[key]) for key in INTRINSICS)
    pinhole = PinholeCamera(width, height, fx, fy, cx, cy)
    is_fisheye = values.get('camera_model') == 'OPENCV_FISHEYE'
    keys = ('k1', 'k2', 'k3', 'k4') if is_fisheye else ('k1', 'k2', 'p1', 'p2')
    distortion = tuple(float(values.get(key, 0)) for key in keys)
    if not any(distortion):
        return CameraCalibration(pinhole)
    return CameraCalibration(pinhole, 'equidistant' if is_fisheye else 'plumb_bob', distortion)


def pose(frame: Mapping[str, Any], where: str) -> NDArray[np.float64] | None:
    """Returns a frame's pose with OpenCV's camera axes, [4, 4]; None if the frame has none.

    Raises:
        DatasetError: the matrix is no pose.
    """
    if 'transform_matrix' not in frame:
        return None
    return files.from_opengl(files.pose(np.array(frame['transform_matrix'], np.float64), where))
