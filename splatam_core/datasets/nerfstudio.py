"""Reads cameras and poses in nerfstudio's form, for the datasets that have a ``transforms.json``.

docs.nerf.studio, "Data conventions": ``transform_matrix`` is camera to world with OpenGL's camera axes; ``k1 k2 p1 p2``
are OpenCV's coefficients, with camera model ``OPENCV_FISHEYE`` ``k1 k2 k3 k4`` are OpenCV's fisheye coefficients.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from splatam_core.datasets import files
from splatam_core.geometry.camera import CameraCalibration, PinholeCamera

INTRINSICS = ('fl_x', 'fl_y', 'cx', 'cy')


def calibration(values: Mapping[str, Any]) -> CameraCalibration:
    """Returns the camera that the top of a file, or one of its frames, states.

    Raises:
        KeyError, TypeError, ValueError: a value is missing or unsuitable; ``files.parsing`` turns this into an error message.
        CameraError: the camera cannot be used.
    """
    width, height = files.whole(values, 'w'), files.whole(values, 'h')
    fx, fy, cx, cy = (float(values[key]) for key in INTRINSICS)
    pinhole = PinholeCamera(width, height, fx, fy, cx, cy)
    is_fisheye = values.get('camera_model') == 'OPENCV_FISHEYE'
    keys = ('k1', 'k2', 'k3', 'k4') if is_fisheye else ('k1', 'k2', 'p1', 'p2')
    distortion = tuple(float(values.get(key, 0)) for key in keys)
    if not any(distortion):
        return CameraCalibration(pinhole)
    return CameraCalibration(pinhole, 'equidistant' if is_fisheye else 'plumb_bob', distortion)


def poses(frames: Sequence[Mapping[str, Any]], path: Path) -> list[files.Pose | None]:
    """Returns each frame's pose with OpenCV's camera axes, [4, 4]; None if the frame has none.

    Raises:
        DatasetError: too many of the matrices are no poses.
    """

    def read(index: int, frame: Mapping[str, Any]) -> files.Pose | None:
        with files.parsing(path):
            matrix = np.array(frame['transform_matrix'], np.float64) if 'transform_matrix' in frame else None
        return None if matrix is None else files.from_opengl(files.pose(matrix, f'{path}, frame {index}'))

    return files.tolerated([partial(read, *frame) for frame in enumerate(frames)], path)
