"""``camera.yaml``: states the camera of the recording in whose folder it lies, and overrides the dataset's own.

::

    width: 640                          # pixels
    height: 480
    fx: 525.0                           # pixels
    fy: 525.0
    cx: 319.5                           # pixels; a pixel's centre is its integer index
    cy: 239.5
    distortion_model: plumb_bob         # optional: rational_polynomial, equidistant or none (default)
    distortion: [0.1, -0.2, 0, 0, 0]    # optional: coefficients in OpenCV's order
    depth_scale: 1000                   # optional: stored depth counts per metre; below 1: metres per count
    pose_axes: opencv                   # optional, plain folders only: or opengl

The file that ROS's camera_calibration writes (``image_width``, ``camera_matrix``, ``distortion_coefficients``) is read, too;
``depth_scale`` and ``pose_axes`` may be added to it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatam_core.datasets.files import whole
from splatam_core.errors import CameraError
from splatam_core.geometry.camera import CameraCalibration, PinholeCamera
from splatam_core.text_files import read_yaml

NAME = 'camera.yaml'
REQUIRED = frozenset({'width', 'height', 'fx', 'fy', 'cx', 'cy'})
OPTIONAL = frozenset({'distortion_model', 'distortion', 'depth_scale', 'pose_axes'})
ROS_KEYS = {
    'image_width': 'width', 'image_height': 'height', 'camera_matrix': '', 'distortion_coefficients': '', 'camera_name': '',
    'rectification_matrix': '', 'projection_matrix': '',
}  # fmt: skip
"""Keys of a calibration of ROS, and ours for those that are one number."""
POSE_AXES = ('opencv', 'opengl')
DEPTH_SCALES = (1e-3, 1e9)

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class CameraFile:
    """What a ``camera.yaml`` states.

    Attributes:
        calibration: the camera.
        depth_scale: stored depth counts per metre; None if the file does not say.
        pose_axes: axes of the camera in pose files: ``opencv`` (x right, y down, z forward) or ``opengl``
            (x right, y up, z backward); None if the file does not say.
    """

    calibration: CameraCalibration
    depth_scale: float | None
    pose_axes: str | None = None


@dataclass(frozen=True, slots=True)
class DatasetCamera:
    """The camera of a dataset, whoever states it.

    Attributes:
        calibration: the camera.
        depth_scale: stored depth counts per metre.
    """

    calibration: CameraCalibration
    depth_scale: float


def camera_of(folder: Path, otherwise: Callable[[], CameraCalibration], depth_scale: float) -> DatasetCamera:
    """Returns the camera that a folder's ``camera.yaml`` states, else the dataset's own.

    Args:
        folder: may hold a ``camera.yaml``.
        otherwise: returns the dataset's own camera; called only without ``camera.yaml``.
        depth_scale: counts per metre, unless the file says otherwise.

    Raises:
        CameraError: the file exists and cannot be used.
        DatasetError: the dataset's own camera cannot be read.
    """
    stated = find_camera_file(folder)
    if stated is None:
        return DatasetCamera(otherwise(), depth_scale)
    return DatasetCamera(stated.calibration, stated.depth_scale or depth_scale)


def find_camera_file(folder: Path, *, may_state_axes: bool = False) -> CameraFile | None:
    """Returns what a folder's ``camera.yaml`` states, or None without such a file.

    Raises:
        CameraError: the file exists and cannot be used.
    """
    path = folder / NAME
    if not path.exists():
        return None
    stated = read_camera_file(path)
    if stated.pose_axes is not None and not may_state_axes:
        raise CameraError(f'{path}: pose_axes is for plain folders (--format folder); the axes of this one are known')
    return stated


def read_camera_file(path: Path) -> CameraFile:
    """Read a ``camera.yaml``.

    Raises:
        CameraError: the file holds no such mapping, or a key is missing, unknown or not a number.
    """
    values = read_yaml(path, CameraError)
    if not isinstance(values, dict):
        raise CameraError(f'{path}: expected a mapping with width, height, fx, fy, cx, cy')
    if 'camera_matrix' in values:
        values = _of_ros(values)
    if missing := REQUIRED - values.keys():
        raise CameraError(f'{path}: missing {", ".join(sorted(missing))}')
    if unknown := values.keys() - REQUIRED - OPTIONAL:
        raise CameraError(f'{path}: unknown {", ".join(sorted(map(str, unknown)))}')
    try:
        return _parse(path, values)
    except (TypeError, ValueError, OverflowError, CameraError) as error:
        raise CameraError(f'{path}: {error}') from None


def _of_ros(values: dict[Any, Any]) -> dict[Any, Any]:
    """Returns the keys of this format for those of a calibration of ROS. A key whose value has another form is left out."""
    ours = {key: value for key, value in values.items() if key not in ROS_KEYS}
    ours |= {ours_key: values[key] for key, ours_key in ROS_KEYS.items() if ours_key and key in values}
    matrix, coefficients = (_data(values.get(key)) for key in ('camera_matrix', 'distortion_coefficients'))
    if len(matrix) == 9:
        ours |= dict(zip(('fx', 'cx', 'fy', 'cy'), (matrix[index] for index in (0, 2, 4, 5)), strict=True))
    return ours | ({'distortion': coefficients} if coefficients else {})


def _data(matrix: Any) -> list[Any]:
    data = matrix.get('data') if isinstance(matrix, dict) else None
    return data if isinstance(data, list) else []


def say_assumed(folder: Path, what: str) -> None:
    """Say that a folder states no camera, and which one is assumed."""
    _log.warning('%s: states no camera; %s is assumed; state it in a %s if it is another', folder, what, NAME)


def checked_depth_scale(value: Any) -> float:
    """Returns counts per metre.

    Raises:
        CameraError: the number is not positive, or impossible for depth.
        TypeError, ValueError, OverflowError: the value is no number.
    """
    scale = float(value)
    if not scale > 0:
        raise CameraError(f'depth_scale {value} must be positive (counts per metre)')
    least, most = DEPTH_SCALES
    if not least <= scale <= most:
        raise CameraError(f'depth_scale {value} must be {least:g} to {most:g} counts per metre')
    return scale


def _counts_per_metre(path: Path, value: Any) -> float:
    """Returns counts per metre; a number below 1 is metres per count, as the node's parameter of this name."""
    stated = float(value)
    if not 0 < stated < 1:
        return checked_depth_scale(value)
    scale = checked_depth_scale(float(f'{1 / stated:.7g}'))
    _log.warning('%s: depth_scale %s is read as metres per count: %s counts per metre', path, value, f'{scale:g}')
    return scale


def _parse(path: Path, values: dict[str, Any]) -> CameraFile:
    width, height = whole(values, 'width'), whole(values, 'height')
    fx, fy, cx, cy = (float(values[key]) for key in ('fx', 'fy', 'cx', 'cy'))
    pinhole = PinholeCamera(width, height, fx, fy, cx, cy)
    distortion = tuple(float(value) for value in values.get('distortion') or ())
    scale = None if values.get('depth_scale') is None else _counts_per_metre(path, values['depth_scale'])
    axes = values.get('pose_axes')
    if axes not in (None, *POSE_AXES):
        raise CameraError(f"pose_axes '{axes}' is not one of {', '.join(POSE_AXES)}")
    model = values.get('distortion_model') or 'none'
    return CameraFile(CameraCalibration(pinhole, model, distortion), scale, axes)
