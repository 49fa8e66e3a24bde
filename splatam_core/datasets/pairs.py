"""Sequences of colour and depth image files, the form of nearly every dataset."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatam_core.datasets import base, files
from splatam_core.errors import DatasetError
from splatam_core.geometry.camera import CameraCalibration, PinholeCamera
from splatam_core.geometry.trajectory import Trajectory
from splatam_core.images.rectification import FrameFactory
from splatam_core.types import RgbdFrame


@dataclass(frozen=True, slots=True)
class ImagePair:
    """The files of one frame.

    Attributes:
        stamp_ns: time of the exposure.
        color: image file.
        depth: image file, registered to colour.
        calibration: the frame's own camera; None if all frames have the same.
    """

    stamp_ns: int
    color: Path
    depth: Path
    calibration: CameraCalibration | None = None


@dataclass(frozen=True, slots=True)
class DepthFormat:
    """How depth is stored.

    Attributes:
        scale: counts per metre of 16-bit images; None for OpenEXR images in metres.
        no_reading: count that means 'no reading', besides 0.
        size: width and height of the depth images if they show colour's view at another size.
        camera: camera of the depth images if it is not colour's; it has the same centre and axes.
    """

    scale: float | None
    no_reading: int | None = None
    size: tuple[int, int] | None = None
    camera: PinholeCamera | None = None

    def read(self, path: Path) -> NDArray[np.float32]:
        """Read depth in metres, [H, W].

        Raises:
            DatasetError: the file cannot be read as depth.
        """
        if self.scale is None:
            return files.read_exr(path)
        counts = files.read_depth_counts(path)
        if self.no_reading is not None:
            counts = np.where(counts == self.no_reading, np.uint16(0), counts)
        return base.metres(counts, self.scale)

    def camera_of(self, color: PinholeCamera) -> PinholeCamera | None:
        """Returns the camera of the depth images; None if it is colour's."""
        return self.camera if self.size is None else color.resized(*self.size)


class ImagePairs:
    """A sequence of image files, read when a frame is asked for."""

    def __init__(
        self,
        name: str,
        pairs: Sequence[ImagePair],
        calibration: CameraCalibration,
        depth: DepthFormat,
        *,
        ground_truth: Callable[[], Trajectory | None],
        width: int | None = None,
    ) -> None:
        """Check the order of stamps and the size of the first image.

        Args:
            name: name in reports.
            pairs: in the order of their stamps.
            calibration: the camera; frames with a camera of their own are rectified to its pinhole.
            depth: how depth is stored.
            ground_truth: reads the true poses when they are asked for.
            width: width of the frames in pixels; None keeps the recorded size.

        Raises:
            DatasetError: stamps do not increase, or the first readable image does not have the camera's size.
        """
        base.check_increasing(np.array([pair.stamp_ns for pair in pairs], np.int64), name)
        _check_size(pairs, calibration)
        self.name = name
        self.depth_scale = depth.scale
        self._pairs, self._calibration, self._depth, self._width = pairs, calibration, depth, width
        self._ground_truth = ground_truth
        self._factory = lru_cache(maxsize=2)(self._make_factory)  # one for all frames, or one per frame
        self.camera = self._factory(calibration).camera

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, index: int) -> RgbdFrame:
        """Read one frame."""
        pair = self._pairs[index]
        factory = self._factory(pair.calibration or self._calibration)
        return factory.make(pair.stamp_ns, files.read_color(pair.color), self._depth.read(pair.depth))

    def ground_truth(self) -> Trajectory | None:
        """The true poses; None if the dataset has none."""
        return self._ground_truth()

    def _make_factory(self, calibration: CameraCalibration) -> FrameFactory:
        rectified = self._calibration.pinhole
        return FrameFactory(calibration, self._width, self._depth.camera_of(calibration.pinhole), rectified)


def _check_size(pairs: Sequence[ImagePair], calibration: CameraCalibration) -> None:
    """Check that the camera fits the images: if not, every single frame would be rejected later."""
    for pair in pairs:
        try:
            width, height = files.image_size(pair.color)
        except DatasetError:
            continue  # reading that frame reports it
        stated = (pair.calibration or calibration).pinhole
        if (width, height) != (stated.width, stated.height):
            raise DatasetError(
                f'{pair.color}: is {width}x{height}, but the camera is for {stated.width}x{stated.height} images; state the camera '
                'of these images in a camera.yaml in the folder'
            )
        return


def pair_up(
    color: Mapping[int, Path],
    depth: Mapping[int, Path],
    folder: Path,
    expected: str,
    *,
    rate_hz: int = base.NOMINAL_RATE_HZ,
    calibrations: Mapping[int, CameraCalibration] | None = None,
) -> list[ImagePair]:
    """Pair images by their numbers, which count time from the first frame at 1 s.

    Args:
        color: files by number, in the order of the numbers.
        depth: likewise; may have more files.
        folder: names the dataset in an error message.
        expected: names of a colour and a depth image, for the error message.
        rate_hz: the numbers count at this rate.
        calibrations: cameras of frames that have their own.

    Raises:
        DatasetError: there is no colour image, or one has no depth.
    """
    if not color:
        raise DatasetError(f'{folder}: no frame in it; expected {expected} and so on')
    missing = [path.name for number, path in color.items() if number not in depth]
    if missing:
        raise DatasetError(
            f'{folder}: {len(missing)} of {len(color)} colour images have no depth, the first is {missing[0]}; '
            f'every frame needs both, named like {expected}'
        )
    first, own = next(iter(color)), calibrations or {}
    return [
        ImagePair(base.nominal_stamp_ns(number - first, rate_hz), path, depth[number], own.get(number))
        for number, path in color.items()
    ]


def trajectory(pairs: Sequence[ImagePair], poses: Sequence[NDArray[np.float64] | None]) -> Trajectory | None:
    """Returns the known poses at the stamps of their frames; None if none is known."""
    known = [(pair.stamp_ns, T) for pair, T in zip(pairs, poses, strict=True) if T is not None]
    if not known:
        return None
    stamps_ns, matrices = zip(*known, strict=True)
    return Trajectory(np.array(stamps_ns, np.int64), np.stack(matrices))


def row_trajectory(path: Path, pairs: Sequence[ImagePair], rows: Sequence[int]) -> Trajectory | None:
    """Returns the poses of a file with one pose per line; None if there is no such file.

    Args:
        path: see ``files.read_pose_rows``.
        pairs: the frames.
        rows: line of each frame's pose, from 0.

    Raises:
        DatasetError: the file cannot be read or has too few lines.
    """
    if not path.exists():
        return None
    poses = files.read_pose_rows(path)
    if len(poses) <= max(rows):
        raise DatasetError(f'{path}: has {len(poses)} poses, but there is a frame {max(rows)}; they count from 0')
    return trajectory(pairs, [poses[row] for row in rows])
