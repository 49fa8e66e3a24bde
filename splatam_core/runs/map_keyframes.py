"""The keyframes of a saved map, beside it in the run folder, so that a camera can be found in it and mapping can go on.

``map.keyframes`` is an archive (see archive.py): colour as JPEG, depth as 16-bit PNG in millimetres, one pair of them for each
keyframe, the poses, and the features by which the places are recognised. It is written with the map where lost cameras are looked
for by keyframes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from splatam_core.datasets.files import decoded
from splatam_core.errors import CheckpointError, one_line
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.graph.places import Places
from splatam_core.images.view import View
from splatam_core.mapping.posed import PosedView
from splatam_core.runs.archive import Content, pack, read_archive
from splatam_core.state import SavedKeyframes
from splatam_core.types import Arrays

KIND, VERSION = 'keyframes', 1
_PLACES = 'places.'
_QUALITY = 95  # of JPEG
_STEPS_PER_M = 1000
_FARTHEST = 65535  # steps
_RIGID = 1e-3  # error of a rotation after hours of float32


def write_map_keyframes(path: Path, keyframes: Sequence[PosedView], places: Arrays) -> None:
    """Writes keyframes in one step.

    Args:
        path: the file.
        keyframes: all of a map.
        places: see ``Places.arrays``.

    Raises:
        OSError: the file cannot be written; what was at the path stays.
    """
    values = {
        'cameras': [asdict(keyframe.view.camera) for keyframe in keyframes],
        'spacings': [keyframe.view.spacing for keyframe in keyframes],
    }
    poses = [keyframe.T_cam_world.numpy(force=True) for keyframe in keyframes]
    numbers = {keyframe.frame: index - len(keyframes) for index, keyframe in enumerate(keyframes)}
    frames = np.array([numbers[frame] for frame in places['frames'].tolist()], np.int64)
    arrays: dict[str, NDArray[Any]] = {'T_cam_world': np.array(poses, np.float32).reshape(-1, 4, 4)}
    arrays |= {_PLACES + name: array for name, array in {**places, 'frames': frames}.items()}
    for index, keyframe in enumerate(keyframes):
        rgb, depth_m = keyframe.view.rgb8.numpy(force=True), keyframe.view.depth.numpy(force=True)
        steps = np.clip(np.rint(_STEPS_PER_M * depth_m), 0, _FARTHEST).astype(np.uint16)
        arrays[f'rgb.{index}'] = _encoded('.jpg', rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        arrays[f'depth.{index}'] = _encoded('.png', steps, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    pack(KIND, VERSION, Content(values, arrays)).write(path)


def read_map_keyframes(path: Path) -> SavedKeyframes:
    """Reads keyframes. Their numbers are negative: they come before all frames of a run that goes on in the map.

    Raises:
        CheckpointError: the file cannot be read, is damaged, or holds no keyframes.
    """
    content = read_archive(path, KIND, VERSION)
    try:
        keyframes = tuple(_keyframe(content, index) for index in range(len(content.values['cameras'])))
        places = {name.removeprefix(_PLACES): array for name, array in content.arrays.items() if name.startswith(_PLACES)}
        Places().restore(places)  # raises what is wrong with them
        return SavedKeyframes(keyframes, places)
    except Exception as error:  # noqa: BLE001 - whatever a file holds, it is refused in one line
        raise CheckpointError(f'{path}: holds no keyframes that this version understands: {one_line(repr(error))}') from None


def _keyframe(content: Content, index: int) -> PosedView:
    values, arrays = content.values, content.arrays
    camera, spacing = PinholeCamera(**values['cameras'][index]), float(values['spacings'][index])
    size = (camera.width, camera.height)
    rgb = np.ascontiguousarray(decoded(arrays[f'rgb.{index}'], size, cv2.IMREAD_COLOR)[..., ::-1])
    steps = decoded(arrays[f'depth.{index}'], size, cv2.IMREAD_UNCHANGED)
    T_cam_world = arrays['T_cam_world'][index]
    if steps.ndim != 2 or steps.dtype != np.uint16:
        raise ValueError(f'depth of {steps.shape} {steps.dtype}: expected whole millimetres')
    if T_cam_world.shape != (4, 4) or T_cam_world.dtype != np.float32 or not np.isfinite(T_cam_world).all():
        raise ValueError('a pose is not finite')
    R = T_cam_world[:3, :3].astype(np.float64)
    if np.abs(R.T @ R - np.eye(3)).max() > _RIGID or (T_cam_world[3] != (0, 0, 0, 1)).any():
        raise ValueError('a pose is no rigid motion')
    if not 1 <= spacing <= camera.width:
        raise ValueError(f'spacing = {spacing}: expected 1 to {camera.width} pixels')
    depth_m = (steps / np.float32(_STEPS_PER_M)).astype(np.float32)
    view = View(camera, torch.from_numpy(rgb), torch.from_numpy(depth_m), spacing)
    return PosedView(view, torch.from_numpy(T_cam_world.copy()), index - len(values['cameras']))


def _encoded(extension: str, image: NDArray[Any], options: list[int]) -> NDArray[np.uint8]:
    is_encoded, data = cv2.imencode(extension, image, options)
    assert is_encoded
    return data.ravel()
