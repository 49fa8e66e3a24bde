"""Record3D recordings (iPhone and iPad), exported as EXR + RGB.

::

    EXR_RGBD/
        metadata.json           # w h, K (3x3 in columns), fps, poses [qx qy qz qw tx ty tz];
                                #   perFrameIntrinsicCoeffs [fx fy cx cy] optional
        rgb/0.jpg               # or .png
        depth/0.exr             # metres, 0 = no reading; may be smaller than colour
        camera.yaml             # optional; overrides the cameras in metadata.json

Layout: record3d.app, and nerfstudio's ``process_data/record3d_utils.py`` (github.com/nerfstudio-project/nerfstudio).
Poses are ARKit's, with OpenGL's camera axes. Intrinsics may differ between frames; all frames are rectified to the first
frame's camera. The first frame is at 1 s, and the numbers in the names count at ``fps``. Needs OpenEXR (``splatam_ros[exr]``).
``.r3d`` files, whose depth is compressed with LZFSE, are not read: export them as EXR + RGB.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatam_core.datasets import base, files
from splatam_core.datasets.camera_file import camera_of
from splatam_core.datasets.pairs import DepthFormat, ImagePairs, pair_up, trajectory
from splatam_core.errors import DatasetError
from splatam_core.geometry import se3
from splatam_core.geometry.camera import CameraCalibration, PinholeCamera


def read(folder: Path, *, width: int | None = None) -> ImagePairs:
    """List the frames of a folder.

    Raises:
        DatasetError: ``metadata.json`` cannot be used, there are no frames, or one lacks its depth or its pose.
        CameraError: a camera cannot be used.
    """
    path = folder / 'metadata.json'
    metadata = files.read_json(path)
    color = files.numbered(folder / 'rgb', r'(\d+)\.(?:jpg|png)')
    depth = files.numbered(folder / 'depth', r'(\d+)\.exr')
    with files.parsing(path):
        rate_hz = round(float(metadata.get('fps', base.NOMINAL_RATE_HZ)))
        cameras = _cameras(metadata, list(color))
        poses = [_pose(metadata, number, path) for number in color]
    own = None if (folder / 'camera.yaml').exists() else cameras
    pairs = pair_up(color, depth, folder, 'rgb/0.jpg with depth/0.exr', rate_hz=rate_hz, calibrations=own)
    camera = camera_of(folder, lambda: cameras[next(iter(color))], 1.0)
    size = files.read_exr(pairs[0].depth).shape
    return ImagePairs(
        folder.resolve().name, pairs, camera.calibration, DepthFormat(None, size=(size[1], size[0])),
        width=width, ground_truth=lambda: trajectory(pairs, poses),
    )  # fmt: skip


def _cameras(metadata: dict[str, Any], numbers: list[int]) -> dict[int, CameraCalibration]:
    size = int(metadata['w']), int(metadata['h'])
    of_each = metadata.get('perFrameIntrinsicCoeffs')
    if of_each:
        return {number: CameraCalibration(PinholeCamera(*size, *map(float, of_each[number]))) for number in numbers}
    K = np.array(metadata['K'], np.float64).reshape(3, 3).T
    return dict.fromkeys(numbers, files.calibration_from_matrix(K, size))


def _pose(metadata: dict[str, Any], number: int, path: Path) -> NDArray[np.float64] | None:
    """Returns a frame's pose; None if the recording has none, as with the selfie camera."""
    poses = metadata.get('poses')
    if not poses:
        return None
    values = np.array(poses[number], np.float64)
    if values.shape != (7,) or not np.isfinite(values).all() or not values[:4].any():
        raise DatasetError(f'{path}: pose {number}: expected qx qy qz qw tx ty tz, got {poses[number]}')
    return files.from_opengl(se3.compose(values[[3, 0, 1, 2]], values[4:]))


def _recognises(source: str) -> bool:
    folder = Path(source)
    return (folder / 'metadata.json').is_file() and (folder / 'depth').is_dir() and (folder / 'rgb').is_dir()


def _open(source: str, options: base.ReadOptions) -> ImagePairs:
    return read(Path(source), width=options.width)


FORMAT = base.Format('record3d', 'a folder with metadata.json, rgb/ and depth/ with .exr files', _recognises, _open)
