"""NeRFCapture recordings (iPhone and iPad), as SplaTAM's capture script saves them.

::

    my_capture/
        transforms.json         # fl_x fl_y cx cy w h integer_depth_scale, and frames: file_path depth_path
                                #   transform_matrix, each with its own fl_x ...
        rgb/0.png
        depth/0.png             # 16 bit, integer_depth_scale metres a count (10/65535), 0 = no reading
        camera.yaml             # optional; overrides the cameras in transforms.json

The app's own offline recordings have ``images/0.png`` with ``images/0.depth.png``. The paths in ``transforms.json`` are
followed, whatever they are; a missing suffix is ``.png``, ``.jpg`` or ``.jpeg``.

Layout: ``scripts/nerfcapture2dataset.py`` (github.com/spla-tam/SplaTAM) and instant-ngp's ``nerfcapture2nerf.py``.
Poses are ARKit's, with OpenGL's camera axes. The intrinsics differ between frames because the lens focuses; all frames
are rectified to the first frame's camera. Frames without depth are skipped. There are no stamps: frames come at 30 Hz,
the first at 1 s.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatam_core.datasets import base, files, nerfstudio
from splatam_core.datasets.camera_file import camera_of, checked_depth_scale
from splatam_core.datasets.pairs import DepthFormat, ImagePairs, pair_up, trajectory
from splatam_core.errors import DatasetError
from splatam_core.geometry.camera import CameraCalibration

METRES_PER_COUNT = 10 / 65535

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Capture:
    """What ``transforms.json`` states about the frames that have depth, by their index."""

    calibration: CameraCalibration
    color: dict[int, Path]
    depth: dict[int, Path]
    calibrations: dict[int, CameraCalibration]
    frames: list[dict[str, Any]]
    depth_scale: float


def read(folder: Path, *, width: int | None = None) -> ImagePairs:
    """Read the list of frames.

    Raises:
        DatasetError: ``transforms.json`` cannot be used, or states no frame with depth.
        CameraError: a camera cannot be used.
    """
    capture = _read_transforms(folder)
    has_file = (folder / 'camera.yaml').exists()
    pairs = pair_up(
        capture.color, capture.depth, folder, 'rgb/0.png with depth/0.png in transforms.json',
        calibrations=None if has_file else capture.calibrations,
    )  # fmt: skip
    camera = camera_of(folder, lambda: capture.calibration, capture.depth_scale)
    return ImagePairs(
        folder.resolve().name, pairs, camera.calibration, DepthFormat(camera.depth_scale),
        width=width, ground_truth=lambda: trajectory(pairs, nerfstudio.poses(capture.frames, folder / 'transforms.json')),
    )  # fmt: skip


def _read_transforms(folder: Path) -> _Capture:
    path = folder / 'transforms.json'
    values = files.read_json(path)
    with files.parsing(path):
        frames = [frame for frame in values['frames'] if frame.get('depth_path')]
        if len(frames) < len(values['frames']):
            _log.warning('%s: %d frames have no depth_path', path, len(values['frames']) - len(frames))
        if not frames:
            raise DatasetError(f'{path}: none of {len(values["frames"])} frames has a depth_path')
        cameras = [nerfstudio.calibration({**values, **frame}) for frame in frames]
        return _Capture(
            calibration=cameras[0],
            color={index: files.listed(folder, str(frame['file_path'])) for index, frame in enumerate(frames)},
            depth={index: files.listed(folder, str(frame['depth_path'])) for index, frame in enumerate(frames)},
            calibrations=dict(enumerate(cameras)),
            frames=frames,
            depth_scale=checked_depth_scale(1 / float(values.get('integer_depth_scale', METRES_PER_COUNT))),
        )


def _recognises(source: str) -> bool:
    return (Path(source) / 'transforms.json').is_file()


def _open(source: str, options: base.ReadOptions) -> ImagePairs:
    return read(Path(source), width=options.width)


FORMAT = base.Format(
    'nerfcapture', 'a folder with transforms.json, whose frames have a file_path and a depth_path', _recognises, _open
)
