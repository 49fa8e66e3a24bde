"""Writes run folders: line by line while a run goes on, whole files when it is saved."""

from __future__ import annotations

import csv
import json
import os
import shutil
from collections.abc import Sequence
from dataclasses import asdict
from datetime import datetime, timezone
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, TextIO

from splatam_core.atomic_io import new_folder, replace_text
from splatam_core.config import SlamConfig, to_yaml
from splatam_core.device import choose_backend
from splatam_core.errors import RunFolderError
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.geometry.trajectory import stamp_from_text
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.maps.ply import write_ply
from splatam_core.rasterizer import Gaussians
from splatam_core.runs import provenance
from splatam_core.runs.frame_records import CSV_HEADER, LOST, FrameRecord, trajectory_line
from splatam_core.runs.layout import (
    CONFIG,
    FILES,
    FRAMES,
    MAP,
    METRICS,
    PREVIOUS,
    RESULTS,
    RUN,
    TRAJECTORY,
    check_is_free,
    remove_run,
)
from splatam_core.runs.metrics import Metrics, run_metrics
from splatam_core.runs.record import RunDescription, RunRecord, read_errors, read_run
from splatam_core.types import FrameResult, RgbdFrame


class SavableSlam(Protocol):
    """What is saved of a ``Slam``."""

    config: SlamConfig

    @property
    def map(self) -> GaussianMap:
        """The map."""


class RunFolder:
    """Writes a run folder during the run. Each frame's lines are on disk before the next frame begins.

    Use it as a context manager, or call ``close``. It is not thread-safe.
    """

    def __init__(self, path: Path, records: Sequence[FrameRecord] = ()) -> None:
        """Opens the files of an existing folder to append to them.

        Args:
            path: the folder.
            records: the frames that are in it already.
        """
        self.path = path
        self._records = list(records)
        self._trajectory, self._frames = ((path / name).open('a', newline='\n') for name in (TRAJECTORY, FRAMES))

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
            if path.is_dir() and any(path.iterdir()) and overwrite:
                remove_run(path)
            check_is_free(path)
            path.mkdir(parents=True, exist_ok=True)
            return cls._begin(path, config, _run_information(description) | {'backend': backend})
        except OSError as error:
            raise RunFolderError(f'{path}: cannot be written: {error.strerror}; choose another folder') from None

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
        _trim(path, num_frames, last_stamp_ns)
        return cls(path, read_run(path).frames)

    @classmethod
    def _begin(cls, path: Path, config: SlamConfig, information: dict[str, Any]) -> RunFolder:
        replace_text(path / CONFIG, to_yaml(config))
        replace_text(path / RUN, _to_json(information))
        folder = cls(path)
        _write_csv_row(folder._frames, CSV_HEADER)
        return folder

    @property
    def is_empty(self) -> bool:
        """True while the run has no frame."""
        return not self._records

    @property
    def has_previous(self) -> bool:
        """True if the folder holds the run before a reset."""
        return (self.path / PREVIOUS).exists()

    @property
    def num_frames(self) -> int:
        """Number of frames in the folder."""
        return len(self._records)

    def restarted(self, config: SlamConfig) -> RunFolder:
        """Begins a new run in the same folder, after a reset. Closes this object.

        The run so far moves to ``previous/``, itself a run folder, and replaces what was there.

        Raises:
            RunFolderError: the folder cannot be written; nothing more can be appended then.
        """
        previous = self.path / PREVIOUS
        try:
            self.close()
            shutil.rmtree(previous, ignore_errors=True)
            previous.mkdir()
            shutil.copy2(self.path / RUN, previous)  # a copy: RUN marks a run folder, so it must not be missing meanwhile
            for name in FILES:
                if name != RUN and (self.path / name).exists():
                    (self.path / name).replace(previous / name)
            information = json.loads((previous / RUN).read_text())
            return self._begin(self.path, config, information | {'camera': None, 'started': _now()})
        except OSError as error:
            raise RunFolderError(f'{self.path}: a new run cannot begin: {error.strerror}') from None

    def moved(self, path: Path) -> RunFolder:
        """Continues in another folder, with a copy of this one. Closes this object if that succeeds.

        Raises:
            RunFolderError: something is at the path, or it cannot be written.
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
        """Appends one frame.

        Args:
            frame: input of ``Slam.process``.
            result: output of ``Slam.process``.
            process_s: wall time in ``Slam.process``.
            decode_s: wall time to read and decode the frame; None where another thread did that during SLAM.
        """
        record = FrameRecord.of(result, process_s, decode_s)
        self._records.append(record)
        self._trajectory.write(trajectory_line(result) + '\n')
        _write_csv_row(self._frames, record.csv_row())
        self._trajectory.flush()
        if len(self._records) == 1:
            self._write_camera(frame.camera)

    def sync(self) -> None:
        """Waits until the frames so far would survive a power cut."""
        for file in (self._trajectory, self._frames):
            file.flush()
            os.fsync(file.fileno())

    def note_resumption(self, config: SlamConfig) -> None:
        """Adds to ``run.json`` when, with which commit and on which backend the run is resumed."""
        information = json.loads((self.path / RUN).read_text())
        resumption = {
            'after_frames': self.num_frames, 'started': _now(), 'commit': provenance.commit(),
            'backend': str(choose_backend(config)),
        }  # fmt: skip
        information['resumed'] = [*information.get('resumed', []), resumption]
        replace_text(self.path / RUN, _to_json(information))

    def save(self, slam: SavableSlam, finish_s: float = 0.0) -> Metrics:
        """Writes ``map.ply``, ``metrics.json`` and the present settings. May be called again later.

        Args:
            slam: its map and settings are written.
            finish_s: wall time in ``Slam.finish``.

        Raises:
            OSError: a file cannot be written; its previous version stays.
        """
        replace_text(self.path / CONFIG, to_yaml(slam.config))
        gaussians = slam.map.gaussians
        write_ply(self.path / MAP, gaussians)
        metrics = _metrics_of_this_process(self._records, len(gaussians), finish_s)
        replace_text(self.path / METRICS, metrics.to_json())
        return metrics

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
        """Closes the files; nothing can be appended after that."""
        self._trajectory.close()
        self._frames.close()

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self.close()

    def _write_camera(self, camera: PinholeCamera) -> None:
        information = json.loads((self.path / RUN).read_text())
        replace_text(self.path / RUN, _to_json(information | {'camera': asdict(camera)}))


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
            replace_text(folder / METRICS, _metrics_of_this_process(run.frames, len(gaussians)).to_json())
    except OSError as error:
        raise RunFolderError(f'{path}: cannot be written: {error.strerror}; choose another folder') from None


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
        replace_text(path / FRAMES, ''.join(frames))


def _metrics_of_this_process(records: Sequence[FrameRecord], num_gaussians: int, finish_s: float = 0.0) -> Metrics:
    return run_metrics(
        records,
        num_gaussians=num_gaussians,
        finish_s=finish_s,
        peak_rss_mb=provenance.peak_rss_mb(),
        peak_gpu_mb=provenance.peak_gpu_mb(),
    )


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


def _write_csv_row(file: TextIO, row: list[str]) -> None:
    csv.writer(file, lineterminator='\n').writerow(row)
    file.flush()
