"""Run folders: whatever one of their files holds, the run is read or one line says what is wrong; nothing of others is removed."""

from __future__ import annotations

import shutil
from functools import partial
from pathlib import Path

from hypothesis import strategies as st

from kinds.base import Case, Kind, Tally
from kinds.damaged import damage, json_damage
from kinds.finished_run import FinishedRun, finished_run
from splatam_core.errors import MapFileError, RunFolderError
from splatam_core.runs.layout import check_is_free, remove_run
from splatam_core.runs.record import read_run

FILES = ('run.json', 'metrics.json', 'trajectory.txt', 'trajectory_final.txt', 'frames.csv', 'config.yaml', 'map.ply')


def check_file(run: FinishedRun, name: str, tally: Tally, data: bytes) -> None:
    with run.with_file(name, data):
        read = tally.attempt(partial(read_run, run.path))
        if read is not None:
            metrics = tally.attempt(read.metrics, RunFolderError)
            tally.attempt(read.read_map, RunFolderError, MapFileError)
            assert len(read.stamps_ns()) == len(read.trajectory) + len(read.lost_ns)
            if metrics is not None:
                metrics.to_json()
        tally.attempt(partial(check_is_free, run.path), RunFolderError)


def check_overwrite(folder: Path, tally: Tally, data: bytes) -> None:
    """A folder that holds anything else stays as it is."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    (folder / 'run.json').write_bytes(data)
    (folder / 'mine.txt').touch()
    assert tally.attempt(lambda: remove_run(folder) or 'removed', RunFolderError) is None
    assert len(list(folder.iterdir())) == 2


def changes(name: str, data: bytes) -> st.SearchStrategy[bytes]:
    """Damage to a file, also to the tree of a JSON file."""
    return damage(data) | json_damage(data) if name.endswith('.json') else damage(data)


def cases(folder: Path) -> list[Case]:
    run = finished_run(folder / 'run')
    files = [Case(name, changes(name, run.files[name]), partial(check_file, run, name), short=25) for name in FILES]
    overwrite = Case('overwrite', changes('run.json', run.files['run.json']), partial(check_overwrite, folder / 'other'), short=25)
    return [*files, overwrite]


KIND = Kind('run folders', 2_700, cases)
