"""The files of a run folder: their names, and when a folder may be written to or removed.

``splatam run`` and the node write a run folder; ``splatam evaluate`` and the other commands read it::

    trajectory.txt   one line per frame, written at once: 'stamp tx ty tz qx qy qz qw', or '# lost stamp'
    trajectory_final.txt   the same poses after all corrections of the keyframe graph
    frames.csv       one line per frame: status, fractions, times
    map.ply          the Gaussians
    map.keyframes    the keyframes of the map, where lost cameras are looked for by them, see map_keyframes.py
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

import contextlib
import re
from pathlib import Path

from splatam_core.errors import RunFolderError, one_line
from splatam_core.text_files import read_json

TRAJECTORY = 'trajectory.txt'
FINAL_TRAJECTORY = 'trajectory_final.txt'
FRAMES = 'frames.csv'
MAP = 'map.ply'
MAP_KEYFRAMES = 'map.keyframes'
METRICS = 'metrics.json'
CONFIG = 'config.yaml'
RUN = 'run.json'
SCORES = 'scores.csv'
REPORT = 'report.png'
PAGE = 'report.html'
VIEWER_PICTURE = 'viewer.png'
FILES = (TRAJECTORY, FINAL_TRAJECTORY, FRAMES, MAP, MAP_KEYFRAMES, METRICS, CONFIG, RUN, SCORES, REPORT, PAGE, VIEWER_PICTURE)
RESULTS = (FINAL_TRAJECTORY, MAP, MAP_KEYFRAMES, METRICS, SCORES, REPORT, PAGE, VIEWER_PICTURE)
"""The files that depend on every frame of the run."""
CHECKPOINTS = 'checkpoints'
PREVIOUS = 'previous'
KEYFRAMES = 'keyframes'


PROGRAMS = ('splatam run', 'splatam refine', 'splatam merge', 'splatam_node')
"""What writes run folders, as ``run.json`` names it."""


def check_is_free(path: Path, *, may_overwrite: bool = False) -> None:
    """Checks that nothing is at a path, or only an empty folder.

    Args:
        path: where a folder is to be made.
        may_overwrite: True where a run can be replaced on request: then the error says how.

    Raises:
        RunFolderError: something is there, or nobody can tell.
    """
    try:
        is_free = not _exists(path) or (path.is_dir() and not any(path.iterdir()))
        holds_run = (path / RUN).is_file()
    except (OSError, ValueError) as error:
        raise RunFolderError(f'{path}: cannot be used: {why_not(error)}; choose another folder') from None
    if not is_free:
        hint = ', or replace the run in it with --overwrite (the node: overwrite:=true)' if holds_run and may_overwrite else ''
        raise RunFolderError(f'{path} exists: choose another folder{hint}')


def _exists(path: Path) -> bool:
    """Returns True for a link to nowhere, too. Raises OSError or ValueError for what can be no path."""
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def remove_run(path: Path) -> None:
    """Removes the run in a folder: file by file, only those that a run writes. The empty folder stays.

    Raises:
        RunFolderError: the folder holds no run of ours, or also files that no run writes; nothing is removed then.
        OSError: it cannot be removed.
    """
    if reason := _why_no_run(path):
        raise RunFolderError(f'{path} holds no run ({reason}), so it is not overwritten: choose another folder')
    ours, others = _sorted_out(path)
    if others:
        named = ', '.join(str(entry.relative_to(path)) for entry in sorted(others)[:5])
        raise RunFolderError(
            f'{path} holds more than a run ({named}), so it is not overwritten: move these files away or choose another folder'
        )
    _remove(ours)


def remove_previous(path: Path) -> None:
    """Removes the files of the run in a run folder's ``previous/``, and nothing else there.

    Raises:
        OSError: they cannot be removed.
    """
    previous = path / PREVIOUS
    if previous.is_dir() and not previous.is_symlink():
        _remove(_sorted_out(path, PREVIOUS)[0])


def _why_no_run(path: Path) -> str:
    """Returns why ``run.json`` in a folder is not one that this package wrote; empty if it is."""
    file = path / RUN
    if file.is_symlink() or not file.is_file():
        return f'{RUN} is missing'
    try:
        information = read_json(file, RunFolderError)
        if information['program'] in PROGRAMS and {'source', 'camera', 'versions'} <= information.keys():
            return ''
    except Exception:  # noqa: BLE001 - whatever it holds, it is not ours
        pass
    return f'{RUN} is of another program'


def _sorted_out(path: Path, folder: str = '.') -> tuple[list[Path], list[Path]]:
    """Returns what a run wrote in its folder, and what it did not, contents of folders first. Links are never followed."""
    ours, others = [], []
    for entry in sorted((path / folder).iterdir(), key=lambda entry: entry.name == RUN):  # run.json last: it marks what is left
        inner = entry.relative_to(path).as_posix()
        if inner in _NAMES and entry.is_dir() and not entry.is_symlink():
            inner_ours, inner_others = _sorted_out(path, inner)
            ours += [*inner_ours, entry]
            others += inner_others
        else:
            is_ours = entry.is_file() and not entry.is_symlink() and _NAMES[folder].fullmatch(entry.name)
            (ours if is_ours else others).append(entry)
    return ours, others


def _names(pattern: str) -> re.Pattern[str]:
    """Returns a pattern of these file names, and of what a killed writer leaves behind (``atomic_io.replaced``)."""
    return re.compile(rf'(?:{pattern})|\.(?:{pattern})\.\d+')


_FILES = _names('|'.join(map(re.escape, FILES)))
_NAMES = {
    '.': _FILES, PREVIOUS: _FILES, CHECKPOINTS: _names(r'\d+\.checkpoint'),
    f'{CHECKPOINTS}/{KEYFRAMES}': _names(r'[0-9a-f]{64}\.keyframe'),
}  # fmt: skip
"""The folders of a run, and the names of the files that a run writes there."""


def _remove(entries: list[Path]) -> None:
    for entry in entries:
        if entry.is_dir():
            with contextlib.suppress(OSError):  # not empty: it holds what is not ours
                entry.rmdir()
        else:
            entry.unlink()


def why_not(error: OSError | ValueError) -> str:
    """Returns why a path cannot be used; some errors of the standard library have no text of the system."""
    return (error.strerror if isinstance(error, OSError) else None) or one_line(error)
