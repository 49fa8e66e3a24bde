"""Recordings that are pairs of image files, colour and depth: the form in which nearly every dataset comes."""

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
        calibration: the frame's own camera; None where all frames have the same.
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
        no_reading: counts that mean none, besides 0.
        size: width and height of the depth images where they show colour's view in another size.
        camera: their camera where it is another than colour's, from the same centre along the same axes.
    """

    scale: float | None
    no_reading: int | None = None
    size: tuple[int, int] | None = None
    camera: PinholeCamera | None = None

    def read(self, path: Path) -> NDArray[np.float32]:
        """Read depth in metres, [H, W].

        Raises:
            DatasetError: the file cannot be read as such.
        """
        if self.scale is None:
            return files.read_exr(path)
        counts = files.read_depth_counts(path)
        if self.no_reading is not None:
            counts = np.where(counts == self.no_reading, np.uint16(0), counts)
        return base.metres(counts, self.scale)

    def camera_of(self, color: PinholeCamera) -> PinholeCamera | None:
        """The camera of the depth images; None where it is colour's."""
        return self.camera if self.size is None else color.resized(*self.size)


class ImagePairs:
    """A recording of image files."""

    def __init__(
        self,
        name: str,
        pairs: Sequence[ImagePair],
        calibration: CameraCalibration,
        depth: DepthFormat,
        *,
        truth: Callable[[], Trajectory | None],
        width: int | None = None,
    ) -> None:
        """Describe a recording; files are read when a frame is asked for.

        Args:
            name: what to call it in reports.
            pairs: in the order of their stamps.
            calibration: the camera; frames with one of their own are rectified to its pinhole.
            depth: how depth is stored.
            truth: reads the true poses, when they are asked for.
            width: of the frames in pixels; None keeps the recorded size.

        Raises:
            DatasetError: stamps do not increase, or the first image that can be read is not of the camera's size.
        """
        base.check_increasing(np.array([pair.stamp_ns for pair in pairs], np.int64), name)
        _check_size(pairs, calibration)
        self.name = name
        self.depth_scale = depth.scale
        self._pairs, self._calibration, self._depth, self._width = pairs, calibration, depth, width
        self._truth = truth
        self._factory = lru_cache(maxsize=2)(self._make_factory)  # one for all frames, or another for each
        self.camera = self._factory(calibration).camera

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, index: int) -> RgbdFrame:
        """Read one frame."""
        pair = self._pairs[index]
        factory = self._factory(pair.calibration or self._calibration)
        return factory.make(pair.stamp_ns, files.read_color(pair.color), self._depth.read(pair.depth))

    def ground_truth(self) -> Trajectory | None:
        """The true poses that the dataset has."""
        return self._truth()

    def _make_factory(self, calibration: CameraCalibration) -> FrameFactory:
        rectified = self._calibration.pinhole
        return FrameFactory(calibration, self._width, self._depth.camera_of(calibration.pinhole), rectified)


def _check_size(pairs: Sequence[ImagePair], calibration: CameraCalibration) -> None:
    """Make sure that the camera is that of the images: otherwise every frame would be left out, one by one."""
    for pair in pairs:
        try:
            width, height = files.image_size(pair.color)
        except DatasetError:
            continue  # its own frame says so
        stated = (pair.calibration or calibration).pinhole
        if (width, height) != (stated.width, stated.height):
            raise DatasetError(
                f'{pair.color}: is {width}x{height}, but the camera is that of {stated.width}x{stated.height} images; state the '
                'camera of these in a camera.yaml in the folder'
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
    """Pair images by their numbers, which count time: the first is at 1 s.

    Args:
        color: files by number, in its order.
        depth: the same; may have more.
        folder: what to call them in an error.
        expected: names of a colour and a depth image, for the error.
        rate_hz: how fast the numbers count.
        calibrations: cameras of frames that have one of their own.

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
    """The poses that are known, at the stamps of their frames; None where none is."""
    known = [(pair.stamp_ns, T) for pair, T in zip(pairs, poses, strict=True) if T is not None]
    if not known:
        return None
    stamps_ns, matrices = zip(*known, strict=True)
    return Trajectory(np.array(stamps_ns, np.int64), np.stack(matrices))


def row_trajectory(path: Path, pairs: Sequence[ImagePair], rows: Sequence[int]) -> Trajectory | None:
    """The poses of a file that has one in each line; None where there is no such file.

    Args:
        path: see ``files.read_pose_rows``.
        pairs: the frames.
        rows: the line of each, from 0.

    Raises:
        DatasetError: the file cannot be read or has too few lines.
    """
    if not path.exists():
        return None
    poses = files.read_pose_rows(path)
    if len(poses) <= max(rows):
        raise DatasetError(f'{path}: has {len(poses)} poses, but there is a frame {max(rows)}; they count from 0')
    return trajectory(pairs, [poses[row] for row in rows])
