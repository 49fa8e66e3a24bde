"""Reads the files that datasets consist of: images, matrices, poses, numbered names. Every error names the file."""

from __future__ import annotations

import io
import logging
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from msg_adapters.image_headers import EXR, is_cut, stated_size, too_large
from splatam_core.errors import DatasetError, one_line
from splatam_core.geometry import se3
from splatam_core.geometry.camera import CameraCalibration, PinholeCamera
from splatam_core.geometry.trajectory import LARGEST_POSITION_M, too_many
from splatam_core.text_files import read_bytes, read_text
from splatam_core.text_files import read_json as read_any_json

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
MAX_IMAGE_BYTES = 2**29
MAX_NUMBERS_BYTES = 2**26
HEADER_BYTES = 2**16
IMAGE_SUFFIXES = frozenset({'.png', '.jpg', '.jpeg', '.tif', '.tiff', '.bmp', '.webp', '.pgm', '.ppm', '.pnm', '.exr'})

Pose = NDArray[np.float64]

_log = logging.getLogger(__name__)


def calibration_from_matrix(K: NDArray[np.float64], size: tuple[int, int]) -> CameraCalibration:
    """Returns an ideal camera with an intrinsic matrix, 3x3 or larger, and the width and height of its images."""
    fx, fy, cx, cy = (float(K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return CameraCalibration(PinholeCamera(*size, fx, fy, cx, cy))


def numbered(folder: Path, pattern: str) -> dict[int, Path]:
    """Returns the files of a folder by the number in their names, in the order of the numbers.

    Args:
        folder: need not exist.
        pattern: regular expression of the whole name; its group is the number. If several files have the same
            number, the last one by name counts (``.png`` before ``.jpg``).
    """
    paths = sorted(folder.iterdir()) if folder.is_dir() else []
    found = {int(match.group(1)): path for path in paths if (match := re.fullmatch(pattern, path.name))}
    return dict(sorted(found.items()))


# --- images ---


def read_color(path: Path) -> NDArray[np.uint8]:
    """Read a colour image file as RGB, [H, W, 3].

    Raises:
        DatasetError: the file is missing or not an image.
    """
    image = _read_image(path, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB, image), np.uint8)  # in place


def read_depth_counts(path: Path) -> NDArray[np.uint16]:
    """Read a 16-bit depth image file, [H, W] counts.

    Raises:
        DatasetError: the file is missing, not an image, or not one channel of 16 bits.
    """
    counts = _read_image(path, cv2.IMREAD_UNCHANGED)
    if counts.dtype != np.uint16 or counts.ndim != 2:
        raise DatasetError(f'{path}: depth must be one channel of 16 bits, got {counts.dtype} {counts.shape}')
    return counts


def check_exr(path: Path) -> None:
    """Check that OpenEXR images can be read. path: names the recording in the message.

    Raises:
        DatasetError: OpenEXR is not installed.
    """
    try:
        import OpenEXR  # noqa: F401  # only this format needs it
    except ImportError:
        raise DatasetError(f"{path}: reading EXR needs OpenEXR: pip install 'splatam_ros[exr]'") from None


def read_exr(path: Path) -> NDArray[np.float32]:
    """Read the first channel (of R, Y, Z, in this order) of an OpenEXR image, [H, W].

    Raises:
        DatasetError: the file cannot be read, claims to be too large, has none of these channels, or OpenEXR is not installed.
    """
    check_exr(path)
    import OpenEXR

    if not _image_bytes(path).startswith(EXR):
        raise DatasetError(f'{path}: cannot be read as OpenEXR: it is another kind of file')
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(channel.pixels, np.float32) for name, channel in file.channels().items()}
    except Exception as error:  # the library raises a dozen types on damaged files
        raise DatasetError(f'{path}: cannot be read as OpenEXR: {one_line(error) or type(error).__name__}') from error
    for name in ('R', 'Y', 'Z'):
        if name in channels and channels[name].ndim == 2:
            return channels[name]
    raise DatasetError(f'{path}: no channel R, Y or Z for depth; it has {", ".join(channels) or "none"}')


def image_size(path: Path) -> tuple[int, int]:
    """Returns the width and height of an image file as its header states them.

    Raises:
        DatasetError: the file is missing, not an image, or claims to be too large.
    """
    data = read_bytes(path, DatasetError, MAX_IMAGE_BYTES, HEADER_BYTES)
    if len(data) == HEADER_BYTES and stated_size(data) is None:  # metadata may come before the size
        data = read_bytes(path, DatasetError, MAX_IMAGE_BYTES)
    return _checked_size(path, data)


def first_size(paths: Iterable[Path | None]) -> tuple[int, int]:
    """Returns the width and height of the first image that has a readable header.

    Raises:
        DatasetError: there is none.
    """
    first_error: DatasetError | None = None
    for path in paths:
        try:
            if path is not None:
                return image_size(path)
        except DatasetError as error:
            first_error = first_error or error
    raise first_error or DatasetError('there is no image')


def _checked_size(path: Path, data: bytes) -> tuple[int, int]:
    size = stated_size(data)
    if size is None:
        hint = (
            'it is a pointer of Git LFS: fetch the files'
            if data.startswith(b'version https://git-lfs')
            else 'is the copy complete?'
        )
        raise DatasetError(f'{path}: is not an image that can be read ({len(data)} bytes); {hint}')
    if why := too_large(size):
        raise DatasetError(f'{path}: {why}')
    return size


def _image_bytes(path: Path) -> bytes:
    """Read an image file and check the size that it states, before it is decoded."""
    data = read_bytes(path, DatasetError, MAX_IMAGE_BYTES)
    _checked_size(path, data)
    if is_cut(data):
        raise DatasetError(f'{path}: is damaged, or cut off after {len(data)} bytes; is the copy complete?')
    return data


def decoded(data: NDArray[np.uint8], size: tuple[int, int], flags: int) -> NDArray[Any]:
    """Returns the image in the bytes of a file.

    Args:
        data: [N] the bytes.
        size: width and height that the image must have; another one is not decoded.
        flags: OpenCV's, how to decode it.

    Raises:
        ValueError: the bytes are no such image.
    """
    stated = stated_size(data.tobytes())
    if stated != size or is_cut(data.tobytes()):
        raise ValueError(f'an image of {stated}; expected {size}')
    image = cv2.imdecode(data, flags)
    if image is None:
        raise ValueError(f'an image of {len(data)} bytes that cannot be decoded')
    return image


def _read_image(path: Path, flags: int) -> NDArray[Any]:
    data = _image_bytes(path)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise DatasetError(f'{path}: is not an image that OpenCV can read: {one_line(error)}') from None
    if image is None:
        raise DatasetError(f'{path}: is not an image that OpenCV can read ({len(data)} bytes); is the copy complete?')
    return image


def listed(folder: Path, name: str) -> Path:
    """Returns the file that a list in a folder refers to. Lists written on Windows have backslashes, some omit the suffix."""
    path = folder / name
    if '\\' in name and not _is_file(path):
        path = folder / name.replace('\\', '/')
    if path.suffix.lower() in IMAGE_SUFFIXES or _is_file(path):
        return path
    others = [path.with_name(path.name + suffix) for suffix in ('.png', '.jpg', '.jpeg')] if path.name else []
    return next(filter(_is_file, others), others[0] if others else path)


def _is_file(path: Path) -> bool:
    return os.path.isfile(path)  # False for impossible names, too


# --- numbers ---


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        DatasetError: the file cannot be read, or holds no object.
    """
    values = read_any_json(path, DatasetError)
    if not isinstance(values, dict):
        raise DatasetError(f'{path}: expected a JSON object, got {type(values).__name__}')
    return values


@contextmanager
def parsing(path: Path) -> Iterator[None]:
    """Turn errors about missing or unsuitable values, raised while a file's content is parsed, into ``DatasetError``."""
    try:
        yield
    except KeyError as error:
        raise DatasetError(f'{path}: {error} is missing') from None
    except (TypeError, ValueError, IndexError, AttributeError, ArithmeticError) as error:
        raise DatasetError(f'{path}: is not as expected: {one_line(error)}') from None


def whole(values: Mapping[str, Any], key: str) -> int:
    """Returns a whole number.

    Raises:
        ValueError: the value is something else.
        KeyError: it is missing.
    """
    value = values[key]
    number = float(value) if isinstance(value, (int, float, str)) and not isinstance(value, bool) else None
    if number is None or not number.is_integer():
        raise ValueError(f'{key} {value!r} is not a whole number')
    return int(number)


def read_numbers(path: Path) -> NDArray[np.float64]:
    """Read all numbers of a text or ``.npy`` file, [N]; -inf, inf and nan are numbers.

    Raises:
        DatasetError: the file cannot be read, or holds something else.
    """
    if path.suffix == '.npy':
        return _read_npy(path)
    text = read_text(path, DatasetError, MAX_NUMBERS_BYTES)
    try:
        return np.array(text.split(), dtype=np.float64)
    except ValueError as error:
        raise DatasetError(f'{path}: cannot be read: {one_line(error)}') from None


def _read_npy(path: Path) -> NDArray[np.float64]:
    data = read_bytes(path, DatasetError, MAX_NUMBERS_BYTES)
    try:
        return _npy_numbers(data)
    except Exception as error:  # numpy raises a dozen types on damaged headers, and advises unpickling, which is unsafe
        raise DatasetError(f'{path}: is no complete .npy file of numbers; is the copy complete?') from error


def _npy_numbers(data: bytes) -> NDArray[np.float64]:
    """Returns the numbers of a .npy file in C order. The size that the header states is compared with the file's."""
    file = io.BytesIO(data)
    version = np.lib.format.read_magic(file)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, is_fortran, dtype = read_header(file)
    rest = data[file.tell() :]
    if dtype.kind not in 'biuf' or math.prod(shape) * dtype.itemsize != len(rest):
        raise ValueError('other numbers than the header states')
    values = np.frombuffer(rest, dtype).reshape(shape, order='F' if is_fortran else 'C')
    return values.astype(np.float64).reshape(-1)


def read_matrix(path: Path, *sizes: int) -> NDArray[np.float64]:
    """Read a square matrix of finite numbers, in rows.

    Args:
        path: a text or ``.npy`` file.
        sizes: the sizes allowed.

    Raises:
        DatasetError: the file cannot be read, or holds anything else.
    """
    values = read_numbers(path)
    for size in sizes:
        if values.size == size * size and np.isfinite(values).all():
            return values.reshape(size, size)
    allowed = ' or '.join(f'{size}x{size}' for size in sizes)
    raise DatasetError(f'{path}: expected {allowed} finite numbers, got {values.size} numbers')


# --- poses ---


def pose(values: NDArray[np.float64], where: str) -> NDArray[np.float64] | None:
    """Convert numbers to a pose whose rotation is orthonormal, even if the file rounds it.

    Args:
        values: 16 numbers of a 4x4 matrix, or the 12 of its upper rows.
        where: names the pose in an error message.

    Returns:
        [4, 4]; None if a number is infinite, NaN or impossible for a position, by which datasets mark unknown poses.

    Raises:
        DatasetError: there are not 12 or 16 numbers, or the upper left 3x3 is no rotation.
    """
    values = np.asarray(values, np.float64).reshape(-1)
    if values.size not in (12, 16):
        raise DatasetError(f'{where}: expected the 16 numbers of a 4x4 camera-to-world matrix, got {values.size}')
    if not np.isfinite(values).all():
        return None
    R, t = (T := values[:12].reshape(3, 4))[:, :3], T[:, 3]
    if np.abs(t).max() > LARGEST_POSITION_M:
        return None
    if np.abs(R).max() > 2 or np.abs(R @ R.T - np.eye(3)).max() > 1e-2 or np.linalg.det(R) < 0:
        raise DatasetError(f'{where}: its upper left 3x3 is no rotation; expected a 4x4 camera-to-world matrix')
    return se3.compose(se3.quaternion_from_rotation(R), t)


def read_poses(paths: Sequence[Path | None], name: object) -> list[Pose | None]:
    """Read the pose file of each frame; see ``pose`` and ``tolerated``.

    Args:
        paths: of the files; None = the frame has none.
        name: of the recording, for the warning.

    Raises:
        DatasetError: more than a tenth of the files are no poses.
    """
    poses = iter(tolerated([partial(_read_pose, path) for path in paths if path is not None], name))
    return [None if path is None else next(poses) for path in paths]


def _read_pose(path: Path) -> Pose | None:
    return pose(read_numbers(path), str(path))


def read_pose_rows(path: Path) -> list[Pose | None]:
    """Read a file with the 12 or 16 numbers of one pose in each line. A line that is no pose is an unknown pose.

    Raises:
        DatasetError: the file cannot be read, or more than a tenth of the lines are no poses.
    """
    lines = [line for line in read_text(path, DatasetError).splitlines() if line.strip()]

    def read(index: int, line: str) -> Pose | None:
        where = f'{path}, pose {index}'
        try:
            return pose(np.array(line.split(), dtype=np.float64), where)
        except ValueError as error:
            raise DatasetError(f'{where}: {one_line(error)}') from None

    return tolerated([partial(read, *line) for line in enumerate(lines)], path)


def tolerated(readers: Sequence[Callable[[], Pose | None]], name: object) -> list[Pose | None]:
    """Read poses one by one. One that cannot be read is unknown, which a warning says.

    Args:
        readers: each returns a pose, or raises ``DatasetError``.
        name: of the recording, for the warning.

    Raises:
        DatasetError: more than a tenth of them cannot be read.
    """
    poses: list[Pose | None] = []
    faults: list[DatasetError] = []
    for read in readers:
        try:
            poses.append(read())
        except DatasetError as error:
            poses.append(None)
            faults.append(error)
    if too_many(len(faults), len(readers)):
        raise faults[0]
    if faults:
        _log.warning('%s: %d of %d true poses cannot be read and are left out: %s', name, len(faults), len(readers), faults[0])
    return poses


def from_opengl(T_world_cam: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
    """Convert a pose from OpenGL's camera axes (x right, y up, z backward) to OpenCV's (x right, y down, z forward)."""
    return None if T_world_cam is None else T_world_cam @ OPENCV_FROM_OPENGL
