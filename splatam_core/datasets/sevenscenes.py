"""7-Scenes recordings.

::

    seq-01/
        frame-000000.color.png      # or .color.jpg
        frame-000000.depth.png      # 16 bit, millimetres; 0 and 65535 = no reading
        frame-000000.pose.txt       # 4x4 camera to world; optional
        camera-intrinsics.txt       # 3x3 K; optional: else 585 585 320 240 at 640x480
        camera.yaml                 # optional; overrides both
        ...

There are no stamps: the first frame is at 1 s, and the numbers in the names count at 30 Hz.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from splatam_core.datasets import base, files
from splatam_core.datasets.camera_file import camera_of, say_assumed
from splatam_core.datasets.pairs import DepthFormat, ImagePairs, pair_up, trajectory, with_missing
from splatam_core.geometry.camera import CameraCalibration, PinholeCamera
from splatam_core.geometry.trajectory import Trajectory

DEFAULT_CAMERA = CameraCalibration(PinholeCamera(640, 480, 585.0, 585.0, 320.0, 240.0))
DEFAULT_DEPTH_SCALE = 1000.0
NO_DEPTH = 65535


def read(folder: Path, *, width: int | None = None) -> ImagePairs:
    """List the frames of a folder.

    Raises:
        DatasetError: there are no frames, too many lack their depth, or ``camera-intrinsics.txt`` is no 3x3 matrix.
        CameraError: its ``camera.yaml`` cannot be used.
    """
    depth = files.numbered(folder, r'frame-(\d{6})\.depth\.png')
    color = with_missing(files.numbered(folder, r'frame-(\d{6})\.color\.(?:png|jpg)'), depth)
    pairs = pair_up(color, depth, folder, 'frame-000000.color.png (or .jpg) with frame-000000.depth.png')
    camera = camera_of(folder, lambda: _calibration(folder, (pair.color for pair in pairs)), DEFAULT_DEPTH_SCALE)

    def ground_truth() -> Trajectory | None:
        posed = files.numbered(folder, r'frame-(\d{6})\.pose\.txt')
        return trajectory(pairs, files.read_poses([posed.get(number) for number in color], folder))

    depth_format = DepthFormat(camera.depth_scale, no_reading=NO_DEPTH)
    return ImagePairs(folder.resolve().name, pairs, camera.calibration, depth_format, width=width, ground_truth=ground_truth)


def _calibration(folder: Path, color: Iterable[Path]) -> CameraCalibration:
    path = folder / 'camera-intrinsics.txt'
    if not path.exists():
        say_assumed(folder, 'the default camera of 7-Scenes (f 585, c 320 240, 640x480)')
        return DEFAULT_CAMERA
    return files.calibration_from_matrix(files.read_matrix(path, 3), files.first_size(color))


def _recognises(source: str) -> bool:
    folder = Path(source)
    return folder.is_dir() and any(any(folder.glob(f'frame-*.color.{suffix}')) for suffix in ('png', 'jpg'))


def _open(source: str, options: base.ReadOptions) -> ImagePairs:
    return read(Path(source), width=options.width)


FORMAT = base.Format('sevenscenes', 'a folder with frame-000000.color.png (or .jpg) and frame-000000.depth.png', _recognises, _open)
