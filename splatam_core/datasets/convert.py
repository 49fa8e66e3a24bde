"""Any recording as a rosbag2, in one step: the bag is there complete, or not at all."""

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

    Topics: ``/rgb/image`` (rgb8), ``/depth/image`` (16UC1 where the recording counts millimetres, else
    32FC1), ``/rgb/camera_info`` (without distortion), ``/ground_truth/pose`` (where the truth is
    known). Messages have the recording's stamps, and are recorded at them.

    Args:
        sequence: what to write.
        path: the folder to make; must not exist.
        storage: ``sqlite3`` or ``mcap``.
        compressed: write JPEG to ``/rgb/image/compressed`` and PNG to ``/depth/image/compressedDepth``
            instead; colours then come back slightly different, and depth too unless it is in millimetres.
        progress: wraps the indices of the frames as they are written, to draw a progress bar.

    Raises:
        DatasetError: the path exists or cannot be written, or a frame cannot be read.
        FrameError: a frame's images do not fit its camera.
    """
    if storage not in STORAGES:
        raise DatasetError(f"storage '{storage}' is not one of {', '.join(STORAGES)}")
    path = Path(path)
    if path.exists() or path.is_symlink():
        raise DatasetError(f'{path}: exists already; remove it or choose another name')
    from splatam_core.datasets import rosbag  # the bag library is only loaded where a bag is read or written

    indices = range(len(sequence))
    try:
        with _complete_or_absent(path) as folder:
            rosbag.write(sequence, folder, storage, compressed, progress(indices) if progress else indices)
    except (OSError, sqlite3.Error) as error:
        raise DatasetError(f'{path}: cannot be written: {error}') from None


@contextmanager
def _complete_or_absent(path: Path) -> Iterator[Path]:
    """A folder of the same name in a hidden place beside it; moved to ``path`` when the block is through."""
    path.parent.mkdir(parents=True, exist_ok=True)
    hidden = Path(tempfile.mkdtemp(prefix=f'.{path.name}.', suffix='.partial', dir=path.parent))
    try:
        yield hidden / path.name
        (hidden / path.name).rename(path)
    finally:
        shutil.rmtree(hidden)
