"""ScanNet++ scenes, the iPhone's video.

::

    8b5caf3398/iphone/                  # SOURCE
        pose_intrinsic_imu.json         # by name (frame_000000): intrinsic (3x3), aligned_pose (4x4; optional)
        rgb/frame_000000.jpg            # 1920x1440
        depth/frame_000000.png          # 256x192, 16 bit, millimetres, 0 = no reading
        camera.yaml                     # optional; overrides the cameras in the JSON file

Layout: kaldir.vc.in.tum.de/scannetpp/documentation; ``iphone.prepare_iphone_data`` of the toolkit
(github.com/scannetpp/scannetpp) makes images and depth, and ``iphone/arkit_pcl.py`` there shows how they relate:
``aligned_pose`` is camera to world with OpenCV's axes, depth is colour's view at another size. Intrinsics differ between
frames; all frames are rectified to the first frame's camera. The numbers in the names count at 60 Hz, the first is at 1 s.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from splatam_core.datasets import base, files
from splatam_core.datasets.camera_file import camera_of
from splatam_core.datasets.pairs import DepthFormat, ImagePairs, pair_up, trajectory, with_missing

DEPTH_SCALE = 1000.0
RATE_HZ = 60


def read(folder: Path, *, width: int | None = None) -> ImagePairs:
    """List the frames of a folder.

    Raises:
        DatasetError: ``pose_intrinsic_imu.json`` cannot be used or lacks a frame, or one has no depth.
        CameraError: a camera cannot be used.
    """
    path = folder / 'pose_intrinsic_imu.json'
    stated = files.read_json(path)
    depth = files.numbered(folder / 'depth', r'frame_(\d+)\.png')
    color = with_missing(files.numbered(folder / 'rgb', r'frame_(\d+)\.(?:jpg|png)'), depth)
    size = files.first_size(color.values()) if color else (0, 0)
    with files.parsing(path):
        frames = {number: stated[file.stem] for number, file in color.items()}
        cameras = {
            number: files.calibration_from_matrix(np.array(frame['intrinsic'], np.float64).reshape(3, 3), size)
            for number, frame in frames.items()
        }
    own = None if (folder / 'camera.yaml').exists() else cameras
    expected = 'rgb/frame_000000.jpg with depth/frame_000000.png'
    pairs = pair_up(color, depth, folder, expected, rate_hz=RATE_HZ, calibrations=own)
    camera = camera_of(folder, lambda: cameras[next(iter(color))], DEPTH_SCALE)
    depth_format = DepthFormat(camera.depth_scale, size=files.first_size(pair.depth for pair in pairs))
    return ImagePairs(
        f'{folder.resolve().parent.name}_iphone', pairs, camera.calibration, depth_format,
        width=width, ground_truth=lambda: trajectory(pairs, _poses(frames, path)),
    )  # fmt: skip


def _poses(frames: Mapping[int, Mapping[str, Any]], path: Path) -> list[files.Pose | None]:
    """Returns each frame's pose; None if it has none."""

    def read(number: int, frame: Mapping[str, Any]) -> files.Pose | None:
        with files.parsing(path):
            values = np.array(frame['aligned_pose'], np.float64) if 'aligned_pose' in frame else None
        return None if values is None else files.pose(values, f'{path}, frame {number}')

    return files.tolerated([partial(read, *frame) for frame in frames.items()], path)


def _recognises(source: str) -> bool:
    return (Path(source) / 'pose_intrinsic_imu.json').is_file()


def _open(source: str, options: base.ReadOptions) -> ImagePairs:
    return read(Path(source), width=options.width)


FORMAT = base.Format('scannetpp_iphone', 'a folder with pose_intrinsic_imu.json, rgb/ and depth/', _recognises, _open)
