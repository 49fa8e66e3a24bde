"""Reads the files that datasets consist of: images, matrices, poses, numbered names. Every error names the file."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splatam_core.errors import DatasetError
from splatam_core.geometry import se3
from splatam_core.geometry.camera import CameraCalibration, PinholeCamera

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


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
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def read_depth_counts(path: Path) -> NDArray[np.uint16]:
    """Read a 16-bit depth image file, [H, W] counts.

    Raises:
        DatasetError: the file is missing, not an image, or not one channel of 16 bits.
    """
    counts = _read_image(path, cv2.IMREAD_UNCHANGED)
    if counts.dtype != np.uint16 or counts.ndim != 2:
        raise DatasetError(f'{path}: depth must be one channel of 16 bits, got {counts.dtype} {counts.shape}')
    return counts


def read_exr(path: Path) -> NDArray[np.float32]:
    """Read the first channel (of R, Y, Z, in this order) of an OpenEXR image, [H, W].

    Raises:
        DatasetError: the file cannot be read, has none of these channels, or OpenEXR is not installed.
    """
    try:
        import OpenEXR  # only this format needs it
    except ImportError:
        raise DatasetError(f"{path}: reading EXR needs OpenEXR: pip install 'splatam_ros[exr]'") from None
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(channel.pixels, np.float32) for name, channel in file.channels().items()}
    except (OSError, RuntimeError, ValueError, TypeError) as error:
        raise DatasetError(f'{path}: cannot be read as OpenEXR: {error}') from None
    for name in ('R', 'Y', 'Z'):
        if name in channels:
            return channels[name]
    raise DatasetError(f'{path}: no channel R, Y or Z for depth; it has {", ".join(channels) or "none"}')


def image_size(path: Path) -> tuple[int, int]:
    """Returns the width and height of an image file.

    Raises:
        DatasetError: the file is missing or not an image.
    """
    height, width = _read_image(path, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION).shape[:2]
    return width, height


def _read_image(path: Path, flags: int) -> NDArray[Any]:
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise DatasetError(f'{path}: cannot be read: {error.strerror}') from None
    image = cv2.imdecode(data, flags) if data.size else None
    if image is None:
        raise DatasetError(f'{path}: is not an image that OpenCV can read ({data.size} bytes); is the copy complete?')
    return image


# --- numbers ---


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Raises:
        DatasetError: the file cannot be read, or holds no object.
    """
    try:
        values = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise DatasetError(f'{path}: cannot be read as JSON: {error}') from None
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
    except (TypeError, ValueError, IndexError, AttributeError) as error:
        raise DatasetError(f'{path}: is not as expected: {error}') from None


def read_numbers(path: Path) -> NDArray[np.float64]:
    """Read all numbers of a text or ``.npy`` file, [N]; -inf, inf and nan are numbers.

    Raises:
        DatasetError: the file cannot be read, or holds something else.
    """
    if path.suffix == '.npy':
        return _read_npy(path)
    try:
        return np.array(path.read_text().split(), dtype=np.float64)
    except (OSError, ValueError) as error:
        raise DatasetError(f'{path}: cannot be read: {error}') from None


def _read_npy(path: Path) -> NDArray[np.float64]:
    try:
        return np.load(path, allow_pickle=False).astype(np.float64).reshape(-1)
    except OSError as error:
        raise DatasetError(f'{path}: cannot be read: {error}') from None
    except (ValueError, TypeError, EOFError):  # numpy's own message advises unpickling, which is unsafe
        raise DatasetError(f'{path}: is no complete .npy file of numbers; is the copy complete?') from None


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
        [4, 4]; None if a number is infinite or NaN, by which datasets mark unknown poses.

    Raises:
        DatasetError: there are not 12 or 16 numbers, or the upper left 3x3 is no rotation.
    """
    values = np.asarray(values, np.float64).reshape(-1)
    if values.size not in (12, 16):
        raise DatasetError(f'{where}: expected the 16 numbers of a 4x4 camera-to-world matrix, got {values.size}')
    if not np.isfinite(values).all():
        return None
    R, t = (T := values[:12].reshape(3, 4))[:, :3], T[:, 3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-2 or np.linalg.det(R) < 0:
        raise DatasetError(f'{where}: its upper left 3x3 is no rotation; expected a 4x4 camera-to-world matrix')
    return se3.compose(se3.quaternion_from_rotation(R), t)


def read_pose(path: Path) -> NDArray[np.float64] | None:
    """Read one pose file; see ``pose``."""
    return pose(read_numbers(path), str(path))


def read_pose_rows(path: Path) -> list[NDArray[np.float64] | None]:
    """Read a file with the 12 or 16 numbers of one pose in each line.

    Raises:
        DatasetError: the file cannot be read, or a line is no pose.
    """
    try:
        lines = [line.split() for line in path.read_text().splitlines() if line.strip()]
        rows = [np.array(line, dtype=np.float64) for line in lines]
    except (OSError, ValueError) as error:
        raise DatasetError(f'{path}: cannot be read: {error}') from None
    return [pose(row, f'{path}, pose {number}') for number, row in enumerate(rows)]


def from_opengl(T_world_cam: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
    """Convert a pose from OpenGL's camera axes (x right, y up, z backward) to OpenCV's (x right, y down, z forward)."""
    return None if T_world_cam is None else T_world_cam @ OPENCV_FROM_OPENGL
