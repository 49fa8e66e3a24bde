"""ICL-NUIM recordings, the TUM-compatible PNGs.

::

    living_room_traj2_frei_png/
        livingRoom2.gt.freiburg     # frame tx ty tz qx qy qz qw, camera to world, y up
        associations.txt            # optional
        rgb/0.png
        depth/0.png                 # 16 bit, 5000 counts per metre, along the axis; 0 = no reading
        camera.yaml                 # optional: else 640x480, f 481.2 480, c 319.5 239.5

A folder without ``.gt.freiburg`` is taken for ICL-NUIM only if its name says so (``living_room_traj2``, ``office_traj0``,
``icl``), or with ``--format icl``.

Layout: doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html. The poses have POV-Ray's left-handed world and camera axes, y up, while
image rows run downwards. The reader mirrors them, T' = F T F with F = diag(1, -1, 1, 1), and takes fy = +480 (-480
belongs to the POV-Ray files, which are not read). cuVSLAM's converter does the same (nvidia-isaac/cuVSLAM #135).
Ground truth is assigned by the frame numbers in its file: frame 0, and in the office scenes frame 1, have none.
``.gt.sim`` has no frame numbers and is not read. The first frame is at 1 s, and the numbers in the names count at 30 Hz.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatam_core.datasets import base, files
from splatam_core.datasets.camera_file import camera_of, say_assumed
from splatam_core.datasets.pairs import DepthFormat, ImagePairs, pair_up, trajectory, with_missing
from splatam_core.errors import DatasetError
from splatam_core.geometry import se3
from splatam_core.geometry.camera import CameraCalibration, PinholeCamera
from splatam_core.geometry.trajectory import Trajectory, is_pose

CAMERA = CameraCalibration(PinholeCamera(640, 480, 481.2, 480.0, 319.5, 239.5))
DEPTH_SCALE = 5000.0
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def read(folder: Path, *, width: int | None = None) -> ImagePairs:
    """List the frames of a folder.

    Raises:
        DatasetError: there are no frames, or too many lack their depth.
        CameraError: ``camera.yaml`` cannot be used.
    """
    depth = files.numbered(folder / 'depth', r'(\d+)\.png')
    color = with_missing(files.numbered(folder / 'rgb', r'(\d+)\.png'), depth)
    pairs = pair_up(color, depth, folder, 'rgb/0.png with depth/0.png')
    camera = camera_of(folder, lambda: _assumed(folder), DEPTH_SCALE)

    def ground_truth() -> Trajectory | None:
        poses = _poses(folder)
        return trajectory(pairs, [poses.get(number) for number in color])

    return ImagePairs(
        folder.resolve().name, pairs, camera.calibration, DepthFormat(camera.depth_scale), width=width, ground_truth=ground_truth
    )


def _poses(folder: Path) -> dict[int, NDArray[np.float64]]:
    """Returns the poses by frame number."""
    paths = sorted(folder.glob('*.gt.freiburg'))
    if len(paths) > 1:
        raise DatasetError(f'{folder}: holds {", ".join(path.name for path in paths)}; keep the one that belongs to it')
    if not paths:
        return {}
    numbers = files.read_numbers(paths[0])
    if numbers.size % 8:
        raise DatasetError(f"{paths[0]}: expected 'frame tx ty tz qx qy qz qw' in each line, got {numbers.size} numbers")
    rows = numbers.reshape(-1, 8)
    is_known = np.array([is_pose(row[1:4].tolist(), row[4:].tolist()) and abs(row[0]) < 2**53 for row in rows], bool)
    if len(rows) and not is_known.any():
        raise DatasetError(f'{paths[0]}: none of its {len(rows)} poses is known: each holds NaN, infinity or no rotation')
    rows = rows[is_known]
    T = MIRROR @ se3.compose(rows[:, [7, 4, 5, 6]], rows[:, 1:4]) @ MIRROR
    return dict(zip(rows[:, 0].astype(int).tolist(), T, strict=True))


def _assumed(folder: Path) -> CameraCalibration:
    say_assumed(folder, 'the camera of ICL-NUIM (f 481.2 480, c 319.5 239.5, 640x480)')
    return CAMERA


def says_icl(folder: Path) -> bool:
    """Returns True if a folder says that it is a recording of ICL-NUIM, by a file or by its name."""
    named = re.search(r'(living.?room|office).*traj\d|traj\d_frei|(?<![a-z])icl(?![a-z])', folder.resolve().name.lower())
    return named is not None or any(folder.glob('*.gt.freiburg'))


def _recognises(source: str) -> bool:
    return _accepts(source) and says_icl(Path(source))


def _accepts(source: str) -> bool:
    folder = Path(source)
    has_images = (folder / 'rgb').is_dir() and (folder / 'depth').is_dir()
    return has_images and not (folder / 'rgb.txt').exists()


def _open(source: str, options: base.ReadOptions) -> ImagePairs:
    return read(Path(source), width=options.width)


FORMAT = base.Format('icl', 'a folder with rgb/, depth/ and a .gt.freiburg file', _recognises, _open, accepts=_accepts)
