"""The files of a run folder: their names, and when a folder may be written to or removed.

``splatam run`` and the node write a run folder; ``splatam evaluate`` and the other commands read it::

    trajectory.txt   one line per frame, written at once: 'stamp tx ty tz qx qy qz qw', or '# lost stamp'
    frames.csv       one line per frame: status, fractions, times
    map.ply          the Gaussians
    metrics.json     the numbers; null until evaluated
    config.yaml      every setting
    run.json         source, camera, commit, machine, library versions
    scores.csv       written by the evaluation: one line per scored view
    report.png       drawn by the evaluation: one picture
    report.html      written by the evaluation: one self-contained page
    checkpoints/     what a run needs to be resumed, see checkpoints.py
    previous/        the run before the map was last reset, itself a run folder
"""

from __future__ import annotations

import shutil
from pathlib import Path

from splatam_core.atomic_io import is_unfinished
from splatam_core.errors import RunFolderError

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
RESULTS = (MAP, METRICS, SCORES, REPORT, PAGE)
"""The files that depend on every frame of the run."""
CHECKPOINTS = 'checkpoints'
PREVIOUS = 'previous'


def check_is_free(path: Path) -> None:
    """Checks that nothing is at a path, or only an empty folder.

    Raises:
        RunFolderError: something is there.
    """
    if path.exists() and not (path.is_dir() and not any(path.iterdir())):
        hint = ', or replace the run in it with --overwrite (the node: overwrite:=true)' if (path / RUN).is_file() else ''
        raise RunFolderError(f'{path} exists: choose another folder{hint}')


def remove_run(path: Path) -> None:
    """Removes a run folder.

    Raises:
        RunFolderError: the folder holds no run, or also files that no run writes; nothing is removed then.
        OSError: it cannot be removed.
    """
    if not (path / RUN).is_file():
        raise RunFolderError(f'{path} holds no run ({RUN} is missing), so it is not overwritten: choose another folder')
    others = sorted(entry.name for entry in path.iterdir() if not _belongs_to_a_run(entry.name))
    if others:
        raise RunFolderError(
            f'{path} holds more than a run ({", ".join(others[:5])}), so it is not overwritten: '
            'move these files away or choose another folder'
        )
    shutil.rmtree(path)


def _belongs_to_a_run(name: str) -> bool:
    return name in (*FILES, CHECKPOINTS, PREVIOUS) or is_unfinished(name, FILES)
