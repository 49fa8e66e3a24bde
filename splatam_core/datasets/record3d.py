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

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from splatam_core.datasets import base, files
from splatam_core.datasets.camera_file import camera_of
from splatam_core.datasets.pairs import DepthFormat, ImagePairs, pair_up, trajectory, with_missing
from splatam_core.errors import DatasetError
from splatam_core.geometry import se3
from splatam_core.geometry.camera import CameraCalibration, PinholeCamera
from splatam_core.geometry.trajectory import is_pose


def read(folder: Path, *, width: int | None = None) -> ImagePairs:
    """List the frames of a folder.

    Raises:
        DatasetError: ``metadata.json`` cannot be used, there are no frames, or one lacks its depth or its pose.
        CameraError: a camera cannot be used.
    """
    path = folder / 'metadata.json'
    metadata = files.read_json(path)
    depth = files.numbered(folder / 'depth', r'(\d+)\.exr')
    color = with_missing(files.numbered(folder / 'rgb', r'(\d+)\.(?:jpg|png)'), depth)
    with files.parsing(path):
        rate_hz = _rate_hz(metadata)
        cameras = _cameras(metadata, list(color))
    own = None if (folder / 'camera.yaml').exists() else cameras
    pairs = pair_up(color, depth, folder, 'rgb/0.jpg with depth/0.exr', rate_hz=rate_hz, calibrations=own)
    camera = camera_of(folder, lambda: cameras[next(iter(color))], 1.0)
    files.check_exr(folder)
    size = files.first_size(pair.depth for pair in pairs)
    return ImagePairs(
        folder.resolve().name, pairs, camera.calibration, DepthFormat(None, size=size),
        width=width, ground_truth=lambda: trajectory(pairs, _poses(metadata, list(color), path)),
    )  # fmt: skip


def _cameras(metadata: dict[str, Any], numbers: list[int]) -> dict[int, CameraCalibration]:
    size = files.whole(metadata, 'w'), files.whole(metadata, 'h')
    of_each = metadata.get('perFrameIntrinsicCoeffs')
    if of_each:
        return {number: CameraCalibration(PinholeCamera(*size, *map(float, of_each[number]))) for number in numbers}
    K = np.array(metadata['K'], np.float64).reshape(3, 3).T
    return dict.fromkeys(numbers, files.calibration_from_matrix(K, size))


def _rate_hz(metadata: dict[str, Any]) -> int:
    rate_hz = round(float(metadata.get('fps', base.NOMINAL_RATE_HZ)))
    if not 1 <= rate_hz <= 1000:
        raise ValueError(f'fps {rate_hz} is not between 1 and 1000')
    return rate_hz


def _poses(metadata: dict[str, Any], numbers: list[int], path: Path) -> list[files.Pose | None]:
    """Returns each frame's pose; None if the recording has none, as with the selfie camera, or if it is unknown."""
    stated = metadata.get('poses')
    if not stated:
        return [None] * len(numbers)

    def read(number: int) -> files.Pose | None:
        with files.parsing(path):
            values = np.array(stated[number], np.float64)
        if values.shape != (7,):
            raise DatasetError(f'{path}: pose {number}: expected qx qy qz qw tx ty tz, got {len(values.reshape(-1))} numbers')
        if not is_pose(values[4:].tolist(), values[:4].tolist()):
            return None
        return files.from_opengl(se3.compose(values[[3, 0, 1, 2]], values[4:]))

    return files.tolerated([partial(read, number) for number in numbers], path)


def _recognises(source: str) -> bool:
    folder = Path(source)
    return (folder / 'metadata.json').is_file() and (folder / 'depth').is_dir() and (folder / 'rgb').is_dir()


def _open(source: str, options: base.ReadOptions) -> ImagePairs:
    return read(Path(source), width=options.width)


FORMAT = base.Format('record3d', 'a folder with metadata.json, rgb/ and depth/ with .exr files', _recognises, _open)
