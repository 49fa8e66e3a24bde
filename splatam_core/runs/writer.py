"""Writes run folders: line by line while a run goes on, whole files when it is saved."""

from __future__ import annotations

import csv
import io
import json
import os
import shutil
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from datetime import datetime, timezone
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol

from splatam_core.atomic_io import new_folder, prepared, replace_text, same_file
from splatam_core.config import SlamConfig, to_yaml
from splatam_core.device import choose_backend
from splatam_core.errors import RunFolderError
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.geometry.trajectory import pose_line, stamp_from_text
from splatam_core.graph.keyframe_graph import KeyframeGraph
from splatam_core.graph.places import Places
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.mapping.posed import PosedView
from splatam_core.maps.ply import write_ply
from splatam_core.rasterizer import Gaussians
from splatam_core.runs import provenance
from splatam_core.runs.folder_lock import FolderLock
from splatam_core.runs.frame_records import CSV_HEADER, LOST, FrameRecord, complete_lines, read_poses, trajectory_line
from splatam_core.runs.layout import (
    CONFIG,
    FILES,
    FINAL_TRAJECTORY,
    FRAMES,
    MAP,
    MAP_KEYFRAMES,
    METRICS,
    PREVIOUS,
    RESULTS,
    RUN,
    TRAJECTORY,
    check_is_free,
    remove_previous,
    remove_run,
    why_not,
)
from splatam_core.runs.line_file import LineFile
from splatam_core.runs.map_keyframes import write_map_keyframes
from splatam_core.runs.metrics import FrameStatistics, Metrics
from splatam_core.runs.record import RunDescription, RunRecord, read_errors, read_run
from splatam_core.text_files import read_json
from splatam_core.types import FrameResult, RgbdFrame


class SavableSlam(Protocol):
    """What is saved of a ``Slam``."""

    config: SlamConfig

    @property
    def map(self) -> GaussianMap:
        """The map."""

    @property
    def keyframes(self) -> Sequence[PosedView]:
        """Its keyframes, in the host's memory."""

    @property
    def places(self) -> Places:
        """The keyframes as places."""

    @property
    def graph(self) -> KeyframeGraph:
        """Corrects the poses."""


class RunFolder:
    """Writes a run folder during the run. Each frame's lines are on disk before the next frame begins.

    Use it as a context manager, or call ``close``. It is not thread-safe.
    """

    def __init__(
        self, path: Path, statistics: FrameStatistics | None = None, *, has_camera: bool = False, lock: FolderLock | None = None
    ) -> None:
        """Opens the files of an existing folder to append to them.

        Args:
            path: the folder.
            statistics: of the frames that are in it already; None = it has none.
            has_camera: True if ``run.json`` names their camera.
            lock: of the folder; None locks it.

        Raises:
            RunFolderError: another run is being written there.
        """
        self.path = path
        self._lock: FolderLock | None = lock or FolderLock(path)
        self._statistics = statistics or FrameStatistics()
        self._has_camera = has_camera
        self._camera: PinholeCamera | None = None
        self._trajectory, self._frames = (LineFile(path / name) for name in (TRAJECTORY, FRAMES))

    @classmethod
    def create(cls, path: Path, config: SlamConfig, description: RunDescription, *, overwrite: bool = False) -> RunFolder:
        """Makes the folder and writes ``config.yaml`` and ``run.json``.

        Args:
            path: the folder; may exist if it is empty.
            config: of the run.
            description: where the run comes from.
            overwrite: remove the run in the folder, if there are no other files.

        Raises:
            RunFolderError: something is at the path, or the folder cannot be written.
            ConfigError: the configuration asks for a device that does not exist.
        """
        backend = str(choose_backend(config))
        try:
            if overwrite and path.is_dir() and any(path.iterdir()):
                lock = FolderLock(path)
                remove_run(path)
                check_is_free(path)
            else:
                check_is_free(path, may_overwrite=True)
                path.mkdir(parents=True, exist_ok=True)
                lock = FolderLock(path)
            return cls._begin(path, config, run_information(description) | {'backend': backend}, lock)
        except (OSError, ValueError) as error:  # ValueError: a NUL in the path
            raise RunFolderError(f'{path}: cannot be written: {why_not(error)}; choose another folder') from None

    @classmethod
    def reopen(cls, path: Path, num_frames: int, last_stamp_ns: int | None) -> RunFolder:
        """Continues a folder after its first frames. The lines of later frames, map, metrics and reports are removed.

        Args:
            path: the folder.
            num_frames: number of frames to keep.
            last_stamp_ns: stamp of the last frame to keep.

        Raises:
            RunFolderError: that frame is not in the folder; nothing is changed then.
        """
        with read_errors(path):
            lock = FolderLock(path)
        _trim(path, num_frames, last_stamp_ns)
        run = read_run(path)
        return cls(path, FrameStatistics(run.frames), has_camera=run.camera is not None, lock=lock)

    @classmethod
    def _begin(cls, path: Path, config: SlamConfig, information: dict[str, Any], lock: FolderLock) -> RunFolder:
        replace_text(path / CONFIG, to_yaml(config))
        replace_text(path / RUN, as_json(information))
        folder = cls(path, lock=lock)
        folder._frames.write(csv_row(CSV_HEADER))
        return folder

    @property
    def is_empty(self) -> bool:
        """True while the run has no frame."""
        return self._statistics.frames == 0

    @property
    def has_previous(self) -> bool:
        """True if the folder holds the run before a reset."""
        return (self.path / PREVIOUS).exists()

    @property
    def num_frames(self) -> int:
        """Number of frames in the folder."""
        return self._statistics.frames

    def restarted(self, config: SlamConfig) -> RunFolder:
        """Begins a new run in the same folder, after a reset. Closes this object if that succeeds.

        The run so far moves to ``previous/``, itself a run folder, and replaces what was there.

        Raises:
            RunFolderError: the folder cannot be written; nothing has changed.
        """
        information = _information(self.path) | {'camera': None, 'started': _now()}
        texts = {CONFIG: to_yaml(config), RUN: as_json(information), FRAMES: csv_row(CSV_HEADER) + '\n'}
        try:
            self.sync()
            (self.path / PREVIOUS).mkdir(exist_ok=True)
            with prepared({self.path / name: text for name, text in texts.items()}) as put_in_place:
                self._move_to_previous()
                put_in_place()
            lock, self._lock = self._lock, None
            self.close()
            return RunFolder(self.path, lock=lock)
        except OSError as error:
            raise RunFolderError(f'{self.path}: a new run cannot begin: {why_not(error)}') from None

    def _move_to_previous(self) -> None:
        previous = self.path / PREVIOUS
        remove_previous(self.path)
        previous.mkdir(exist_ok=True)
        same_file(self.path / RUN, previous / RUN)  # not moved: RUN marks a run folder, so it must not be missing meanwhile
        for name in FILES:
            if name != RUN and (self.path / name).exists():
                (self.path / name).replace(previous / name)

    def moved(self, path: Path) -> RunFolder:
        """Continues in another folder, with a copy of this one. Closes this object if that succeeds.

        Raises:
            RunFolderError: something is at the path, or it cannot be written.
        """
        check_is_free(path)
        temporary = path.with_name(f'.{path.name}.{os.getpid()}')
        try:
            self.sync()
            shutil.rmtree(temporary, ignore_errors=True)  # see new_folder
            shutil.copytree(self.path, temporary)
            temporary.replace(path)
        except (OSError, ValueError) as error:
            raise RunFolderError(f'{path}: cannot be written: {why_not(error)}; choose another folder') from None
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
        self.close()
        moved = RunFolder(path, self._statistics, has_camera=self._has_camera)
        moved._camera = self._camera
        return moved

    def append(self, frame: RgbdFrame, result: FrameResult, process_s: float, decode_s: float | None = None) -> None:
        """Appends one frame.

        Args:
            frame: input of ``Slam.process``.
            result: output of ``Slam.process``.
            process_s: wall time in ``Slam.process``.
            decode_s: wall time to read and decode the frame; None where another thread did that during SLAM.

        Raises:
            OSError: the disk is full. What was not written is written with one of the next frames, as long as that is little;
                the folder can be used further.
        """
        record = FrameRecord.of(result, process_s, decode_s)
        if self._trajectory.is_full or self._frames.is_full:
            self._frames.flush()
            self._trajectory.flush()
        self._camera = self._camera or frame.camera
        self._statistics.add(record)
        with ExitStack() as each:  # all are tried, from the last to the first, whichever fails
            each.callback(self._write_camera)
            each.callback(self._frames.write, csv_row(record.csv_row()))
            each.callback(self._trajectory.write, trajectory_line(result))

    def sync(self) -> None:
        """Waits until the frames so far would survive a power cut."""
        for file in (self._trajectory, self._frames):
            file.sync()

    def note_resumption(self, config: SlamConfig) -> None:
        """Adds to ``run.json`` when, with which commit and on which backend the run is resumed."""
        information = _information(self.path)
        resumption = {
            'after_frames': self.num_frames, 'started': _now(), 'commit': provenance.commit(),
            'backend': str(choose_backend(config)),
        }  # fmt: skip
        before = information.get('resumed')
        information['resumed'] = [*(before if isinstance(before, list) else []), resumption]
        replace_text(self.path / RUN, as_json(information))

    def save(self, slam: SavableSlam, finish_s: float = 0.0) -> Metrics:
        """Writes ``map.ply``, its keyframes, the corrected poses, ``metrics.json`` and the present settings.

        It may be called again later.

        Args:
            slam: its map, keyframes and settings are written, and its graph corrects the poses.
            finish_s: wall time in ``Slam.finish``.

        Raises:
            OSError: a file cannot be written; its previous version stays.
        """
        self._write_camera()
        replace_text(self.path / CONFIG, to_yaml(slam.config))
        gaussians = slam.map.gaussians
        write_ply(self.path / MAP, gaussians)
        if slam.config.tracking.relocalises:
            write_map_keyframes(self.path / MAP_KEYFRAMES, slam.keyframes, slam.places.arrays())
        else:
            (self.path / MAP_KEYFRAMES).unlink(missing_ok=True)
        self._write_final_trajectory(slam.graph)
        metrics = metrics_of_this_process(self._statistics, len(gaussians), finish_s)
        if slam.graph.is_used:
            metrics = replace(metrics, loops=slam.graph.num_loops, corrections=slam.graph.num_corrections)
        if slam.map.num_refused:
            refused = f'{slam.map.num_refused} Gaussians were not finite and were left out of the map'
            metrics = replace(metrics, notes={**metrics.notes, 'num_gaussians': refused})
        replace_text(self.path / METRICS, metrics.to_json())
        return metrics

    def _write_final_trajectory(self, graph: KeyframeGraph) -> None:
        """Writes the poses so far as the graph corrects them; lost frames stay comments."""
        self._trajectory.flush()
        with read_errors(self.path):
            lines = complete_lines(self.path / TRAJECTORY)
            online = read_poses(lines, TRAJECTORY)
        final = iter(graph.corrected(online.stamps_ns, online.T_world_cam))
        stamps = iter(online.stamps_ns)
        texts = [line if line.startswith('#') else pose_line(int(next(stamps)), next(final)) for line in lines if line.strip()]
        replace_text(self.path / FINAL_TRAJECTORY, ''.join(f'{text}\n' for text in texts))

    def finish(self, slam: SavableSlam, finish_s: float = 0.0) -> Metrics:
        """Saves, and closes the files. Arguments, result and errors are those of ``save``."""
        metrics = self.save(slam, finish_s)
        self.close()
        return metrics

    def discard(self) -> None:
        """Closes the files, and removes those of a run without frames; the empty folder stays."""
        self.close()
        for name in FILES:
            (self.path / name).unlink(missing_ok=True)

    def close(self) -> None:
        """Closes the files; nothing can be appended after that.

        Raises:
            OSError: the last lines do not fit on the disk; the files are closed nevertheless.
        """
        with ExitStack() as each:
            if self._lock is not None:
                each.callback(self._lock.release)
            each.callback(self._frames.close)
            each.callback(self._trajectory.close)

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self.close()

    def _write_camera(self) -> None:
        """Writes the camera of the first frame, once it fits on the disk."""
        if self._camera is not None and not self._has_camera:
            replace_text(self.path / RUN, as_json(_information(self.path) | {'camera': asdict(self._camera)}))
            self._has_camera = True


def write_refined(run: RunRecord, path: Path, gaussians: Gaussians, iterations: int, densified: bool = False) -> None:
    """Writes a copy of a run folder with another map and without scores.

    Args:
        run: the run that the map was made from.
        path: the new folder.
        gaussians: the new map.
        iterations: number of optimizer steps from the old map to the new one.
        densified: True if these steps could add Gaussians.

    Raises:
        RunFolderError: something is at the path, or it cannot be written.
    """
    information = _information(run.path)
    information |= {
        'program': 'splatam refine', 'refined_from': str(run.path.resolve()), 'refined_iterations': iterations,
        'refined_densified': densified, 'started': _now(), 'commit': provenance.commit(), 'machine': provenance.machine(),
        'versions': provenance.versions(),
    }  # fmt: skip
    check_is_free(path)
    try:
        with new_folder(path) as folder:
            for name in (TRAJECTORY, FINAL_TRAJECTORY, FRAMES, CONFIG, MAP_KEYFRAMES):
                if (run.path / name).exists():
                    shutil.copy2(run.path / name, folder)
            replace_text(folder / RUN, as_json(information))
            write_ply(folder / MAP, gaussians)
            replace_text(folder / METRICS, metrics_of_this_process(FrameStatistics(run.frames), len(gaussians)).to_json())
    except OSError as error:
        raise RunFolderError(f'{path}: cannot be written: {why_not(error)}; choose another folder') from None


def _information(path: Path) -> dict[str, Any]:
    """Returns what ``run.json`` in a folder holds.

    Raises:
        RunFolderError: it cannot be read.
    """
    information = read_json(path / RUN, RunFolderError)
    if not isinstance(information, dict):
        raise RunFolderError(f'{path / RUN} cannot be read: it holds no object')
    return information


def _trim(path: Path, num_frames: int, last_stamp_ns: int | None) -> None:
    """Removes the lines of later frames and the results that depend on them, see ``RunFolder.reopen``."""
    with read_errors(path):
        trajectory = (path / TRAJECTORY).read_text().splitlines(keepends=True)[:num_frames]
        frames = (path / FRAMES).read_text().splitlines(keepends=True)[: num_frames + 1]
        for name, line in ((TRAJECTORY, trajectory[-1].removeprefix(LOST)), (FRAMES, frames[-1])):
            found = stamp_from_text(line.replace(',', ' ').split()[0])
            if found != last_stamp_ns or not line.endswith('\n'):
                raise RunFolderError(f'{name} has frame {found} ns in line {num_frames}, expected {last_stamp_ns} ns')
        for name in RESULTS:
            (path / name).unlink(missing_ok=True)
        replace_text(path / TRAJECTORY, ''.join(trajectory))
        replace_text(path / FRAMES, _present_header(frames[0]) + ''.join(frames[1:]))


def _present_header(line: str) -> str:
    """Returns the first line of a ``frames.csv`` with the columns that were added since it was written."""
    columns = line.strip().split(',')
    return ','.join([*columns, *CSV_HEADER[len(columns) :]]) + '\n'


def metrics_of_this_process(statistics: FrameStatistics, num_gaussians: int, finish_s: float = 0.0) -> Metrics:
    """Returns what is known without ground truth of a run that this process makes."""
    peak_rss_mb, peak_gpu_mb = provenance.peak_rss_mb(), provenance.peak_gpu_mb()
    return statistics.metrics(num_gaussians, peak_rss_mb, peak_gpu_mb=peak_gpu_mb, finish_s=finish_s)


def run_information(description: RunDescription) -> dict[str, Any]:
    """Returns what ``run.json`` says of a run that begins now; its camera is not known yet."""
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


def as_json(values: dict[str, Any]) -> str:
    """Returns values as the text of a file."""
    return json.dumps(values, indent=2) + '\n'


def csv_row(row: list[str]) -> str:
    """Returns cells as a line of a table, without its newline."""
    text = io.StringIO()
    csv.writer(text, lineterminator='').writerow([cell.replace('\0', '') for cell in row])
    return ' '.join(text.getvalue().splitlines())  # a reason is one line, whatever it quotes
