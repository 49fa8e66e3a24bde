"""Writes any recording as a rosbag2, in one step: the bag is there complete, or not at all."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from splatam_core.datasets.base import Sequence
from splatam_core.errors import DatasetError

STORAGES = ('sqlite3', 'mcap')


def write_bag(
    sequence: Sequence,
    path: Path | str,
    *,
    storage: str = 'sqlite3',
    compressed: bool = False,
    progress: Callable[[range], Iterable[int]] | None = None,
) -> None:
    """Write a recording as a rosbag2 folder that ``open_sequence`` reads back the same, bit for bit.

    Topics: ``/rgb/image`` (rgb8), ``/depth/image`` (16UC1 if the recording stores millimetres, else
    32FC1), ``/rgb/camera_info`` (without distortion), ``/ground_truth/pose`` (if the ground truth is
    known). Messages keep the recording's stamps, which are also their times of recording.

    Args:
        sequence: what to write.
        path: the folder to create; must not exist.
        storage: ``sqlite3`` or ``mcap``.
        compressed: write JPEG to ``/rgb/image/compressed`` and PNG to ``/depth/image/compressedDepth``
            instead. Colours then change slightly, and so does depth unless it is in millimetres.
        progress: wraps the frames' indices as they are written, for a progress bar.

    Raises:
        DatasetError: the path exists or cannot be written, or a frame cannot be read.
        FrameError: a frame's images do not fit its camera.
    """
    if storage not in STORAGES:
        raise DatasetError(f"storage '{storage}' is not one of {', '.join(STORAGES)}")
    path = Path(path)
    if path.exists() or path.is_symlink():
        raise DatasetError(f'{path}: exists already; remove it or choose another name')
    from splatam_core.datasets.bag.writer import write  # loads the bag library only where a bag is written

    indices = range(len(sequence))
    try:
        with _complete_or_absent(path) as folder:
            write(sequence, folder, storage, compressed, progress(indices) if progress else indices)
    except (OSError, sqlite3.Error) as error:
        raise DatasetError(f'{path}: cannot be written: {getattr(error, "strerror", None) or error}') from None


@contextmanager
def _complete_or_absent(path: Path) -> Iterator[Path]:
    """Yield a folder to write, hidden beside ``path``; it is moved to ``path`` if the block ends without an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    hidden = Path(tempfile.mkdtemp(prefix=f'.{path.name}.', suffix='.partial', dir=path.parent))
    try:
        yield hidden / path.name
        (hidden / path.name).rename(path)
    finally:
        shutil.rmtree(hidden)
