"""A plain folder of images, for cameras and exporters without a format of their own.

::

    my_recording/
        rgb/  or  color/ or images/     # 000000.jpg or .png; the last number in a name is the frame's
        depth/                          # 000000.png, 16 bit, same numbers and size; 0 and 65535 = no reading
        camera.yaml                     # width height fx fy cx cy, and if needed: distortion_model distortion
                                        #   depth_scale (default 1000, millimetres) pose_axes (default opencv);
                                        #   or one of the files below
        poses/  or  pose/               # one 4x4 camera to world for each frame, .txt or .npy; inf = not known
                                        #   or one of the files below; optional

Instead of ``camera.yaml``: Open3D's ``intrinsic.json`` or ``camera_intrinsic.json`` (open3d.org, "Reconstruction
system": width, height, intrinsic_matrix in columns), or a 3x3 or 4x4 matrix in ``intrinsics.txt``, ``intrinsic.txt``
or ``camera-intrinsics.txt``.

Instead of ``poses/``: ``traj.txt`` or ``poses.txt`` with 12 or 16 numbers in each line, or Redwood's ``trajectory.log``
(redwood-data.org/indoor/fileformat.html), a pose for each frame in the frames' order.

Poses have OpenCV's camera axes unless ``camera.yaml`` says ``pose_axes: opengl``. There are no stamps: frames come at
30 Hz in the order of their numbers, the first at 1 s. This covers what SplaTAM reads as Azure (``color/ depth/``, a
log), AI2-THOR (``color/ depth/ pose/``), RealSense and Record3D (``rgb/ depth/ poses/*.npy``, ``pose_axes: opengl``).
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatam_core.datasets import base, files
from splatam_core.datasets.camera_file import CameraFile, find_camera_file
from splatam_core.datasets.pairs import DepthFormat, ImagePairs, pair_up, trajectory, with_missing
from splatam_core.errors import DatasetError
from splatam_core.geometry.camera import CameraCalibration, PinholeCamera
from splatam_core.geometry.trajectory import Trajectory

Poses = list[NDArray[np.float64] | None]

COLOR_FOLDERS = ('rgb', 'color', 'images')
POSE_FOLDERS = ('poses', 'pose')
JSON_FILES = ('intrinsic.json', 'camera_intrinsic.json')
MATRIX_FILES = ('intrinsics.txt', 'intrinsic.txt', 'camera-intrinsics.txt')
ROW_FILES = ('traj.txt', 'poses.txt')
LOG_FILE = 'trajectory.log'
DEPTH_SCALE = 1000.0
NO_DEPTH = 65535  # the largest count: nothing measured, or farther than can be counted
LAST_NUMBER = r'(?:.*\D)?(\d+)\D*'


def read(folder: Path, *, width: int | None = None) -> ImagePairs:
    """List the frames of a folder.

    Raises:
        DatasetError: there are no frames, too many lack their depth, or the camera is not stated.
        CameraError: the camera cannot be used.
    """
    depth = _by_number(folder / 'depth', ('.png',))
    colors = _by_number(folder / (_present(folder, COLOR_FOLDERS) or COLOR_FOLDERS[0]), ('.jpg', '.jpeg', '.png'))
    color = with_missing(colors, depth)
    numbers = list(color)
    pairs = pair_up(
        {position: color[number] for position, number in enumerate(numbers)},
        {position: depth[number] for position, number in enumerate(numbers) if number in depth},
        folder, 'rgb/000000.jpg with depth/000000.png',
    )  # fmt: skip
    camera = _camera(folder, (pair.color for pair in pairs))

    def ground_truth() -> Trajectory | None:
        poses = _poses(folder, numbers)
        if poses is not None and camera.pose_axes == 'opengl':
            poses = [files.from_opengl(pose) for pose in poses]
        return None if poses is None else trajectory(pairs, poses)

    return ImagePairs(
        folder.resolve().name, pairs, camera.calibration,
        DepthFormat(camera.depth_scale or DEPTH_SCALE, no_reading=NO_DEPTH), width=width, ground_truth=ground_truth,
    )  # fmt: skip


def _present(folder: Path, names: Iterable[str]) -> str | None:
    """Returns the name of the file or folder that exists; None if none does.

    Raises:
        DatasetError: several exist.
    """
    found = [name for name in names if (folder / name).exists()]
    if len(found) > 1:
        raise DatasetError(f'{folder}: holds {" and ".join(found)}, which mean the same; keep one')
    return found[0] if found else None


def _by_number(folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """Returns files by the last number in their names, which must be unique."""
    present = sorted(folder.iterdir()) if folder.is_dir() else []
    paths = [path for path in present if path.suffix.lower() in suffixes and not path.name.startswith('.')]  # of macOS: ._1.png
    found: dict[int, Path] = {}
    for path in paths:
        match = re.fullmatch(LAST_NUMBER, path.stem)
        if match is None:
            raise DatasetError(f'{path}: there is no number in the name, by which colour and depth are paired')
        other = found.setdefault(int(match.group(1)), path)
        if other != path:
            raise DatasetError(f'{folder}: {other.name} and {path.name} have the same number, the last one in the name')
    return dict(sorted(found.items()))


# --- camera ---


def _camera(folder: Path, color: Iterable[Path]) -> CameraFile:
    stated = find_camera_file(folder, may_state_axes=True) or find_intrinsics(folder, color)
    if stated is None:
        raise DatasetError(
            f'{folder}: the camera is not stated; put a camera.yaml with width, height, fx, fy, cx, cy and depth_scale '
            f'into the folder (or one of {", ".join(JSON_FILES + MATRIX_FILES)})'
        )
    return stated


def find_intrinsics(folder: Path, color: Iterable[Path]) -> CameraFile | None:
    """Returns the camera of Open3D's ``intrinsic.json`` or of a matrix in a text file; None without such a file.

    Args:
        folder: may hold one such file.
        color: the colour images, whose size a matrix does not state.

    Raises:
        DatasetError: several exist, or it cannot be read.
        CameraError: the camera cannot be used.
    """
    name = _present(folder, JSON_FILES + MATRIX_FILES)
    if name is None:
        return None
    path = folder / name
    if name in JSON_FILES:
        return CameraFile(_open3d_calibration(path), None)
    return CameraFile(files.calibration_from_matrix(files.read_matrix(path, 3, 4), files.first_size(color)), None)


def _open3d_calibration(path: Path) -> CameraCalibration:
    values = files.read_json(path)
    with files.parsing(path):
        K = np.array(values['intrinsic_matrix'], np.float64).reshape(3, 3).T
        pinhole = PinholeCamera(
            files.whole(values, 'width'), files.whole(values, 'height'), *(float(K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
        )
    return CameraCalibration(pinhole)


# --- poses ---


def _poses(folder: Path, numbers: list[int]) -> Poses | None:
    """Returns the pose of each frame; None if the folder has no poses."""
    name = _present(folder, (*POSE_FOLDERS, *ROW_FILES, LOG_FILE))
    if name is None:
        return None
    path = folder / name
    if name in POSE_FOLDERS:
        posed = _by_number(path, ('.txt', '.npy'))
        return files.read_poses([posed.get(number) for number in numbers], path)
    poses = _read_log(path) if name == LOG_FILE else files.read_pose_rows(path)
    if len(poses) != len(numbers):
        raise DatasetError(f'{path}: has {len(poses)} poses for {len(numbers)} frames; each frame needs one, in order')
    return poses


def _read_log(path: Path) -> Poses:
    """Read blocks of one line with three numbers, which are skipped, and four lines with the rows of a pose."""
    numbers = files.read_numbers(path)
    if numbers.size % 19:
        raise DatasetError(f'{path}: expected blocks of 3 + 16 numbers, got {numbers.size} numbers')
    blocks = enumerate(numbers.reshape(-1, 19)[:, 3:])
    return files.tolerated([partial(files.pose, block, f'{path}, pose {index}') for index, block in blocks], path)


def _recognises(source: str) -> bool:
    folder = Path(source)
    return any((folder / name).is_dir() for name in COLOR_FOLDERS) and (folder / 'depth').is_dir()


def _open(source: str, options: base.ReadOptions) -> ImagePairs:
    return read(Path(source), width=options.width)


FORMAT = base.Format(
    'folder', 'a folder with rgb/ (or color/, images/), depth/ and camera.yaml', _recognises, _open, is_last_resort=True
)
