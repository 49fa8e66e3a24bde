"""TUM RGB-D recordings.

::

    rgbd_dataset_freiburg1_xyz/
        rgb.txt             # stamp and path of each colour image, seconds; '#' starts a comment
        depth.txt           # the same for depth, 16-bit PNG, 5000 counts per metre, 0 = no reading
        groundtruth.txt     # stamp tx ty tz qx qy qz qw, camera to world; optional
        camera.yaml         # optional if the folder's name contains freiburg1, 2, 3 (or fr1, fr2, fr3)
        rgb/  depth/

A colour image is paired with the depth image nearest in time, at most 20 ms away. Each depth
image is used at most once, and colour images without a partner are skipped. The frame has the
colour image's stamp.
"""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatam_core.datasets import base
from splatam_core.datasets.camera_file import camera_of
from splatam_core.datasets.pairs import DepthFormat, ImagePair, ImagePairs
from splatam_core.errors import DatasetError
from splatam_core.geometry.camera import CameraCalibration, PinholeCamera
from splatam_core.geometry.trajectory import read_trajectory, stamp_from_text, stamp_text

DEFAULT_DEPTH_SCALE = 5000.0
MAX_INTERVAL_NS = 20_000_000

KNOWN_CAMERAS = {
    '1': CameraCalibration(
        PinholeCamera(640, 480, 517.306408, 516.469215, 318.643040, 255.313989),
        'plumb_bob', (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
    ),
    '2': CameraCalibration(
        PinholeCamera(640, 480, 520.908620, 521.007327, 325.141442, 249.701764),
        'plumb_bob', (0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
    ),
    '3': CameraCalibration(PinholeCamera(640, 480, 535.4, 539.2, 320.1, 247.6)),
}  # fmt: skip
"""The calibrations published with the dataset; freiburg3 images are already rectified."""


def read(folder: Path, *, width: int | None = None, max_interval_ns: int = MAX_INTERVAL_NS) -> ImagePairs:
    """Read the lists of a folder and pair its images.

    Raises:
        DatasetError: a list is missing or broken, no images pair up, or the camera is unknown.
        CameraError: its ``camera.yaml`` cannot be used.
    """
    camera = camera_of(folder, lambda: _known_camera(folder), DEFAULT_DEPTH_SCALE)
    path = folder / 'groundtruth.txt'
    return ImagePairs(
        folder.resolve().name, _pairs(folder, max_interval_ns), camera.calibration, DepthFormat(camera.depth_scale),
        width=width, ground_truth=lambda: read_trajectory(path) if path.exists() else None,
    )  # fmt: skip


def associate(a_ns: NDArray[np.int64], b_ns: NDArray[np.int64], max_interval_ns: int) -> list[tuple[int, int]]:
    """Pair two lists of increasing stamps, nearest pairs first; each stamp is in at most one pair.

    Returns:
        Indices into both lists, in the order of the first.
    """
    first = np.searchsorted(b_ns, a_ns - max_interval_ns, side='left')
    last = np.searchsorted(b_ns, a_ns + max_interval_ns, side='right')
    near = [(abs(int(a_ns[i] - b_ns[j])), i, j) for i in range(len(a_ns)) for j in range(first[i], last[i])]
    partner: dict[int, int] = {}
    taken: set[int] = set()
    for _, i, j in sorted(near):
        if i not in partner and j not in taken:
            partner[i] = j
            taken.add(j)
    return sorted(partner.items())


def _known_camera(folder: Path) -> CameraCalibration:
    """Returns the published calibration of the camera in the folder's name."""
    match = re.search(r'(?<![a-z])(?:freiburg|fr)([123])(?!\d)', folder.resolve().name.lower())
    if match is None:
        raise DatasetError(
            f"{folder}: the camera is unknown, because the folder's name does not contain freiburg1, freiburg2 or freiburg3; "
            'put a camera.yaml with width, height, fx, fy, cx, cy into the folder'
        )
    return KNOWN_CAMERAS[match.group(1)]


def _pairs(folder: Path, max_interval_ns: int) -> list[ImagePair]:
    rgb, depth = _read_list(folder / 'rgb.txt'), _read_list(folder / 'depth.txt')
    pairs = associate(_stamps_ns(rgb), _stamps_ns(depth), max_interval_ns)
    if not pairs:
        raise DatasetError(
            f'{folder}: none of {len(rgb)} colour and {len(depth)} depth images are within '
            f'{max_interval_ns / 1e6:g} ms of each other; do the stamps of both lists come from the same clock?'
        )
    return [ImagePair(rgb[i][0], folder / rgb[i][1], folder / depth[j][1]) for i, j in pairs]


def _stamps_ns(rows: list[tuple[int, str]]) -> NDArray[np.int64]:
    return np.array([stamp_ns for stamp_ns, _ in rows], np.int64)


def _read_list(path: Path) -> list[tuple[int, str]]:
    """Returns rows of (stamp_ns, path) with increasing stamps."""
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f'{path}: cannot be read: {error}') from None
    rows = [
        _parse_row(path, number, line) for number, line in enumerate(lines, 1) if line.strip() and not line.lstrip().startswith('#')
    ]
    for (before, _), (after, _) in pairwise(rows):
        if after <= before:
            raise DatasetError(f'{path}: stamps must increase, but {stamp_text(after)} follows {stamp_text(before)}')
    return rows


def _parse_row(path: Path, number: int, line: str) -> tuple[int, str]:
    try:
        stamp, name = line.split(maxsplit=1)
        return stamp_from_text(stamp), name.strip()
    except ValueError:
        raise DatasetError(f"{path}:{number}: expected 'stamp path', got '{line.strip()}'") from None


def _recognises(source: str) -> bool:
    return (Path(source) / 'rgb.txt').is_file() and (Path(source) / 'depth.txt').is_file()


def _open(source: str, options: base.ReadOptions) -> ImagePairs:
    return read(Path(source), width=options.width)


FORMAT = base.Format('tum', 'a folder with rgb.txt and depth.txt', _recognises, _open)
