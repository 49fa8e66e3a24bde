"""ScanNet scenes, exported from their ``.sens`` files.

::

    scene0000_00/                   # SOURCE; the files may also lie in frames/ below it
        color/0.jpg                 # 1296x968
        depth/0.png                 # 640x480, 16 bit, millimetres, 0 = no reading
        pose/0.txt                  # 4x4 camera to world; all -inf if tracking failed; optional
        intrinsic/
            intrinsic_color.txt     # 4x4
            intrinsic_depth.txt     # 4x4; optional: else depth is taken as colour's view at another size
            extrinsic_color.txt     # 4x4; optional
            extrinsic_depth.txt
        camera.yaml                 # optional; overrides the colour camera

Layout: ``SensReader/python`` (github.com/ScanNet/ScanNet), run with every ``--export`` option. Depth is
resampled to colour's pixels with both intrinsics. Both cameras are assumed to be at the same place; a warning is logged
if the extrinsics differ. Camera axes are OpenCV's. Frames without a pose are kept, and have no ground truth. Stamps are
not exported: the first frame is at 1 s, and the numbers in the names count at 30 Hz.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from splatam_core.datasets import base, files
from splatam_core.datasets.camera_file import camera_of
from splatam_core.datasets.pairs import DepthFormat, ImagePairs, pair_up, trajectory, with_missing
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.geometry.trajectory import Trajectory

DEPTH_SCALE = 1000.0
SAME_PLACE = 1e-3  # 1 mm, and less than a fifth of a pixel

_log = logging.getLogger(__name__)


def read(folder: Path, *, width: int | None = None) -> ImagePairs:
    """List the frames of a folder.

    Raises:
        DatasetError: there are no frames, too many lack their depth, or the intrinsics cannot be read.
        CameraError: the camera cannot be used.
    """
    frames = _frames(folder)
    depth_files = files.numbered(frames / 'depth', r'(\d+)\.png')
    color = with_missing(files.numbered(frames / 'color', r'(\d+)\.(?:jpg|png)'), depth_files)
    pairs = pair_up(color, depth_files, frames, 'color/0.jpg with depth/0.png')
    path = frames / 'intrinsic' / 'intrinsic_color.txt'
    camera = camera_of(
        folder,
        lambda: files.calibration_from_matrix(files.read_matrix(path, 4, 3), files.first_size(pair.color for pair in pairs)),
        DEPTH_SCALE,
    )
    _warn_of_extrinsics(frames / 'intrinsic')

    def ground_truth() -> Trajectory | None:
        posed = files.numbered(frames / 'pose', r'(\d+)\.txt')
        return trajectory(pairs, files.read_poses([posed.get(number) for number in color], frames))

    depth_camera = _depth_camera(frames, camera.calibration.pinhole, (pair.depth for pair in pairs))
    depth = DepthFormat(camera.depth_scale, camera=depth_camera)
    return ImagePairs(folder.resolve().name, pairs, camera.calibration, depth, width=width, ground_truth=ground_truth)


def _frames(folder: Path) -> Path:
    return folder / 'frames' if (folder / 'frames' / 'color').is_dir() else folder


def _depth_camera(frames: Path, color: PinholeCamera, depth: Iterable[Path | None]) -> PinholeCamera:
    path, size = frames / 'intrinsic' / 'intrinsic_depth.txt', files.first_size(depth)
    if not path.exists():
        return color.resized(*size)
    return files.calibration_from_matrix(files.read_matrix(path, 4, 3), size).pinhole


def _warn_of_extrinsics(folder: Path) -> None:
    for name in ('extrinsic_color.txt', 'extrinsic_depth.txt'):
        path = folder / name
        if path.exists() and np.abs(files.read_matrix(path, 4) - np.eye(4)).max() > SAME_PLACE:
            _log.warning('%s is not the identity: depth is used as if it were measured from the colour camera', path)


def _recognises(source: str) -> bool:
    frames = _frames(Path(source))
    return (frames / 'color').is_dir() and (frames / 'intrinsic' / 'intrinsic_color.txt').is_file()


def _open(source: str, options: base.ReadOptions) -> ImagePairs:
    return read(Path(source), width=options.width)


FORMAT = base.Format('scannet', 'a folder with color/, depth/ and intrinsic/intrinsic_color.txt', _recognises, _open)
