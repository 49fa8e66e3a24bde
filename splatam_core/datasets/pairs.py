"""Sequences of colour and depth image files, the form of nearly every dataset."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatam_core.datasets import base, files
from splatam_core.errors import DatasetError, FrameError
from splatam_core.geometry.camera import CameraCalibration, PinholeCamera
from splatam_core.geometry.stamps import LIMIT_NS
from splatam_core.geometry.trajectory import Trajectory, too_many
from splatam_core.images.rectification import FrameFactory
from splatam_core.types import RgbdFrame

SAMPLE = 100
"""How many frames are examined when a recording is opened."""

SHOWN = 3

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ImagePair:
    """The files of one frame.

    Attributes:
        stamp_ns: time of the exposure.
        color: image file.
        depth: image file, registered to colour; None if it is missing.
        calibration: the frame's own camera; None if all frames have the same.
    """

    stamp_ns: int
    color: Path
    depth: Path | None
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
            DatasetError: stamps do not increase, the first readable image does not have the camera's size, or more than a
                tenth of the images are missing or are none.
        """
        base.check_increasing(np.array([pair.stamp_ns for pair in pairs], np.int64), name)
        _check_files(pairs, name)
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
        """Read one frame.

        Raises:
            FrameError: one of its files is missing or damaged, or does not fit the camera.
        """
        pair = self._pairs[index]
        factory = self._factory(pair.calibration or self._calibration)
        try:
            if pair.depth is None:
                raise DatasetError(f'{pair.color}: there is no depth image for it')
            depth_m = self._depth.read(pair.depth)  # first, because it is larger: colour then finds less to break up
            rgb = files.read_color(pair.color)
        except DatasetError as error:
            raise FrameError(str(error)) from None
        return factory.make(pair.stamp_ns, rgb, depth_m)

    def ground_truth(self) -> Trajectory | None:
        """The true poses, read once; None if the dataset has none."""
        return self._known_ground_truth

    @cached_property
    def _known_ground_truth(self) -> Trajectory | None:
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


def _check_files(pairs: Sequence[ImagePair], name: str) -> None:
    """Check that the files of nearly all frames exist, and that nearly all of a sample of them are images."""
    names: dict[Path, set[str]] = {}
    missing = [fault for pair in pairs if (fault := _missing(pair, names))]
    _refuse_if_too_many(missing, len(pairs), name)
    sample = pairs[:: max(1, len(pairs) // SAMPLE)]
    _refuse_if_too_many([fault for pair in sample if (fault := _no_image(pair))], len(sample), name)


def _refuse_if_too_many(faults: Sequence[str], examined: int, name: str) -> None:
    if too_many(len(faults), examined):
        raise DatasetError(
            f'{name}: {len(faults)} of {examined} frames cannot be read, and at most a tenth may be missing: {_some(faults, "; ")}'
        )


def _some(names: Sequence[str], between: str) -> str:
    return between.join(names[:SHOWN]) + (' and so on' if len(names) > SHOWN else '')


def _missing(pair: ImagePair, names: dict[Path, set[str]]) -> str:
    """Returns which file of a frame does not exist; empty if both do. names: the files of each folder, found on the way."""
    if pair.depth is None:
        return f'{pair.color}: there is no depth image for it'
    for path in (pair.color, pair.depth):
        if path.parent not in names:
            names[path.parent] = _names_in(path.parent)
        if path.name not in names[path.parent] and not os.path.isfile(path):
            return f'{path}: there is no such file'
    return ''


def _names_in(folder: Path) -> set[str]:
    try:
        return set(os.listdir(folder))
    except (OSError, ValueError):
        return set()


def _no_image(pair: ImagePair) -> str:
    """Returns which file of a frame is no image; empty if both are."""
    try:
        for path in filter(None, (pair.color, pair.depth)):
            files.image_size(path)
    except DatasetError as error:
        return str(error)
    return ''


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
        DatasetError: there is no colour image, more than a tenth have no depth, or the numbers are too large.
    """
    if not color:
        raise DatasetError(f'{folder}: no frame in it; expected {expected} and so on')
    missing = [path.name for number, path in color.items() if number not in depth]
    if too_many(len(missing), len(color)):
        raise DatasetError(
            f'{folder}: {len(missing)} of {len(color)} colour images have no depth, and at most a tenth may lack it: '
            f'{_some(missing, ", ")}; every frame needs both, named like {expected}'
        )
    first, own = next(iter(color)), calibrations or {}
    if base.nominal_stamp_ns(max(color) - first, rate_hz) >= LIMIT_NS:
        raise DatasetError(f'{folder}: the numbers in the names, {first} to {max(color)}, are too large to count frames')
    return [
        ImagePair(base.nominal_stamp_ns(number - first, rate_hz), path, depth.get(number), own.get(number))
        for number, path in color.items()
    ]


def with_missing(color: Mapping[int, Path], depth: Mapping[int, Path]) -> dict[int, Path]:
    """Returns the colour files by number, with the names that are missing for depth images, so that each of these costs a frame.

    Args:
        color: files by number, whose names hold these numbers.
        depth: likewise.
    """
    if not color:
        return {}
    like = next(iter(color.values()))
    expected = {
        number: like.with_name(_renumbered(like.name, next(iter(color)), number)) for number in depth if number not in color
    }
    return dict(sorted({**color, **expected}.items()))


def _renumbered(name: str, number: int, other: int) -> str:
    """Returns a file's name with another number; as many digits, if there are zeros in front."""
    digits = [found for found in re.finditer(r'\d+', name) if int(found[0]) == number]
    start, end = digits[-1].span()
    return f'{name[:start]}{other:0{end - start if name[start] == "0" else 1}d}{name[end:]}'


def trajectory(pairs: Sequence[ImagePair], poses: Sequence[NDArray[np.float64] | None]) -> Trajectory | None:
    """Returns the known poses at the stamps of their frames; None if none is known. Says how many are unknown."""
    known = [(pair.stamp_ns, T) for pair, T in zip(pairs, poses, strict=True) if T is not None]
    if not known:
        return None
    if len(known) < len(pairs):
        _log.warning('%s: %d of %d true poses are unknown', pairs[0].color.parent, len(pairs) - len(known), len(pairs))
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
