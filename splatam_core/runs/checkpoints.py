"""Checkpoints: everything that later frames depend on, so that a resumed run ends like an uninterrupted one.

::

    checkpoints/
        000040.checkpoint     after 40 frames: map, optimizer, motion, random numbers, and names of keyframes
        000060.checkpoint     after 60
        keyframes/
            3f0c….keyframe    images and pose, named by their SHA-256: written once, shared by all checkpoints

The keyframes are written first, and each file in one step: whatever interrupts that, the previous checkpoint stays whole.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splatam_core.atomic_io import is_unfinished
from splatam_core.config import SlamConfig, flat_values, with_values
from splatam_core.errors import CheckpointError, one_line
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.graph.relocalisation import Recognition, RelocaliserState
from splatam_core.images.view import View
from splatam_core.mapping.posed import PosedView
from splatam_core.retired_settings import migrated
from splatam_core.runs.archive import Content, pack, read_archive
from splatam_core.runs.layout import KEYFRAMES
from splatam_core.state import SlamState
from splatam_core.tracking.motion import MotionState
from splatam_core.tracking.readout import Readout
from splatam_core.tracking.time_offset import TimeOffset
from splatam_core.tracking.verdict import JudgeState
from splatam_core.types import Arrays

VERSION = 1
KIND, KEYFRAME = 'checkpoint', 'keyframe'
_MAP, _PLACES, _GRAPH, _LAST = 'map.', 'places.', 'graph.', 'last.'
_KEYFRAME_POSES = 'keyframe_poses'
_JUDGE = tuple(entry.name for entry in fields(JudgeState) if entry.name != 'covariance')
_RELOCALISER = {'told': (4, 4), 'recognised_T_world_cam': (4, 4), 'recognised_covariance': (6, 6)}
_MOTION_SHAPES = {'T_world_cam': (4, 4), 'velocity': (6,), 'T_world_cam_trusted': (4, 4), 'pose_covariance': (6, 6)}


@dataclass(frozen=True, slots=True)
class Progress:
    """How much of a recording is processed.

    Attributes:
        length: number of frames of the recording.
        last_index: index of the last processed frame.
        last_digest: of that frame, see ``resume.frame_digest``.
        num_lines: number of frames in the run folder.
    """

    length: int
    last_index: int
    last_digest: str
    num_lines: int


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """A checkpoint, read.

    Attributes:
        path: the file.
        state: of ``Slam``.
        progress: in the recording.
    """

    path: Path
    state: SlamState
    progress: Progress


class Checkpoints:
    """Writes the checkpoints of one run. It is not thread-safe."""

    def __init__(self, folder: Path, keep: int) -> None:
        """Writes nothing yet.

        Args:
            folder: the run's ``checkpoints/``.
            keep: number of checkpoints to keep; older ones are removed.
        """
        self._folder = folder
        self._keep = keep
        self._written: dict[View, str] = {}
        self._needed: dict[Path, frozenset[str]] = {}

    def save(self, state: SlamState, progress: Progress) -> Path:
        """Writes a checkpoint, then removes those that are too old. Returns the path of the new file.

        Raises:
            OSError: it cannot be written; the existing checkpoints stay.
        """
        (self._folder / KEYFRAMES).mkdir(parents=True, exist_ok=True)
        self._written = {keyframe.view: self._write_keyframe(keyframe) for keyframe in state.keyframes}
        digests = tuple(self._written.values())
        path = self._folder / f'{progress.num_lines:06d}.{KIND}'
        pack(KIND, VERSION, _to_content(state, progress, digests)).write(path)
        self._needed[path] = frozenset(digests)
        self._remove_old()
        return path

    def _write_keyframe(self, keyframe: PosedView) -> str:
        if keyframe.view in self._written:  # its pose may have moved: the checkpoint has that
            return self._written[keyframe.view]
        arrays = {**_images(keyframe.view), 'T_cam_world': keyframe.T_cam_world.numpy(force=True)}
        file = pack(KEYFRAME, VERSION, Content({'frame': keyframe.frame, 'spacing': keyframe.view.spacing}, arrays))
        file.write(_keyframe_path(self._folder, file.digest))
        return file.digest

    def _remove_old(self) -> None:
        paths = checkpoint_paths(self._folder)
        for path in paths[: -self._keep]:
            path.unlink(missing_ok=True)
        self._needed = {path: digests for path, digests in self._needed.items() if path in paths[-self._keep :]}
        needed = {digest for path in paths[-self._keep :] for digest in self._digests_in(path)}
        for path in (self._folder / KEYFRAMES).glob(f'*.{KEYFRAME}'):
            if path.stem not in needed:
                path.unlink(missing_ok=True)
        for path in list(_unfinished(self._folder)):
            path.unlink(missing_ok=True)

    def _digests_in(self, path: Path) -> frozenset[str]:
        """Returns the keyframes of a checkpoint. A newer checkpoint may lack some of them (``keyframes.budget``)."""
        if path not in self._needed:  # written before the run was resumed
            try:
                self._needed[path] = frozenset(read_archive(path, KIND, VERSION).values['keyframes'])
            except (CheckpointError, KeyError, TypeError):
                self._needed[path] = frozenset()  # the checkpoint is unusable with or without them
        return self._needed[path]


def checkpoint_paths(folder: Path) -> list[Path]:
    """Returns the checkpoints in a run's ``checkpoints/``, the newest last."""
    paths = (path for path in folder.glob(f'*.{KIND}') if path.stem.isdecimal())
    return sorted(paths, key=lambda path: int(path.stem))


def read_newest(folder: Path) -> Checkpoint:
    """Reads the newest checkpoint in a run's ``checkpoints/``.

    Raises:
        CheckpointError: there is none, or it cannot be used.
    """
    paths = checkpoint_paths(folder)
    if not paths:
        raise CheckpointError(f"{folder} holds no checkpoint: run with '--checkpoint-every N' to write some")
    try:
        return read_checkpoint(paths[-1])
    except CheckpointError as error:
        way_out = f'to resume from {paths[-2].name}' if len(paths) > 1 else 'and start a new run: it is the only one'
        raise CheckpointError(f'{error}; move {paths[-1].name} away {way_out}') from None


def read_checkpoint(path: Path) -> Checkpoint:
    """Reads a checkpoint and its keyframes. Settings of earlier versions get their present names.

    Raises:
        CheckpointError: one of the files is missing, damaged, of another version or no checkpoint.
    """
    content = read_archive(path, KIND, VERSION)
    try:
        return _from_content(path, content)
    except CheckpointError:
        raise
    except Exception as error:  # noqa: BLE001 - whatever a file holds, it is refused in one line
        raise CheckpointError(
            f'{path}: is no checkpoint that this version understands: {one_line(repr(error))}; use the version that wrote it'
        ) from None


def _to_content(state: SlamState, progress: Progress, digests: Sequence[str]) -> Content:
    motion = state.motion
    values = {
        'config': flat_values(state.config), 'camera': None if state.camera is None else asdict(state.camera),
        'keyframes': list(digests), 'rng': state.rng, 'scene_radius': state.scene_radius, 'num_frames': state.num_frames,
        'last_stamp_ns': state.last_stamp_ns, 'progress': asdict(progress),
        'motion_ns': [motion.stamp_ns, motion.interval_ns], 'time_offset': asdict(motion.time_offset),
        'readout': asdict(motion.readout),
        'trusted_ns': motion.trusted_ns, 'judge': {name: getattr(state.judge, name) for name in _JUDGE},
    }  # fmt: skip
    arrays = {_MAP + name: array for name, array in state.map.items()}
    arrays |= {_PLACES + name: array for name, array in state.places.items()}
    arrays |= {'T_world_cam': motion.T_world_cam, 'velocity': motion.velocity}
    arrays |= {'T_world_cam_trusted': motion.T_world_cam_trusted, 'pose_covariance': state.judge.covariance}
    relocaliser = _relocaliser_content(state.relocaliser)
    arrays |= {_GRAPH + name: array for name, array in state.graph.items()}
    poses = [keyframe.T_cam_world.numpy(force=True) for keyframe in state.keyframes]
    arrays[_KEYFRAME_POSES] = np.array(poses, np.float32).reshape(-1, 4, 4)
    if state.last_view is not None:
        values['last_spacing'] = state.last_view.spacing
        arrays |= {_LAST + name: image for name, image in _images(state.last_view).items()}
    return Content({**values, **relocaliser.values}, {**arrays, **relocaliser.arrays})


def _relocaliser_content(state: RelocaliserState) -> Content:
    recognised = state.recognised
    values = {
        'num_in_doubt': state.num_in_doubt, 'is_anywhere': state.is_anywhere,
        'recognised': None if recognised is None else [recognised.stamp_ns, recognised.keyframe, recognised.num_confirmed],
    }  # fmt: skip
    arrays = {} if state.told is None else {'told': state.told}
    if recognised is not None:
        arrays |= {'recognised_T_world_cam': recognised.T_world_cam, 'recognised_covariance': recognised.covariance}
    return Content({'relocaliser': values}, arrays)


def _relocaliser_state(content: Content) -> RelocaliserState:
    """Returns the state in a checkpoint.

    Raises:
        KeyError: a part is missing.
        ValueError: a part is not what it should be.
    """
    values, arrays = content.values.get('relocaliser'), content.arrays
    if values is None:  # 0.2.0 had none
        return RelocaliserState()
    stamped, recognised = values['recognised'], None
    if stamped is not None:
        T_world_cam, covariance = arrays['recognised_T_world_cam'], arrays['recognised_covariance']
        recognised = Recognition(stamped[0], T_world_cam, covariance, *stamped[1:])  # 0.2.0 did not count what confirms it
    numbers = [values['num_in_doubt'], *(stamped or ())]
    if any(type(number) is not int or abs(number) >= 2**63 for number in numbers) or type(values['is_anywhere']) is not bool:
        raise ValueError(f'relocaliser = {values}: expected whole numbers')
    for name, shape in _RELOCALISER.items():
        array = arrays.get(name)
        if array is not None and (array.dtype != np.float64 or array.shape != shape or not np.isfinite(array).all()):
            raise ValueError(f'{name}: expected {shape} finite numbers')
    return RelocaliserState(values['num_in_doubt'], values['is_anywhere'], arrays.get('told'), recognised)


def _images(view: View) -> dict[str, NDArray[Any]]:
    return {'rgb8': view.rgb8.numpy(force=True), 'depth': view.depth.numpy(force=True)}


def _from_content(path: Path, content: Content) -> Checkpoint:
    values, arrays = content.values, content.arrays
    _check_values(values, arrays)
    camera = None if values['camera'] is None else PinholeCamera(**values['camera'])
    last = None
    if camera is not None and 'last_spacing' in values:  # not before 0.3
        last = _view(path, 'last view', {name: arrays[_LAST + name] for name in ('rgb8', 'depth')}, camera, values['last_spacing'])
    stamp_ns, interval_ns = values['motion_ns']
    state = SlamState(
        config=with_values(SlamConfig(), migrated(values['config'])),
        camera=camera,
        map={name.removeprefix(_MAP): array for name, array in arrays.items() if name.startswith(_MAP)},
        keyframes=_placed([_read_keyframe(path.parent, digest, camera) for digest in values['keyframes']], arrays),
        motion=MotionState(
            stamp_ns=stamp_ns,
            interval_ns=interval_ns,
            T_world_cam=arrays['T_world_cam'],
            velocity=arrays['velocity'],
            time_offset=TimeOffset(**values.get('time_offset', {})),  # 0.1.0 estimated it in every frame anew
            trusted_ns=values.get('trusted_ns'),
            T_world_cam_trusted=arrays.get('T_world_cam_trusted', np.eye(4)),
            readout=Readout(**values.get('readout', {})),  # not before 0.3
        ),
        rng=values['rng'],
        scene_radius=values['scene_radius'],
        num_frames=values['num_frames'],
        last_stamp_ns=values['last_stamp_ns'],
        graph={name.removeprefix(_GRAPH): array for name, array in arrays.items() if name.startswith(_GRAPH)},
        judge=JudgeState() if 'judge' not in values else JudgeState(**values['judge'], covariance=arrays['pose_covariance']),
        relocaliser=_relocaliser_state(content),
        places={name.removeprefix(_PLACES): array for name, array in arrays.items() if name.startswith(_PLACES)},
        last_view=last,
    )
    return Checkpoint(path, state, Progress(**values['progress']))


def _check_values(values: Mapping[str, Any], arrays: Arrays) -> None:
    """Checks the numbers that only later frames would trip over.

    Raises:
        KeyError: one is missing.
        ValueError: one is not a number of its kind.
    """
    progress, (stamp_ns, interval_ns) = values['progress'], values['motion_ns']
    whole = {'num_frames': values['num_frames'], 'motion_ns': stamp_ns, 'interval_ns': interval_ns}
    whole |= {name: progress[name] for name in ('length', 'last_index', 'num_lines')}
    whole |= {name: values[name] for name in ('last_stamp_ns', 'trusted_ns') if values.get(name) is not None}
    if wrong := [name for name, number in whole.items() if type(number) is not int or abs(number) >= 2**63]:
        raise ValueError(f'{wrong[0]} = {whole[wrong[0]]!r}: expected a whole number')
    if not 0 <= progress['last_index'] < progress['length'] or progress['num_lines'] < 0:
        raise ValueError(f'progress {progress}: the last frame is not in the recording')
    radius = values['scene_radius']
    if type(radius) not in (int, float) or not 0 <= radius < math.inf:
        raise ValueError(f'scene_radius = {radius!r}: expected a length')
    for name in ('time_offset', 'judge', 'readout'):  # none of them was in 0.1.0
        if not all(type(number) in (int, float, bool) and math.isfinite(number) for number in values.get(name, {}).values()):
            raise ValueError(f'{name} = {values[name]!r}: expected numbers')
    for name, shape in _MOTION_SHAPES.items():
        array = arrays.get(name)
        is_known_later = name in ('T_world_cam_trusted', 'pose_covariance') and 'judge' not in values
        if array is None and is_known_later:
            continue
        if array is None or array.dtype != np.float64 or array.shape != shape or not np.isfinite(array).all():
            raise ValueError(f'{name}: expected {shape} finite numbers')


def _read_keyframe(folder: Path, digest: str, camera: PinholeCamera | None) -> PosedView:
    path = _keyframe_path(folder, digest)
    if camera is None:
        raise CheckpointError(f'{path}: is no keyframe of this run, which has no camera')
    content = read_archive(path, KEYFRAME, VERSION, digest)
    arrays, frame = content.arrays, content.values.get('frame', -1)  # 0.1.0 did not record it
    view = _view(path, 'keyframe', arrays, camera, content.values.get('spacing', 1.0))  # dense before 0.3
    T_cam_world = arrays['T_cam_world']
    if (T_cam_world.dtype, T_cam_world.shape) != (np.float32, (4, 4)) or not np.isfinite(T_cam_world).all():
        raise CheckpointError(f'{path}: is no keyframe of this run: its pose is not finite, or no pose')
    if type(frame) is not int:
        raise CheckpointError(f'{path}: is no keyframe of this run: its frame is {frame!r}')
    return PosedView(view, torch.from_numpy(T_cam_world), frame)


def _view(path: Path, what: str, arrays: Arrays, camera: PinholeCamera, spacing: object) -> View:
    """Returns the images in an archive, of the camera of the run or kept at another size (``mapping.scale``).

    Raises:
        CheckpointError: they are no such images.
    """
    refused, (rgb8, depth) = f'{path}: is no {what} of this run', (arrays[name] for name in ('rgb8', 'depth'))
    if depth.ndim == 2 and depth.shape != (camera.height, camera.width):
        height, width = depth.shape
        camera = camera.resized(width, height)
    size = (camera.height, camera.width)
    expected = [('uint8', (*size, 3)), ('float32', size)]
    found = [(array.dtype.name, array.shape) for array in (rgb8, depth)]
    if found != expected:
        raise CheckpointError(f'{refused}: it holds {found}, expected {expected}')
    if not np.isfinite(depth).all():
        raise CheckpointError(f'{refused}: its depth is not finite')
    if type(spacing) is not float or not 1 <= spacing <= camera.width:
        raise CheckpointError(f'{refused}: spacing = {spacing!r}, expected 1 to {camera.width} pixels')
    return View(camera, torch.from_numpy(rgb8), torch.from_numpy(depth), spacing)


def _placed(keyframes: Sequence[PosedView], arrays: Arrays) -> tuple[PosedView, ...]:
    """Returns keyframes where they were when the checkpoint was written; before 0.3 they never moved.

    Raises:
        ValueError: their poses are not theirs.
    """
    poses = arrays.get(_KEYFRAME_POSES)
    if poses is None:
        return tuple(keyframes)
    if poses.dtype != np.float32 or poses.shape != (len(keyframes), 4, 4) or not np.isfinite(poses).all():
        raise ValueError(f'{_KEYFRAME_POSES}: expected {len(keyframes)} poses, finite float32')
    return tuple(replace(keyframe, T_cam_world=torch.from_numpy(pose)) for keyframe, pose in zip(keyframes, poses))


def _keyframe_path(folder: Path, digest: str) -> Path:
    return folder / KEYFRAMES / f'{digest}.{KEYFRAME}'


def _unfinished(folder: Path) -> Iterator[Path]:
    """Yields what a process left behind that was killed while it wrote."""
    for path in (*folder.glob(f'.*.{KIND}.*'), *folder.glob(f'{KEYFRAMES}/.*.{KEYFRAME}.*')):
        if is_unfinished(path.name, (path.name.removeprefix('.').rpartition('.')[0],)):
            yield path
