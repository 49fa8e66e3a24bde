"""Read the ``camera.yaml`` beside a recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from splatam_core.errors import CameraError, one_line
from splatam_core.geometry.camera import CameraCalibration, PinholeCamera

POSE_AXES = ('opencv', 'opengl')


@dataclass(frozen=True, slots=True)
class CameraFile:
    """What a ``camera.yaml`` beside a recording states.

    Attributes:
        calibration: the camera.
        depth_scale: stored depth counts per metre; None where the file does not say.
        pose_axes: axes of the camera in pose files: ``opencv`` (x right, y down, z forward) or ``opengl``
            (x right, y up, z backward); None where the file does not say.
    """

    calibration: CameraCalibration
    depth_scale: float | None
    pose_axes: str | None = None


def read_camera_file(path: Path) -> CameraFile:
    """Read ``width height fx fy cx cy distortion_model distortion depth_scale pose_axes`` from a YAML file.

    Raises:
        CameraError: the file is no such mapping, or a key is missing, unknown or not a number.
    """
    try:
        values = yaml.safe_load(path.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise CameraError(f'{path}: cannot be read: {one_line(error)}') from None
    if not isinstance(values, dict):
        raise CameraError(f'{path}: expected a mapping with width, height, fx, fy, cx, cy')
    required = {'width', 'height', 'fx', 'fy', 'cx', 'cy'}
    optional = {'distortion_model', 'distortion', 'depth_scale', 'pose_axes'}
    if missing := required - values.keys():
        raise CameraError(f'{path}: missing {", ".join(sorted(missing))}')
    if unknown := values.keys() - required - optional:
        raise CameraError(f'{path}: unknown {", ".join(sorted(map(str, unknown)))}')
    try:
        return _camera_file(values)
    except (TypeError, ValueError) as error:
        raise CameraError(f'{path}: {error}') from None
    except CameraError as error:
        raise CameraError(f'{path}: {error}') from None


def _camera_file(values: dict[str, Any]) -> CameraFile:
    pinhole = PinholeCamera(int(values['width']), int(values['height']), *(float(values[key]) for key in ('fx', 'fy', 'cx', 'cy')))
    distortion = tuple(float(value) for value in values.get('distortion') or ())
    scale = values.get('depth_scale')
    if scale is not None and not float(scale) > 0:
        raise CameraError(f'depth_scale {scale} must be positive (counts per metre)')
    axes = values.get('pose_axes')
    if axes not in (None, *POSE_AXES):
        raise CameraError(f"pose_axes '{axes}' is not one of {', '.join(POSE_AXES)}")
    model = values.get('distortion_model') or 'none'
    return CameraFile(CameraCalibration(pinhole, model, distortion), None if scale is None else float(scale), axes)
