"""TUM RGB-D recordings, and those of people's own cameras in the same form.

::

    rgbd_dataset_freiburg1_xyz/
        rgb.txt             # stamp and path of each colour image, seconds; '#' starts a comment
        depth.txt           # the same for depth, 16-bit PNG, 5000 counts per metre, 0 = no reading
        groundtruth.txt     # stamp tx ty tz qx qy qz qw, camera to world; optional
        camera.yaml         # optional if the folder's name contains freiburg1, 2, 3 (or fr1, fr2, fr3)
        rgb/  depth/

Instead of ``rgb.txt`` and ``depth.txt`` there may be ``associations.txt`` (ORB-SLAM's form): stamp and path of a colour image,
then stamp and path of its depth image, or the other way round. The camera may then also be one of the files that plain folders
have (``intrinsics.txt``, see ``folder.py``), and depth is taken as millimetres unless ``camera.yaml`` or the folder's name says
otherwise.

Stamps may be milliseconds, microseconds or nanoseconds instead of seconds. A colour image is paired with the depth image
nearest in time, at most half the time between colour images away (but 20 to 50 ms), or ``--max-interval``. Each depth image
is used at most once, and colour images without a partner are skipped. Pairs in ``associations.txt`` are used as they are;
``--max-interval`` leaves out those further apart. The frame has the colour image's stamp.
"""

from __future__ import annotations

import heapq
import logging
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from splatam_core.datasets import base, files
from splatam_core.datasets.camera_file import CameraFile, DatasetCamera, find_camera_file, say_assumed
from splatam_core.datasets.folder import find_intrinsics
from splatam_core.datasets.icl import says_icl
from splatam_core.datasets.pairs import DepthFormat, ImagePair, ImagePairs
from splatam_core.errors import DatasetError
from splatam_core.geometry.camera import CameraCalibration, PinholeCamera
from splatam_core.geometry.stamps import guess_unit, stamp_number, stamp_text
from splatam_core.geometry.trajectory import read_ground_truth, too_many, warn_of_unit
from splatam_core.text_files import read_text

DEFAULT_DEPTH_SCALE = 5000.0
MILLIMETRES = 1000.0
ASSOCIATIONS = ('associations.txt', 'association.txt', 'associated.txt', 'associate.txt')
LEAST_INTERVAL_NS, MOST_INTERVAL_NS = 20_000_000, 50_000_000  # as for bags and live topics

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


_log = logging.getLogger(__name__)
Row = TypeVar('Row')


@dataclass(frozen=True, slots=True)
class _Listed:
    """An image of a list.

    Attributes:
        stamp_ns: time of the exposure.
        name: its path, as in the list.
    """

    stamp_ns: int
    name: str


def read(folder: Path, *, width: int | None = None, max_interval_ns: int | None = None) -> ImagePairs:
    """Read the lists of a folder and pair its images.

    Args:
        folder: holds the lists.
        width: width of the frames in pixels; None keeps the recorded size.
        max_interval_ns: largest difference between the stamps of a pair; None adapts it to the rate.

    Raises:
        DatasetError: a list is missing or broken, no images pair up, or the camera is unknown.
        CameraError: its ``camera.yaml`` cannot be used.
    """
    associations = _associations(folder)
    pairs = _pairs(folder, max_interval_ns) if associations is None else _associated(folder, associations, max_interval_ns)
    camera = _camera(folder, pairs, is_own=associations is not None)
    path = folder / 'groundtruth.txt'
    return ImagePairs(
        folder.resolve().name, pairs, camera.calibration, DepthFormat(camera.depth_scale),
        width=width, ground_truth=lambda: read_ground_truth(path) if path.exists() else None,
    )  # fmt: skip


def associate(a_ns: NDArray[np.int64], b_ns: NDArray[np.int64], max_interval_ns: int) -> list[tuple[int, int]]:
    """Pair two lists of increasing stamps, nearest pairs first; each stamp is in at most one pair.

    The two nearest stamps that are still without partner are always neighbours in time. So a queue of neighbours is enough,
    in which each pair that is taken makes new neighbours.

    Returns:
        Indices into both lists, in the order of the first.
    """
    stamps = np.concatenate([a_ns, b_ns])
    order = np.argsort(stamps, kind='stable').tolist()
    times, of_a = stamps.tolist(), len(a_ns)
    before = dict(zip(order[1:], order))
    after = dict(pairwise(order))
    queue: list[tuple[int, int, int]] = []

    def offer(one: int | None, other: int | None) -> None:
        if one is None or other is None or (one < of_a) == (other < of_a):
            return
        i, j = min(one, other), max(one, other)
        if abs(times[i] - times[j]) <= max_interval_ns:
            heapq.heappush(queue, (abs(times[i] - times[j]), i, j))

    for one, other in pairwise(order):
        offer(one, other)
    partner: dict[int, int] = {}
    taken: set[int] = set()
    while queue:
        _, i, j = heapq.heappop(queue)
        if i in partner or j in taken:
            continue
        partner[i] = j - of_a
        taken.add(j)
        for index in (i, j):
            left, right = before.pop(index, None), after.pop(index, None)
            if left is not None:
                after.pop(left)
            if right is not None:
                before.pop(right)
            if left is not None and right is not None:
                after[left], before[right] = right, left
                offer(left, right)
    return sorted(partner.items())


# --- camera ---


def _camera(folder: Path, pairs: Sequence[ImagePair], is_own: bool) -> DatasetCamera:
    """Returns the camera. is_own: True if the folder has the form that people use for their own cameras."""
    stated: CameraFile | None = find_camera_file(folder)
    known = _known_camera(folder)
    if stated is None and is_own:
        stated = find_intrinsics(folder, (pair.color for pair in pairs))
    if stated is None and known is None:
        raise DatasetError(
            f"{folder}: the camera is unknown, because the folder's name does not contain freiburg1, freiburg2 or freiburg3; "
            'put a camera.yaml with width, height, fx, fy, cx, cy into the folder'
        )
    if stated is None and known is not None:
        say_assumed(folder, "the camera that the folder's name says, as published with the TUM dataset,")
        return DatasetCamera(known, DEFAULT_DEPTH_SCALE)
    assert stated is not None
    if stated.depth_scale is not None or not is_own or known is not None:
        return DatasetCamera(stated.calibration, stated.depth_scale or DEFAULT_DEPTH_SCALE)
    _log.warning('%s: states no depth_scale; depth is taken as millimetres; state it in a camera.yaml if it is another', folder)
    return DatasetCamera(stated.calibration, MILLIMETRES)


def _known_camera(folder: Path) -> CameraCalibration | None:
    """Returns the published calibration of the camera in the folder's name; None if there is none in it."""
    match = re.search(r'(?<![a-z])(?:freiburg|fr)([123])(?!\d)', folder.resolve().name.lower())
    return KNOWN_CAMERAS[match.group(1)] if match else None


# --- lists ---


def _pairs(folder: Path, max_interval_ns: int | None) -> list[ImagePair]:
    rgb, depth = _read_list(folder / 'rgb.txt'), _read_list(folder / 'depth.txt')
    color_ns, depth_ns = _stamps_ns(rgb), _stamps_ns(depth)
    interval_ns = _usual_interval_ns(color_ns) if max_interval_ns is None else max_interval_ns
    pairs = associate(color_ns, depth_ns, interval_ns)
    if not pairs:
        raise DatasetError(
            f'{folder}: none of {len(rgb)} colour and {len(depth)} depth images are within {interval_ns / 1e6:g} ms of each other'
            f'{base.nearest_depth(color_ns, depth_ns)}'
        )
    found = [(rgb[i], depth[j]) for i, j in pairs]
    return [ImagePair(c.stamp_ns, files.listed(folder, c.name), files.listed(folder, d.name)) for c, d in found]


def _usual_interval_ns(color_ns: NDArray[np.int64]) -> int:
    """Returns half the median time between colour images, within limits."""
    if len(color_ns) < 2:
        return LEAST_INTERVAL_NS
    return min(max(int(np.median(np.diff(color_ns))) // 2, LEAST_INTERVAL_NS), MOST_INTERVAL_NS)


def _stamps_ns(rows: list[_Listed]) -> NDArray[np.int64]:
    return np.array([row.stamp_ns for row in rows], np.int64)


def _associations(folder: Path) -> Path | None:
    """Returns the list that states pairs; None if there are lists of colour and depth, or none."""
    if (folder / 'rgb.txt').is_file() and (folder / 'depth.txt').is_file():
        return None
    return next((folder / name for name in ASSOCIATIONS if (folder / name).is_file()), None)


def _associated(folder: Path, path: Path, max_interval_ns: int | None) -> list[ImagePair]:
    """Read a list of pairs. Which of the two images is depth is told by the paths; if they do not tell, it is the second.

    Args:
        folder: holds the images.
        path: the list.
        max_interval_ns: pairs further apart are left out, with a warning; None = none is.
    """
    rows = _rows(path, 'stamp path stamp path', 4)
    if not rows:
        raise DatasetError(f'{path}: no pair in it; expected lines with stamp, path of colour, stamp, path of depth')
    first, second = _listed(path, [row[:2] for row in rows]), _listed(path, [row[2:] for row in rows])
    says_depth = [sum('depth' in row.name.lower() for row in side) for side in (first, second)]
    color, depth = (second, first) if says_depth[0] > says_depth[1] else (first, second)
    pairs = _in_order(path, list(zip(color, depth, strict=True)), lambda pair: pair[0].stamp_ns)
    near = [pair for pair in pairs if max_interval_ns is None or abs(pair[0].stamp_ns - pair[1].stamp_ns) <= max_interval_ns]
    if max_interval_ns is not None and len(near) < len(pairs):
        apart = f'{path}: {len(pairs) - len(near)} of {len(pairs)} pairs are more than {max_interval_ns / 1e6:g} ms apart'
        if not near:
            stamps_ns = (_stamps_ns([pair[side] for pair in pairs]) for side in (0, 1))
            raise DatasetError(f'{apart}{base.nearest_depth(*stamps_ns)}')
        _log.warning('%s and left out', apart)
    return [ImagePair(c.stamp_ns, files.listed(folder, c.name), files.listed(folder, d.name)) for c, d in near]


def _read_list(path: Path) -> list[_Listed]:
    """Returns the images of a list in the order of their stamps."""
    rows = _rows(path, 'stamp path', 2)
    if not rows:
        raise DatasetError(f'{path}: no image in it; expected lines with stamp and path')
    return _in_order(path, _listed(path, rows), lambda row: row.stamp_ns)


def _rows(path: Path, expected: str, count: int) -> list[list[str]]:
    """Returns the fields of each line that is no comment: stamps and paths in turn. Single other lines are left out, and said.

    Args:
        path: the list.
        expected: the fields of a line, for people.
        count: their number.

    Raises:
        DatasetError: more than a tenth of the lines hold something else.
    """
    lines = [(number, line.strip()) for number, line in enumerate(read_text(path, DatasetError).splitlines(), 1) if line.strip()]
    lines = [(number, line) for number, line in lines if not line.startswith('#')]
    rows = [_fields(line, count) for _, line in lines]
    if len(rows) > 1 and rows[0] is None and not any(map(str.isdigit, lines[0][1])):  # a heading
        lines, rows = lines[1:], rows[1:]
    faults = [
        f"{path}:{number}: expected '{expected}', got '{line[:200]}'"
        for (number, line), row in zip(lines, rows, strict=True) if row is None
    ]  # fmt: skip
    if too_many(len(faults), len(rows)):
        raise DatasetError(faults[0])
    if faults:
        _log.warning('%s; of %d lines %d are left out', faults[0], len(rows), len(faults))
    return [row for row in rows if row is not None]


def _fields(line: str, count: int) -> list[str] | None:
    """Returns stamps and paths in turn; None if there are more or fewer, or a stamp is no number."""
    for separator in (None, ',', ';'):
        fields = [field.strip().strip('"\'').strip() for field in line.split(separator, count - 1)]
        if len(fields) == count and all(map(_is_stamp, fields[::2])) and all(fields):
            return fields
    return None


def _is_stamp(text: str) -> bool:
    try:
        stamp_number(text)
    except ValueError:
        return False
    return True


def _listed(path: Path, rows: list[list[str]]) -> list[_Listed]:
    numbers: list[Decimal] = [stamp_number(stamp) for stamp, _ in rows]
    unit = guess_unit(numbers)
    warn_of_unit(unit, path)
    try:
        return [_Listed(unit.stamp_ns(number), name) for number, (_, name) in zip(numbers, rows, strict=True)]
    except ValueError as error:
        raise DatasetError(f'{path}: {error}') from None


def _in_order(path: Path, rows: list[Row], stamp_ns: Callable[[Row], int]) -> list[Row]:
    """Returns the rows in the order of their stamps; of equal stamps the first row. What is changed is said.

    Raises:
        DatasetError: more than a tenth of the stamps are there already.
    """
    ordered = sorted(rows, key=stamp_ns)
    kept = ordered[:1] + [row for before, row in pairwise(ordered) if stamp_ns(row) > stamp_ns(before)]
    twice = len(rows) - len(kept)
    if too_many(twice, len(rows)):
        raise DatasetError(
            f'{path}: stamps must differ, but {twice} of {len(rows)} are there already, the first '
            f'{stamp_text(stamp_ns(ordered[0]))}; are they whole seconds?'
        )
    changes = [f'{twice} of {len(rows)} lines have a stamp that is there already and are left out'] if twice else []
    changes += ['the lines are not in the order of their stamps, and are sorted'] if ordered != rows else []
    if changes:
        _log.warning('%s: %s', path, '; '.join(changes))
    return kept


def _recognises(source: str) -> bool:
    return _accepts(source) and (_associations(Path(source)) is None or not says_icl(Path(source)))


def _accepts(source: str) -> bool:
    folder = Path(source)
    return ((folder / 'rgb.txt').is_file() and (folder / 'depth.txt').is_file()) or _associations(folder) is not None


def _open(source: str, options: base.ReadOptions) -> ImagePairs:
    interval_s = options.max_interval_s
    return read(Path(source), width=options.width, max_interval_ns=None if interval_s is None else round(interval_s * 1e9))


FORMAT = base.Format(
    'tum', 'a folder with rgb.txt and depth.txt, or associations.txt', _recognises, _open, accepts=_accepts, pairs_by_stamp=True
)
