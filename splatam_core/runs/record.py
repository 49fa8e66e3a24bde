"""A run folder read back: its settings, poses, frames and map."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import numpy as np
from numpy.typing import NDArray

from splatam_core.config import SlamConfig, load_config
from splatam_core.errors import RunFolderError, SplatamError, one_line
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.geometry.trajectory import Trajectory
from splatam_core.maps.ply import read_ply
from splatam_core.rasterizer import Gaussians
from splatam_core.runs.frame_records import FrameRecord, complete_lines, is_frame, read_frame_records, read_lost, read_poses
from splatam_core.runs.layout import CONFIG, FINAL_TRAJECTORY, FRAMES, MAP, METRICS, RUN, TRAJECTORY, why_not
from splatam_core.runs.metrics import Metrics, run_metrics
from splatam_core.text_files import read_json, read_text
from splatam_core.types import PoseCovariance, Status

KEEP_CHECKPOINTS = 2
Made = TypeVar('Made')

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Source:
    """A recording and how it was read: the arguments of ``open_sequence``.

    Attributes:
        path: dataset folder, bag, or ``synthetic:...``; absolute where it is a path.
        format: name of the reader; None = guessed.
        start: number of frames skipped at the beginning.
        max_frames: largest number of frames read; None = all.
        width: of the frames in pixels; None = as recorded.
        rgb: colour topic of a bag; None = found by type.
        depth: depth topic.
        info: camera info topic.
        stride: every n-th frame was read.
        crop: pixels cut off each edge of the frames.
        split: train or test, where a dataset has both.
        skip_bad: True if frames that the dataset flags as bad were skipped.
        max_interval_s: largest difference between the stamps of colour and depth; None = left to the reader.
        use_receive_time: True if the times of recording were taken for stamps.
        rgb_encoding: how images of encoding 8UC3 were read; None = as bgr8.
    """

    path: str
    format: str | None = None
    start: int = 0
    max_frames: int | None = None
    width: int | None = None
    rgb: str | None = None
    depth: str | None = None
    info: str | None = None
    stride: int = 1
    crop: int = 0
    split: str | None = None
    skip_bad: bool = False
    max_interval_s: float | None = None
    use_receive_time: bool = False
    rgb_encoding: str | None = None


@dataclass(frozen=True, slots=True)
class RunDescription:
    """Where a run comes from.

    Attributes:
        program: what wrote it: ``splatam run``, ``splatam refine``, ``splatam merge`` or ``splatam_node``.
        preset: the preset it started from; None = the defaults.
        source: the recording; None = live topics.
        checkpoint_every: frames from one checkpoint to the next; None = no checkpoints.
        keep_checkpoints: number of checkpoints to keep.
    """

    program: str
    preset: str | None = None
    source: Source | None = None
    checkpoint_every: int | None = None
    keep_checkpoints: int = KEEP_CHECKPOINTS


@dataclass(frozen=True, slots=True)
class RunSettings:
    """What is written when a run begins.

    Attributes:
        path: the folder.
        config: every setting.
        description: where the run comes from.
        camera: of the frames; None where no frame was processed.
        commit: of the code; None where unknown.
        machine: facts about the computer, by name.
        versions: of the libraries, by name; None = not installed.
    """

    path: Path
    config: SlamConfig
    description: RunDescription
    camera: PinholeCamera | None
    commit: str | None
    machine: Mapping[str, str | int | None]
    versions: Mapping[str, str | None]


@dataclass(frozen=True, slots=True)
class RunRecord(RunSettings):
    """A whole run folder.

    Attributes:
        trajectory: the frames with a pose, tracked and uncertain.
        lost_ns: stamps of the lost frames.
        frames: one record per frame; empty where there is no ``frames.csv``.
        final: the frames with a pose when the map was saved, after all corrections of the graph; None where that is not known.
    """

    trajectory: Trajectory
    lost_ns: tuple[int, ...]
    frames: tuple[FrameRecord, ...]
    final: Trajectory | None = None

    def stamps_ns(self) -> list[int]:
        """Returns the stamps of all frames in order, lost ones included: the n-th is the one of frame n of the run."""
        return sorted([*map(int, self.trajectory.stamps_ns), *self.lost_ns])

    def tracked_trajectory(self) -> Trajectory:
        """Returns the frames whose pose may be trusted; all with a pose where there is no ``frames.csv``."""
        uncertain = [frame.stamp_ns for frame in self.frames if frame.status is Status.UNCERTAIN]
        kept = ~np.isin(self.trajectory.stamps_ns, uncertain)
        return Trajectory(self.trajectory.stamps_ns[kept], self.trajectory.T_world_cam[kept])

    def covariances(self) -> dict[int, PoseCovariance]:
        """Returns the covariances of the poses, by stamp; those of frames without one are missing."""
        return {frame.stamp_ns: frame.covariance for frame in self.frames if frame.covariance is not None}

    def in_final_map(self) -> Trajectory:
        """Returns the frames with a pose, where they are in the final map; those after it was saved as they were published."""
        if self.final is None:
            return self.trajectory
        later = ~np.isin(self.trajectory.stamps_ns, self.final.stamps_ns)
        poses = np.concatenate([self.final.T_world_cam, self.trajectory.T_world_cam[later]])
        stamps_ns = np.concatenate([self.final.stamps_ns, self.trajectory.stamps_ns[later]])
        order = np.argsort(stamps_ns)
        return Trajectory(stamps_ns[order], poses[order])

    def poses(self) -> dict[int, NDArray[np.float64]]:
        """Returns T_world_cam [4, 4] in the final map of the frames with a pose, by stamp."""
        trajectory = self.in_final_map()
        return dict(zip(map(int, trajectory.stamps_ns), trajectory.T_world_cam))

    def mapped_poses(self) -> dict[int, NDArray[np.float64]]:
        """Returns the poses in the final map of the tracked frames that were not held out of it, by stamp."""
        is_held_out = self.config.mapping.is_held_out
        held_out = {stamp_ns for index, stamp_ns in enumerate(self.stamps_ns()) if is_held_out(index)}
        mapped = set(map(int, self.tracked_trajectory().stamps_ns)) - held_out
        return {stamp_ns: pose for stamp_ns, pose in self.poses().items() if stamp_ns in mapped}

    def read_map(self) -> Gaussians:
        """Reads the map.

        Raises:
            RunFolderError: there is none.
            MapFileError: it cannot be read.
        """
        if not (self.path / MAP).is_file():
            raise RunFolderError(f'{self.path} has no {MAP}: the run is still going on, or ended before it was saved')
        return read_ply(self.path / MAP)

    def camera_or_error(self) -> PinholeCamera:
        """Returns the camera of the frames.

        Raises:
            RunFolderError: no frame was processed.
        """
        if self.camera is None:
            raise RunFolderError(f'{self.path} has no camera: no frame was processed')
        return self.camera

    def metrics(self) -> Metrics:
        """Returns the run's metrics; where it was killed before it wrote them, those that follow from its frames.

        Raises:
            RunFolderError: ``metrics.json`` is damaged.
        """
        path = self.path / METRICS
        if not path.exists():
            return run_metrics(self.frames)
        try:
            return Metrics.from_json(read_text(path, RunFolderError))
        except RunFolderError as error:
            raise RunFolderError(f'{self.path}: {one_line(error)}') from None


def read_settings(path: Path) -> RunSettings:
    """Reads what was written when a run began. Settings of earlier versions get their present names.

    Raises:
        RunFolderError: the path is no run folder, or one of its files is damaged.
    """
    with read_errors(path):
        information = read_json(path / RUN, RunFolderError)
        source, camera = information['source'], information['camera']
        description = {name: information[name] for name in ('program', 'preset')}
        description |= {name: information[name] for name in ('checkpoint_every', 'keep_checkpoints') if name in information}
        return RunSettings(
            path=path,
            config=load_config(str(path / CONFIG)),
            description=_typed(RunDescription, description | {'source': None if source is None else _typed(Source, source)}),
            camera=None if camera is None else _typed(PinholeCamera, camera),
            commit=information['commit'],
            machine=_table(information, 'machine'),
            versions=_table(information, 'versions'),
        )


def _typed(kind: type[Made], values: dict[str, Any]) -> Made:
    """Returns a dataclass made of values from a file.

    Raises:
        TypeError: a value is missing, unknown, or not of the type of its field.
    """
    hints = get_type_hints(kind)
    for name, value in values.items():
        allowed = hints.get(name, object)
        if not isinstance(value, allowed | int if allowed is float else allowed):
            raise TypeError(f'{name} = {value!r}')
    return kind(**values)


def _table(information: dict[str, Any], name: str) -> dict[str, Any]:
    if not isinstance(information[name], dict):
        raise TypeError(f'{name} = {information[name]!r}')
    return information[name]


def read_run(path: Path) -> RunRecord:
    """Reads a run folder.

    Raises:
        RunFolderError: the path is no run folder, or one of its files is damaged.
    """
    settings = read_settings(path)
    with read_errors(path):
        lines, records = _in_both(path, complete_lines(path / TRAJECTORY), read_frame_records(path / FRAMES))
        return RunRecord(
            path=path,
            config=settings.config,
            description=settings.description,
            camera=settings.camera,
            commit=settings.commit,
            machine=settings.machine,
            versions=settings.versions,
            trajectory=read_poses(lines, TRAJECTORY),
            final=_read_final(path),
            lost_ns=read_lost(lines),
            frames=records,
        )


def _read_final(path: Path) -> Trajectory | None:
    file = path / FINAL_TRAJECTORY
    return read_poses(complete_lines(file), FINAL_TRAJECTORY) if file.exists() else None


def _in_both(path: Path, lines: list[str], records: tuple[FrameRecord, ...]) -> tuple[list[str], tuple[FrameRecord, ...]]:
    """Leaves out the last frames that only one file has, with a warning: the writer was stopped between two lines.

    Args:
        path: the run folder.
        lines: of ``trajectory.txt``.
        records: of ``frames.csv``; any number of lines is right if there is no such file.

    Raises:
        ValueError: a line is no pose.
    """
    numbers = [number for number, line in enumerate(lines, 1) if is_frame(line)]
    count = min(len(numbers), len(records))
    alone = max(len(numbers), len(records)) - count
    if not alone or not (path / FRAMES).exists():
        return lines, records
    for read in (partial(read_poses, name=TRAJECTORY), read_lost):  # what is left out must be a frame, too
        read(lines)
    _log.warning('%s: the last %d frames are in one of %s and %s only, and left out', path, alone, TRAJECTORY, FRAMES)
    return lines[: numbers[count - 1] if count else 0], records[:count]


@contextmanager
def read_errors(path: Path) -> Iterator[None]:
    """Turns every error that a missing or damaged file of a run folder causes into one line.

    Raises:
        RunFolderError: the path is no run folder, or the block raised such an error.
    """
    try:
        exists = path.exists()
        missing = [name for name in (TRAJECTORY, CONFIG, RUN) if not (path / name).is_file()]
    except (OSError, ValueError) as error:
        raise RunFolderError(f'{path} cannot be read: {why_not(error)}') from None
    if not exists:
        raise RunFolderError(f'{path} is no run folder: it does not exist')
    if missing:
        raise RunFolderError(f'{path} is no run folder: it has no {", ".join(missing)}')
    try:
        yield
    except SplatamError as error:
        raise RunFolderError(f'{path} cannot be read: {error}') from None
    except Exception as error:  # noqa: BLE001 - whatever a file of the folder holds, it is refused in one line
        raise RunFolderError(
            f'{path} cannot be read: {one_line(repr(error))}; if another version wrote it, read it with that version'
        ) from None
