"""Replica-V2: Replica as vMAP rendered it, with a second camera path for testing novel views.

::

    room_0/                         # SOURCE
        imap/
            00/                     # split train
                traj_w_c.txt        # 4x4 camera to world in each line, one per frame; optional
                rgb/rgb_0.png
                depth/depth_0.png   # 16 bit, millimetres, 0 = no reading
            01/                     # split test: the same world
                ...
        camera.yaml                 # optional: else 1200x680, f 600, c 599.5 339.5

Layout: vMAP's Replica download (github.com/kxhit/vMAP, ``configs/Replica``); the split is SplaTAM's. Camera axes are
OpenCV's. There are no stamps: the first frame is at 1 s, and the numbers in the names count at 30 Hz.
"""

from __future__ import annotations

from pathlib import Path

from splatam_core.datasets import base, files, replica
from splatam_core.datasets.camera_file import camera_of, say_assumed
from splatam_core.datasets.pairs import DepthFormat, ImagePairs, pair_up, row_trajectory, with_missing
from splatam_core.errors import DatasetError
from splatam_core.geometry.camera import CameraCalibration

FOLDERS = {'train': '00', 'test': '01'}
DEPTH_SCALE = 1000.0


def read(folder: Path, *, split: str = 'train', width: int | None = None) -> ImagePairs:
    """List the frames of a split.

    Raises:
        DatasetError: the split is not there, has no frames, or too many lack their depth.
        CameraError: ``camera.yaml`` cannot be used.
    """
    frames = folder / 'imap' / FOLDERS[split]
    if not frames.is_dir():
        raise DatasetError(f'{frames}: there is no such folder; split {split} is expected there')
    depth = files.numbered(frames / 'depth', r'depth_(\d+)\.png')
    color = with_missing(files.numbered(frames / 'rgb', r'rgb_(\d+)\.png'), depth)
    pairs = pair_up(color, depth, frames, 'rgb/rgb_0.png with depth/depth_0.png')
    camera = camera_of(folder, lambda: _assumed(folder), DEPTH_SCALE)
    return ImagePairs(
        f'{folder.resolve().name}_{split}', pairs, camera.calibration, DepthFormat(camera.depth_scale),
        width=width, ground_truth=lambda: row_trajectory(frames / 'traj_w_c.txt', pairs, list(color)),
    )  # fmt: skip


def _assumed(folder: Path) -> CameraCalibration:
    say_assumed(folder, "vMAP's camera of Replica (f 600, c 599.5 339.5, 1200x680)")
    return replica.CAMERA.calibration


def _recognises(source: str) -> bool:
    return any((Path(source) / 'imap' / name / 'rgb').is_dir() for name in FOLDERS.values())


def _open(source: str, options: base.ReadOptions) -> ImagePairs:
    return read(Path(source), split=options.split or 'train', width=options.width)


FORMAT = base.Format('replica_v2', 'a folder with imap/00/rgb and imap/00/depth', _recognises, _open, has_splits=True)
