"""A run's folder: what ``splatam run`` and the node leave behind, and ``splatam evaluate`` reads.

::

    trajectory.txt   one line a frame, written at once: 'stamp tx ty tz qx qy qz qw', or '# lost stamp'
    frames.csv       one line a frame: status, shares, times
    map.ply          the Gaussians
    metrics.json     the numbers; null until evaluated
    config.yaml      every setting
    run.json         source, camera, commit, machine, versions
    scores.csv       written by the evaluation: one line a view
    report.png       drawn by the evaluation: one picture
    report.html      drawn by the evaluation: one page that needs nothing else
    checkpoints/     to go on from, see checkpoints.py
    previous/        the same of before the map was last reset
"""

from __future__ import annotations

import csv
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np
from numpy.typing import NDArray

from splatam_core.atomic_io import is_unfinished, new_folder, replace_text
from splatam_core.config import SlamConfig, load_config, to_yaml
from splatam_core.device import choose_backend
from splatam_core.errors import RunFolderError, SplatamError
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.geometry.trajectory import Trajectory, pose_line, read_trajectory, stamp_from_text, stamp_text
from splatam_core.maps.ply import read_ply, write_ply
from splatam_core.rasterizer import Gaussians
from splatam_core.runs import provenance
from splatam_core.runs.metrics import STAGES, Metrics, stage_statistics
from splatam_core.types import FrameResult, RgbdFrame, StageTimings, Status

if TYPE_CHECKING:
    from splatam_core.slam import Slam

TRAJECTORY = 'trajectory.txt'
FRAMES = 'frames.csv'
MAP = 'map.ply'
METRICS = 'metrics.json'
CONFIG = 'config.yaml'
RUN = 'run.json'
SCORES = 'scores.csv'
REPORT = 'report.png'
PAGE = 'report.html'
FILES = (TRAJECTORY, FRAMES, MAP, METRICS, CONFIG, RUN, SCORES, REPORT, PAGE)
CHECKPOINTS = 'checkpoints'
PREVIOUS = 'previous'
LOST = '# lost '
KEEP_CHECKPOINTS = 2


@dataclass(frozen=True, slots=True)
class Source:
    """A recording and how it was read: the arguments of ``open_sequence``.

    Attributes:
        path: dataset folder, bag, or ``synthetic:...``; absolute where it is a path.
        format: name of the reader; None = guessed.
        start: frames left out at the beginning.
        max_frames: frames read at most; None = all.
        width: of the frames in pixels; None = as recorded.
        rgb: colour topic of a bag; None = found by type.
        depth: depth topic.
        info: camera info topic.
        stride: every how manieth frame was read.
        crop: pixels cut off each edge of the frames.
        split: train or test, of a dataset that comes so.
        skip_bad: whether frames that the dataset flags as bad were left out.
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


@dataclass(frozen=True, slots=True)
class RunDescription:
    """What a run is of.

    Attributes:
        program: who ran it, ``splatam run`` or ``splatam_node``.
        preset: the preset it started from; None = the defaults.
        source: where its frames came from; None = live topics.
        checkpoint_every: frames from one checkpoint to the next; None = none are written.
        keep_checkpoints: how many are kept.
    """

    program: str
    preset: str | None = None
    source: Source | None = None
    checkpoint_every: int | None = None
    keep_checkpoints: int = KEEP_CHECKPOINTS


@dataclass(frozen=True, slots=True)
class FrameRecord:
    """One frame of a run, as in ``frames.csv``.

    Attributes:
        stamp_ns: the frame's stamp.
        status: what became of it.
        is_keyframe: whether it was kept for mapping.
        num_gaussians: size of the map after it.
        visible_fraction: see ``FrameResult``.
        inlier_fraction: see ``FrameResult``.
        process_ms: wall time in SLAM.
        decode_ms: wall time reading and decoding it; None where that went on beside SLAM.
        timings: wall time of each stage.
        reason: why it is lost; empty otherwise.
    """

    stamp_ns: int
    status: Status
    is_keyframe: bool
    num_gaussians: int
    visible_fraction: float
    inlier_fraction: float
    process_ms: float
    decode_ms: float | None
    timings: StageTimings
    reason: str


class RunFolder:
    """Writes a run's folder while it runs. Every frame's line is on disk before the next frame begins.

    Use as a context manager, or call ``close``. Not for several threads at once.
    """

    def __init__(self, path: Path, records: Sequence[FrameRecord] = ()) -> None:
        self.path = path
        self._records = list(records)
        self._trajectory, self._frames = ((path / name).open('a', newline='\n') for name in (TRAJECTORY, FRAMES))

    @classmethod
    def create(cls, path: Path, config: SlamConfig, description: RunDescription, *, overwrite: bool = False) -> RunFolder:
        """Make the folder, with ``config.yaml`` and ``run.json`` in it.

        Args:
            path: the folder; may exist when it is empty.
            config: the run's configuration.
            description: what it is of.
            overwrite: remove the run that is there, if a run and nothing else is there.

        Raises:
            RunFolderError: something is there already, or it cannot be written.
            ConfigError: the configuration asks for a device that is not there.
        """
        backend = str(choose_backend(config))
        try:
            if path.is_dir() and any(path.iterdir()) and overwrite:
                _remove_run(path)
            check_is_free(path)
            path.mkdir(parents=True, exist_ok=True)
            return cls._begin(path, config, _run_information(description) | {'backend': backend})
        except OSError as error:
            raise RunFolderError(f'{path}: cannot be written: {error.strerror}; choose another folder') from None

    @classmethod
    def _begin(cls, path: Path, config: SlamConfig, information: dict[str, Any]) -> RunFolder:
        replace_text(path / CONFIG, to_yaml(config))
        replace_text(path / RUN, _to_json(information))
        folder = cls(path)
        _write_csv_row(folder._frames, _CSV_HEADER)
        return folder

    @property
    def is_empty(self) -> bool:
        """Whether no frame was written down yet."""
        return not self._records

    @property
    def has_previous(self) -> bool:
        """Whether it holds a run of before a reset."""
        return (self.path / PREVIOUS).exists()

    @property
    def num_frames(self) -> int:
        """How many were written down."""
        return len(self._records)

    def restarted(self, config: SlamConfig) -> RunFolder:
        """Begin anew in the same folder: another world, or another time. This object is closed.

        What was written so far is kept in ``previous/``, itself a run's folder, in place of what was kept there before.

        Raises:
            RunFolderError: it cannot be written; then nothing more can be.
        """
        previous = self.path / PREVIOUS
        try:
            self.close()
            shutil.rmtree(previous, ignore_errors=True)
            previous.mkdir()
            shutil.copy2(self.path / RUN, previous)  # which tells that this is a run's folder, so it stays, too
            for name in FILES:
                if name != RUN and (self.path / name).exists():
                    (self.path / name).replace(previous / name)
            information = json.loads((previous / RUN).read_text())
            return self._begin(self.path, config, information | {'camera': None, 'started': _now()})
        except OSError as error:
            raise RunFolderError(f'{self.path}: no new run can begin: {error.strerror}') from None

    def moved(self, path: Path) -> RunFolder:
        """Go on in another folder, with a copy of what is written so far. This object is closed, if that works.

        Raises:
            RunFolderError: something is there already, or it cannot be written.
        """
        check_is_free(path)
        temporary = path.with_name(f'.{path.name}.{os.getpid()}')
        try:
            shutil.copytree(self.path, temporary)
            temporary.replace(path)
        except OSError as error:  # copytree's own error has no strerror
            why = error.strerror or error
            raise RunFolderError(f'{path}: cannot be written: {why}; choose another folder') from None
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
        self.close()
        return RunFolder(path, self._records)

    def append(self, frame: RgbdFrame, result: FrameResult, process_s: float, decode_s: float | None = None) -> None:
        """Write down one frame.

        Args:
            frame: what went in.
            result: what came of it.
            process_s: wall time in ``Slam.process``.
            decode_s: wall time reading and decoding; None where that went on beside SLAM.
        """
        record = _record(result, process_s, decode_s)
        self._records.append(record)
        self._trajectory.write(_trajectory_line(result) + '\n')
        _write_csv_row(self._frames, _csv_row(record))
        self._trajectory.flush()
        if len(self._records) == 1:
            self._write_camera(frame.camera)

    def sync(self) -> None:
        """Wait until what was written down would outlast a power cut."""
        for file in (self._trajectory, self._frames):
            file.flush()
            os.fsync(file.fileno())

    def note_resumption(self, config: SlamConfig) -> None:
        """Write into ``run.json`` that the run goes on after it was broken off, with which code, and where it is computed."""
        information = json.loads((self.path / RUN).read_text())
        resumption = {
            'after_frames': self.num_frames, 'started': _now(), 'commit': provenance.commit(),
            'backend': str(choose_backend(config)),
        }  # fmt: skip
        information['resumed'] = [*information.get('resumed', []), resumption]
        replace_text(self.path / RUN, _to_json(information))

    def save(self, slam: Slam, finish_s: float = 0.0) -> Metrics:
        """Write ``map.ply``, ``metrics.json`` and the settings as of now; may be called again later.

        Args:
            slam: whose map.
            finish_s: wall time in ``Slam.finish``.
        """
        replace_text(self.path / CONFIG, to_yaml(slam.config))
        gaussians = slam.map.gaussians
        write_ply(self.path / MAP, gaussians)
        metrics = run_metrics(self._records, len(gaussians), provenance.peak_rss_mb(), finish_s)
        replace_text(self.path / METRICS, metrics.to_json())
        return metrics

    def finish(self, slam: Slam, finish_s: float = 0.0) -> Metrics:
        """Save, and close the files."""
        metrics = self.save(slam, finish_s)
        self.close()
        return metrics

    def discard(self) -> None:
        """Close, and remove what was written of a run that had no frame; the folder stays, empty."""
        self.close()
        for name in FILES:
            (self.path / name).unlink(missing_ok=True)

    def close(self) -> None:
        """Close the files; once closed nothing can be appended."""
        self._trajectory.close()
        self._frames.close()

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self.close()

    def _write_camera(self, camera: PinholeCamera) -> None:
        information = json.loads((self.path / RUN).read_text())
        replace_text(self.path / RUN, _to_json(information | {'camera': asdict(camera)}))


def run_metrics(
    records: Sequence[FrameRecord], num_gaussians: int | None, peak_rss_mb: float | None, finish_s: float = 0.0
) -> Metrics:
    """What a run's frames say about it without any truth."""
    lost = sum(record.status is Status.LOST for record in records)
    process_ms = sum(record.process_ms for record in records) + 1e3 * finish_s
    decode_ms = [record.decode_ms for record in records if record.decode_ms is not None]
    with_io_ms = process_ms + sum(decode_ms) if len(decode_ms) == len(records) else 0.0
    return Metrics(
        frames=len(records),
        tracked=len(records) - lost,
        lost=lost,
        fps=_rate(len(records), process_ms),
        fps_with_io=_rate(len(records), with_io_ms),
        num_gaussians=num_gaussians,
        peak_rss_mb=peak_rss_mb,
        timings_ms=stage_statistics([record.timings for record in records]),
        finish_s=round(finish_s, 3),
        peak_gpu_mb=provenance.peak_gpu_mb(),
    )


@dataclass(frozen=True, slots=True)
class RunRecord:
    """A run read back from its folder.

    Attributes:
        path: the folder.
        config: every setting.
        description: what it is of.
        camera: of its frames; None when there was no frame.
        commit: of the code; None where unknown.
        machine: what it ran on, by name.
        versions: of the libraries, by name; None = not installed.
        trajectory: the tracked frames.
        lost_ns: stamps of the lost ones.
        frames: one record a frame; empty where there is no ``frames.csv``.
    """

    path: Path
    config: SlamConfig
    description: RunDescription
    camera: PinholeCamera | None
    commit: str | None
    machine: Mapping[str, str | int | None]
    versions: Mapping[str, str | None]
    trajectory: Trajectory
    lost_ns: tuple[int, ...]
    frames: tuple[FrameRecord, ...]

    def stamps_ns(self) -> list[int]:
        """Stamps of all frames in order, the lost ones among them: the n-th is frame n of the run."""
        return sorted([*map(int, self.trajectory.stamps_ns), *self.lost_ns])

    def poses(self) -> dict[int, NDArray[np.float64]]:
        """T_world_cam of the tracked frames, by stamp."""
        return dict(zip(map(int, self.trajectory.stamps_ns), self.trajectory.T_world_cam))

    def mapped_poses(self) -> dict[int, NDArray[np.float64]]:
        """Those of the frames that were not held out of the map."""
        is_held_out = self.config.mapping.is_held_out
        held_out = {stamp_ns for index, stamp_ns in enumerate(self.stamps_ns()) if is_held_out(index)}
        return {stamp_ns: pose for stamp_ns, pose in self.poses().items() if stamp_ns not in held_out}

    def read_map(self) -> Gaussians:
        """The map.

        Raises:
            RunFolderError: there is none.
            MapFileError: it cannot be read.
        """
        if not (self.path / MAP).is_file():
            raise RunFolderError(f'{self.path} has no {MAP}: the run ended before it could be saved')
        return read_ply(self.path / MAP)

    def camera_or_error(self) -> PinholeCamera:
        """The camera of the frames.

        Raises:
            RunFolderError: there was no frame.
        """
        if self.camera is None:
            raise RunFolderError(f'{self.path} has no camera: not one frame was processed')
        return self.camera

    def metrics(self) -> Metrics:
        """The numbers the run wrote, or, when it was killed before it could, what its frames say.

        Raises:
            RunFolderError: ``metrics.json`` is damaged.
        """
        path = self.path / METRICS
        if not path.exists():
            return run_metrics(self.frames, None, None)
        try:
            return Metrics.from_json(path.read_text())
        except RunFolderError as error:
            raise RunFolderError(f'{self.path}: {error}') from None


def write_refined(run: RunRecord, path: Path, gaussians: Gaussians, iterations: int, densified: bool = False) -> None:
    """Write a run's folder anew with another map; scores of images are gone, the rest is as it was.

    Args:
        run: the run the map was made from.
        path: the new folder.
        gaussians: the new map.
        iterations: how many steps were taken from the old one.
        densified: whether they added Gaussians.

    Raises:
        RunFolderError: something is at the path, or it cannot be written.
    """
    information = json.loads((run.path / RUN).read_text())
    information |= {
        'program': 'splatam refine', 'refined_from': str(run.path.resolve()), 'refined_iterations': iterations,
        'refined_densified': densified, 'started': _now(), 'commit': provenance.commit(), 'machine': provenance.machine(),
        'versions': provenance.versions(),
    }  # fmt: skip
    check_is_free(path)
    try:
        with new_folder(path) as folder:
            for name in (TRAJECTORY, FRAMES, CONFIG):
                if (run.path / name).exists():
                    shutil.copy2(run.path / name, folder)
            replace_text(folder / RUN, _to_json(information))
            write_ply(folder / MAP, gaussians)
            metrics = run_metrics(run.frames, len(gaussians), provenance.peak_rss_mb())
            replace_text(folder / METRICS, metrics.to_json())
    except OSError as error:
        raise RunFolderError(f'{path}: cannot be written: {error.strerror}; choose another folder') from None


@dataclass(frozen=True, slots=True)
class RunSettings:
    """What a run's folder says about the run as a whole.

    Attributes:
        path, config, description, camera, commit, machine, versions: as ``RunRecord`` has them.
    """

    path: Path
    config: SlamConfig
    description: RunDescription
    camera: PinholeCamera | None
    commit: str | None
    machine: Mapping[str, str | int | None]
    versions: Mapping[str, str | None]


def read_settings(path: Path) -> RunSettings:
    """Read what was written when a run began.

    Raises:
        RunFolderError: it is no run folder, or one of its files is damaged.
    """
    with _read_errors(path):
        information = json.loads((path / RUN).read_text())
        source, camera = information['source'], information['camera']
        description = RunDescription(
            information['program'], information['preset'], None if source is None else Source(**source),
            information.get('checkpoint_every'), information.get('keep_checkpoints', KEEP_CHECKPOINTS),
        )  # fmt: skip
        return RunSettings(
            path=path,
            config=load_config(str(path / CONFIG)),
            description=description,
            camera=None if camera is None else PinholeCamera(**camera),
            commit=information['commit'],
            machine=information['machine'],
            versions=information['versions'],
        )


def read_run(path: Path) -> RunRecord:
    """Read a run's folder.

    Raises:
        RunFolderError: it is no run folder, or one of its files is damaged.
    """
    settings = read_settings(path)
    with _read_errors(path):
        return RunRecord(
            path=path,
            config=settings.config,
            description=settings.description,
            camera=settings.camera,
            commit=settings.commit,
            machine=settings.machine,
            versions=settings.versions,
            trajectory=read_trajectory(path / TRAJECTORY),
            lost_ns=_read_lost(path / TRAJECTORY),
            frames=_read_frames(path / FRAMES),
        )


def trim_run(path: Path, num_frames: int, last_stamp_ns: int | None) -> None:
    """Cut a run's folder back to its first frames: their lines stay; map, metrics and report of more are removed.

    Args:
        path: the folder.
        num_frames: how many frames stay.
        last_stamp_ns: stamp of the last of them.

    Raises:
        RunFolderError: that frame is not there; nothing is changed then.
    """
    with _read_errors(path):
        trajectory = (path / TRAJECTORY).read_text().splitlines(keepends=True)[:num_frames]
        frames = (path / FRAMES).read_text().splitlines(keepends=True)[: num_frames + 1]
        for name, line in ((TRAJECTORY, trajectory[-1].removeprefix(LOST)), (FRAMES, frames[-1])):
            found = stamp_from_text(line.replace(',', ' ').split()[0])
            if found != last_stamp_ns or not line.endswith('\n'):
                raise RunFolderError(f'{name} has frame {found} ns in line {num_frames}, expected {last_stamp_ns} ns')
        for name in (MAP, METRICS, SCORES, REPORT, PAGE):
            (path / name).unlink(missing_ok=True)
        replace_text(path / TRAJECTORY, ''.join(trajectory))
        replace_text(path / FRAMES, ''.join(frames))


@contextmanager
def _read_errors(path: Path) -> Iterator[None]:
    if missing := [name for name in (TRAJECTORY, CONFIG, RUN) if not (path / name).is_file()]:
        raise RunFolderError(f'{path} is no run folder: it has no {", ".join(missing)}')
    try:
        yield
    except SplatamError as error:
        raise RunFolderError(f'{path} cannot be read: {error}') from None
    except (OSError, KeyError, TypeError, ValueError, IndexError) as error:
        raise RunFolderError(f'{path} cannot be read: {error!r}; was it written by another version?') from None


def check_is_free(path: Path) -> None:
    """Raise RunFolderError unless nothing is there, or an empty folder."""
    if path.exists() and not (path.is_dir() and not any(path.iterdir())):
        raise RunFolderError(f'{path} exists: choose another folder{_overwrite_hint(path)}')


def _overwrite_hint(path: Path) -> str:
    return ', or replace the run in it with --overwrite (the node: overwrite:=true)' if (path / RUN).is_file() else ''


def _remove_run(path: Path) -> None:
    """Remove a run's files, and nothing that no run wrote."""
    if not (path / RUN).is_file():
        raise RunFolderError(f'{path} holds no run ({RUN} is missing), so it is not overwritten: choose another folder')
    others = sorted(entry.name for entry in path.iterdir() if not _is_of_a_run(entry.name))
    if others:
        raise RunFolderError(
            f'{path} holds more than a run ({", ".join(others[:5])}), so it is not overwritten: '
            'move that away or choose another folder'
        )
    shutil.rmtree(path)


def _is_of_a_run(name: str) -> bool:
    return name in (*FILES, CHECKPOINTS, PREVIOUS) or is_unfinished(name, FILES)


def _run_information(description: RunDescription) -> dict[str, Any]:
    return {
        **asdict(description),
        'camera': None,
        'started': _now(),
        'commit': provenance.commit(),
        'machine': provenance.machine(),
        'versions': provenance.versions(),
    }


def _now() -> str:
    return datetime.now(timezone.utc).isoformat(timespec='seconds')


def _to_json(values: dict[str, Any]) -> str:
    return json.dumps(values, indent=2) + '\n'


def _trajectory_line(result: FrameResult) -> str:
    if result.T_world_cam is None:
        return LOST + stamp_text(result.stamp_ns)
    return pose_line(result.stamp_ns, result.T_world_cam)


def _record(result: FrameResult, process_s: float, decode_s: float | None) -> FrameRecord:
    return FrameRecord(
        stamp_ns=result.stamp_ns,
        status=result.status,
        is_keyframe=result.is_keyframe,
        num_gaussians=result.num_gaussians,
        visible_fraction=result.visible_fraction,
        inlier_fraction=result.inlier_fraction,
        process_ms=process_s * 1e3,
        decode_ms=None if decode_s is None else decode_s * 1e3,
        timings=result.timings,
        reason=result.reason,
    )


def _rate(frames: int, wall_ms: float) -> float | None:
    return round(frames / wall_ms * 1e3, 3) if wall_ms > 0 else None


_CSV_HEADER = [
    'stamp', 'status', 'is_keyframe', 'num_gaussians', 'visible_fraction', 'inlier_fraction', 'process_ms', 'decode_ms',
    *(f'{stage}_ms' for stage in STAGES), 'reason',
]  # fmt: skip


def _csv_row(record: FrameRecord) -> list[str]:
    times_ms = [getattr(record.timings, stage) for stage in STAGES]
    return [
        stamp_text(record.stamp_ns), record.status.value, str(int(record.is_keyframe)), str(record.num_gaussians),
        f'{record.visible_fraction:.4f}', f'{record.inlier_fraction:.4f}', f'{record.process_ms:.3f}',
        '' if record.decode_ms is None else f'{record.decode_ms:.3f}', *(f'{time_ms:.3f}' for time_ms in times_ms),
        record.reason,
    ]  # fmt: skip


def _write_csv_row(file: TextIO, row: list[str]) -> None:
    csv.writer(file, lineterminator='\n').writerow(row)
    file.flush()


def _read_lost(path: Path) -> tuple[int, ...]:
    lines = path.read_text().splitlines()
    return tuple(stamp_from_text(line.removeprefix(LOST)) for line in lines if line.startswith(LOST))


def _read_frames(path: Path) -> tuple[FrameRecord, ...]:
    if not path.exists():
        return ()
    with path.open(newline='') as file:
        return tuple(_frame_record(row) for row in csv.DictReader(file))


def _frame_record(row: dict[str, str]) -> FrameRecord:
    return FrameRecord(
        stamp_ns=stamp_from_text(row['stamp']),
        status=Status(row['status']),
        is_keyframe=row['is_keyframe'] == '1',
        num_gaussians=int(row['num_gaussians']),
        visible_fraction=float(row.get('visible_fraction') or row['sure_fraction']),  # the column's name in 0.1.0
        inlier_fraction=float(row['inlier_fraction']),
        process_ms=float(row['process_ms']),
        decode_ms=float(row['decode_ms']) if row['decode_ms'] else None,
        timings=StageTimings(*(float(row[f'{stage}_ms']) for stage in STAGES)),
        reason=row['reason'],
    )
