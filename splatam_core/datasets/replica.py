"""Replica as NICE-SLAM rendered it.

::

    Replica/
        cam_params.json             # or in room0/; optional: else 1200x680, f 600, c 599.5 339.5, depth 6553.5
        room0/                      # SOURCE
            traj.txt                # 4x4 camera to world in each line, one per frame; optional
            results/
                frame000000.jpg
                depth000000.png     # 16 bit, 6553.5 counts per metre, 0 = no reading
            camera.yaml             # optional; overrides cam_params.json

Layout: NICE-SLAM, ``scripts/download_replica.sh`` and ``configs/Replica`` (github.com/cvg/nice-slam). Camera axes are
OpenCV's. There are no stamps: the first frame is at 1 s, and the numbers in the names count at 30 Hz.
"""

from __future__ import annotations

from pathlib import Path

from splatam_core.datasets import base, files
from splatam_core.datasets.camera_file import DatasetCamera, camera_of, checked_depth_scale, find_camera_file, say_assumed
from splatam_core.datasets.pairs import DepthFormat, ImagePairs, pair_up, row_trajectory, with_missing
from splatam_core.geometry.camera import CameraCalibration, PinholeCamera

CAMERA = DatasetCamera(CameraCalibration(PinholeCamera(1200, 680, 600.0, 600.0, 599.5, 339.5)), 6553.5)


def read(folder: Path, *, width: int | None = None) -> ImagePairs:
    """List the frames of a folder.

    Raises:
        DatasetError: there are no frames, too many lack their depth, or ``cam_params.json`` cannot be used.
        CameraError: the camera cannot be used.
    """
    depth = files.numbered(folder / 'results', r'depth(\d+)\.png')
    color = with_missing(files.numbered(folder / 'results', r'frame(\d+)\.(?:jpg|png)'), depth)
    pairs = pair_up(color, depth, folder, 'results/frame000000.jpg with results/depth000000.png')
    own = _camera(folder)
    camera = camera_of(folder, lambda: own.calibration, own.depth_scale)
    return ImagePairs(
        folder.resolve().name, pairs, camera.calibration, DepthFormat(camera.depth_scale),
        width=width, ground_truth=lambda: row_trajectory(folder / 'traj.txt', pairs, list(color)),
    )  # fmt: skip


def _camera(folder: Path) -> DatasetCamera:
    for path in (folder / 'cam_params.json', folder.resolve().parent / 'cam_params.json'):
        if path.exists():
            values = files.read_json(path)
            with files.parsing(path):
                c = values['camera']
                width, height = files.whole(c, 'w'), files.whole(c, 'h')
                fx, fy, cx, cy = (float(c[key]) for key in ('fx', 'fy', 'cx', 'cy'))
                pinhole = PinholeCamera(width, height, fx, fy, cx, cy)
                return DatasetCamera(CameraCalibration(pinhole), checked_depth_scale(c['scale']))
    if find_camera_file(folder) is None:
        say_assumed(folder, "NICE-SLAM's camera of Replica (f 600, c 599.5 339.5, 1200x680, 6553.5 counts per metre)")
    return CAMERA


def _recognises(source: str) -> bool:
    results = Path(source) / 'results'
    return any(any(results.glob(f'frame*.{suffix}')) for suffix in ('jpg', 'png'))


def _open(source: str, options: base.ReadOptions) -> ImagePairs:
    return read(Path(source), width=options.width)


FORMAT = base.Format('replica', 'a folder with results/frame000000.jpg and results/depth000000.png', _recognises, _open)
