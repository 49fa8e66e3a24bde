"""ScanNet++ scenes, the photographs (DSLR), undistorted.

::

    8b5caf3398/                                     # SOURCE
        dslr/
            train_test_lists.json                   # names: "train" and "test", the order of the frames
            nerfstudio/transforms_undistorted.json  # camera; "frames" (train), "test_frames": file_path
                                                    #   transform_matrix is_bad
            undistorted_images/DSC00001.JPG         # or resized_undistorted_images/
            undistorted_depths/DSC00001.png         # 16 bit, millimetres, rendered from the scan; 0 = no reading
        camera.yaml                                 # optional; overrides

Layout: kaldir.vc.in.tum.de/scannetpp/documentation and the toolkit (github.com/scannetpp/scannetpp): ``dslr.undistort``
makes the images and the camera. Depth is not part of the dataset: ``common.render`` renders it from the scan's
mesh, and the fork of SplaTAM's authors undistorts it (github.com/Nik-V9/scannetpp). Poses have OpenGL's camera axes.
``is_bad`` marks blurred frames, which ``--skip-bad`` skips. Photographs have no rate: frames come at 30 Hz, the
first at 1 s.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from splatam_core.datasets import base, files, nerfstudio
from splatam_core.datasets.camera_file import camera_of
from splatam_core.datasets.pairs import DepthFormat, ImagePairs, pair_up, trajectory
from splatam_core.errors import DatasetError

FRAMES = {'train': 'frames', 'test': 'test_frames'}
DEPTH_SCALE = 1000.0


def read(folder: Path, *, split: str = 'train', skip_bad: bool = False, width: int | None = None) -> ImagePairs:
    """List the frames of a split.

    Raises:
        DatasetError: a list is missing or broken, or a frame lacks its depth.
        CameraError: the camera cannot be used.
    """
    dslr = folder / 'dslr'
    path = dslr / 'nerfstudio' / 'transforms_undistorted.json'
    transforms = files.read_json(path)
    with files.parsing(path):
        stated = {frame['file_path']: frame for frame in transforms[FRAMES[split]]}
        frames = [frame for frame in _in_order(dslr, split, stated) if not (skip_bad and frame['is_bad'])]
        camera = camera_of(folder, lambda: nerfstudio.calibration(transforms), DEPTH_SCALE)
        names = [Path(frame['file_path']) for frame in frames]
        depth_names = [name.with_suffix('.png') for name in names]
    images = next((f for f in ('undistorted_images', 'resized_undistorted_images') if (dslr / f).is_dir()), None)
    color = {index: dslr / images / name for index, name in enumerate(names)} if images else {}
    depth = {index: dslr / 'undistorted_depths' / name for index, name in enumerate(depth_names)}
    depth = {index: file for index, file in depth.items() if os.path.exists(file)}
    pairs = pair_up(color, depth, dslr, 'undistorted_images/DSC00001.JPG with undistorted_depths/DSC00001.png')
    return ImagePairs(
        f'{folder.resolve().name}_{split}', pairs, camera.calibration, DepthFormat(camera.depth_scale),
        width=width, ground_truth=lambda: trajectory(pairs, nerfstudio.poses(frames, path)),
    )  # fmt: skip


def _in_order(dslr: Path, split: str, stated: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    path = dslr / 'train_test_lists.json'
    lists = files.read_json(path)
    with files.parsing(path):
        names = list(lists[split])
    missing = [name for name in names if name not in stated]
    if missing:
        raise DatasetError(
            f'{path}: {len(missing)} of {len(names)} {split} frames are not in transforms_undistorted.json, the first '
            f'is {missing[0]}'
        )
    return [stated[name] for name in names]


def _recognises(source: str) -> bool:
    dslr = Path(source) / 'dslr'
    return (dslr / 'train_test_lists.json').is_file() and (dslr / 'nerfstudio/transforms_undistorted.json').is_file()


def _open(source: str, options: base.ReadOptions) -> ImagePairs:
    return read(Path(source), split=options.split or 'train', skip_bad=options.skip_bad, width=options.width)


FORMAT = base.Format(
    'scannetpp', 'a folder with dslr/train_test_lists.json and dslr/nerfstudio/transforms_undistorted.json',
    _recognises, _open, has_splits=True, flags_bad=True,
)  # fmt: skip
