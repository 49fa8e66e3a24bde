"""7-Scenes recordings.

::

    seq-01/
        frame-000000.color.png      # or .color.jpg
        frame-000000.depth.png      # 16 bit, millimetres; 0 and 65535 = no reading
        frame-000000.pose.txt       # 4x4 camera to world; may be missing
        camera-intrinsics.txt       # 3x3 K; may be missing: then 585 585 320 240 at 640x480
        camera.yaml                 # may be missing; wins over both
        ...

There are no stamps: the first frame is at 1 s, and the numbers in the names count at 30 Hz.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatam_core import se3
from splatam_core.camera import CameraCalibration, CameraFile, FrameFactory, PinholeCamera
from splatam_core.datasets import base
from splatam_core.errors import DatasetError
from splatam_core.types import RgbdFrame, Trajectory

DEFAULT_CAMERA = CameraCalibration(PinholeCamera(640, 480, 585.0, 585.0, 320.0, 240.0))
DEFAULT_DEPTH_SCALE = 1000.0
NO_DEPTH = 65535
COLOR_SUFFIXES = ('.color.png', '.color.jpg')


class SevenScenesSequence:
    """A 7-Scenes sequence folder; see the module's text for its layout."""

    def __init__(self, folder: Path, *, width: int | None = None) -> None:
        """List the frames of a folder.

        Raises:
            DatasetError: there are no frames, one lacks its depth, or ``camera-intrinsics.txt`` is no 3x3 matrix.
            CameraError: its ``camera.yaml`` cannot be used.
        """
        self._color = _color_files(folder)
        self._numbers = sorted(self._color)
        self._folder = folder
        self._check_depth_files()
        stated = base.camera_file(folder)
        self._frames = FrameFactory(self._calibration(stated), width)
        self.name = folder.resolve().name
        self.camera = self._frames.camera
        self.depth_scale: float | None = (stated.depth_scale if stated else None) or DEFAULT_DEPTH_SCALE

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, index: int) -> RgbdFrame:
        """Read one frame."""
        number = self._numbers[index]
        counts = base.read_depth_counts(self._path(number, '.depth.png'))
        counts = np.where(counts == NO_DEPTH, np.uint16(0), counts)
        rgb = base.read_color(self._color[number])
        return self._frames.make(self._stamp_ns(number), rgb, base.metres(counts, self.depth_scale))

    def ground_truth(self) -> Trajectory | None:
        """The poses of the frames that have one; None where no frame has."""
        posed = [number for number in self._numbers if self._path(number, '.pose.txt').exists()]
        if not posed:
            return None
        poses = [_read_pose(self._path(number, '.pose.txt')) for number in posed]
        return Trajectory(np.array([self._stamp_ns(number) for number in posed], np.int64), np.stack(poses))

    def _path(self, number: int, suffix: str) -> Path:
        return self._folder / f'frame-{number:06d}{suffix}'

    def _stamp_ns(self, number: int) -> int:
        return base.nominal_stamp_ns(number - self._numbers[0])

    def _check_depth_files(self) -> None:
        missing = [path.name for number in self._numbers if not (path := self._path(number, '.depth.png')).exists()]
        if missing:
            raise DatasetError(
                f'{self._folder}: {len(missing)} of {len(self._numbers)} colour images have no depth, the first '
                f'missing is {missing[0]}; every frame needs both'
            )

    def _calibration(self, stated: CameraFile | None) -> CameraCalibration:
        path = self._folder / 'camera-intrinsics.txt'
        if stated is not None:
            return stated.calibration
        if not path.exists():
            return DEFAULT_CAMERA
        K = _read_matrix(path, 3)
        width, height = base.image_size(self._color[self._numbers[0]])
        return CameraCalibration(PinholeCamera(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2]))


def _color_files(folder: Path) -> dict[int, Path]:
    """Colour image of each frame number; a PNG wins over a JPEG of the same frame."""
    files = {
        int(match.group(1)): path
        for suffix in reversed(COLOR_SUFFIXES)
        for path in sorted(folder.glob(f'frame-*{suffix}'))
        if (match := re.fullmatch(r'frame-(\d{6})', path.name.removesuffix(suffix)))
    }
    if not files:
        raise DatasetError(f'{folder}: no frame-000000.color.png (or .jpg) or any other frame in it')
    return files


def _read_matrix(path: Path, size: int) -> NDArray[np.float64]:
    try:
        values = np.array(path.read_text().split(), dtype=np.float64)
    except (OSError, ValueError) as error:
        raise DatasetError(f'{path}: cannot be read: {error}') from None
    if values.size != size * size or not np.isfinite(values).all():
        raise DatasetError(f'{path}: expected {size}x{size} finite numbers, got {values.size} numbers')
    return values.reshape(size, size)


def _read_pose(path: Path) -> NDArray[np.float64]:
    """A pose, its rotation made exact again where the file rounds it."""
    T = _read_matrix(path, 4)
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-2 or np.linalg.det(R) < 0:
        raise DatasetError(f'{path}: its upper left 3x3 is no rotation; expected a 4x4 camera-to-world matrix')
    return se3.compose(se3.quaternion_from_rotation(R), T[:3, 3])


def _recognises(source: str) -> bool:
    folder = Path(source)
    return folder.is_dir() and any(next(folder.glob(f'frame-*{suffix}'), None) for suffix in COLOR_SUFFIXES)


def _open(source: str, options: base.ReadOptions) -> SevenScenesSequence:
    return SevenScenesSequence(Path(source), width=options.width)


FORMAT = base.Format(
    'sevenscenes', 'a folder with frame-000000.color.png (or .jpg) and frame-000000.depth.png', _recognises, _open
)
