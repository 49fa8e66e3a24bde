"""Writes the run folder of two runs that were joined: the frames of both, in the world of the first."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from splatam_core.atomic_io import new_folder, replace_text
from splatam_core.config import to_yaml
from splatam_core.errors import RunFolderError
from splatam_core.geometry.se3 import Matrix
from splatam_core.geometry.trajectory import pose_line, stamp_text
from splatam_core.maps.ply import write_ply
from splatam_core.runs.frame_records import CSV_HEADER, LOST, FrameRecord
from splatam_core.runs.layout import (
    CONFIG,
    FINAL_TRAJECTORY,
    FRAMES,
    MAP,
    MAP_KEYFRAMES,
    METRICS,
    RUN,
    TRAJECTORY,
    check_is_free,
    why_not,
)
from splatam_core.runs.map_keyframes import write_map_keyframes
from splatam_core.runs.metrics import FrameStatistics
from splatam_core.runs.record import RunDescription, RunRecord
from splatam_core.runs.writer import SavableSlam, as_json, csv_row, metrics_of_this_process, run_information

_PAUSE_NS = 10**9


@dataclass(frozen=True, slots=True, eq=False)
class Joined:
    """Two runs and how they lie to each other.

    Attributes:
        first: the run whose world is kept.
        second: the other one.
        T_first_second: [4, 4] world of the second to world of the first.
    """

    first: RunRecord
    second: RunRecord
    T_first_second: Matrix

    def shift_ns(self) -> int:
        """Returns what is added to the stamps of the second run: 0, unless it would not come before or after the first."""
        first, second = self.first.stamps_ns(), self.second.stamps_ns()
        if not first or not second or second[0] > first[-1] or second[-1] < first[0]:
            return 0
        return first[-1] + _PAUSE_NS - second[0]

    def lines(self) -> list[str]:
        """Returns the lines of the trajectory, where all frames are in the map, in the order of their stamps."""
        lines = {}
        for run, T, shift_ns in self._parts():
            poses = run.poses()
            for stamp_ns in run.stamps_ns():
                at_ns, pose = stamp_ns + shift_ns, poses.get(stamp_ns)
                lines[at_ns] = LOST + stamp_text(at_ns) if pose is None else pose_line(at_ns, T @ pose)
        return [lines[stamp_ns] for stamp_ns in sorted(lines)]

    def records(self) -> tuple[FrameRecord, ...]:
        """Returns the records of all frames in that order; none if one run has none."""
        if not self.first.frames or not self.second.frames:
            return ()
        shifted = [replace(one, stamp_ns=one.stamp_ns + shift_ns) for run, _, shift_ns in self._parts() for one in run.frames]
        return tuple(sorted(shifted, key=lambda record: record.stamp_ns))

    def _parts(self) -> Iterator[tuple[RunRecord, Matrix, int]]:
        yield self.first, np.eye(4), 0
        yield self.second, self.T_first_second, self.shift_ns()


def write_merged(path: Path, joined: Joined, slam: SavableSlam) -> None:
    """Writes the folder of two runs.

    Args:
        path: the new folder.
        joined: the runs.
        slam: has the map of both, and the settings of the first.

    Raises:
        RunFolderError: something is at the path, or it cannot be written.
    """
    first, second = joined.first, joined.second
    information = run_information(RunDescription('splatam merge', first.description.preset))
    information |= {
        'camera': None if first.camera is None else asdict(first.camera),
        'merged_from': [str(run.path.resolve()) for run in (first, second)],
        'T_first_second': joined.T_first_second.tolist(),
        'stamps_of_second_shifted_by_ns': joined.shift_ns(),
    }
    records, lines = joined.records(), ''.join(f'{line}\n' for line in joined.lines())
    check_is_free(path)
    try:
        with new_folder(path) as folder:
            for name in (TRAJECTORY, FINAL_TRAJECTORY):
                replace_text(folder / name, lines)
            if records:
                rows = [CSV_HEADER, *(record.csv_row() for record in records)]
                replace_text(folder / FRAMES, ''.join(f'{csv_row(row)}\n' for row in rows))
            replace_text(folder / CONFIG, to_yaml(slam.config))
            write_ply(folder / MAP, slam.map.gaussians)
            write_map_keyframes(folder / MAP_KEYFRAMES, slam.keyframes, slam.places.arrays())
            replace_text(folder / METRICS, metrics_of_this_process(FrameStatistics(records), len(slam.map)).to_json())
            replace_text(folder / RUN, as_json(information))
    except OSError as error:
        raise RunFolderError(f'{path}: cannot be written: {why_not(error)}; choose another folder') from None
