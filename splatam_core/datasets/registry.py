"""The table of readers. Opens a recording and recognises its format."""

from __future__ import annotations

import os
from importlib import import_module
from pathlib import Path

from splatam_core.datasets.base import BagTopics, Format, ReadOptions, Sequence, cut
from splatam_core.errors import DatasetError

READERS = {
    'synthetic': 'splatam_core.datasets.synthetic',
    'tum': 'splatam_core.datasets.tum',
    'sevenscenes': 'splatam_core.datasets.sevenscenes',
    'replica': 'splatam_core.datasets.replica',
    'replica_v2': 'splatam_core.datasets.replica_v2',
    'scannet': 'splatam_core.datasets.scannet',
    'scannetpp': 'splatam_core.datasets.scannetpp',
    'scannetpp_iphone': 'splatam_core.datasets.scannetpp_iphone',
    'nerfcapture': 'splatam_core.datasets.nerfcapture',
    'record3d': 'splatam_core.datasets.record3d',
    'icl': 'splatam_core.datasets.icl',
    'folder': 'splatam_core.datasets.folder',
    'rosbag': 'splatam_core.datasets.bag.format',
}
"""Maps the name of a format to the module that exports it as ``FORMAT``; modules are imported when needed."""


def open_sequence(
    source: str,
    *,
    format: str | None = None,
    width: int | None = None,
    start: int = 0,
    max_frames: int | None = None,
    topics: BagTopics | None = None,
    stride: int = 1,
    crop: int = 0,
    split: str | None = None,
    skip_bad: bool = False,
    max_interval_s: float | None = None,
    use_receive_time: bool = False,
    rgb_encoding: str | None = None,
) -> Sequence:
    """Open a recording.

    Args:
        source: a dataset folder, a bag (rosbag2 folder, ``.db3``, ``.mcap``; ROS 1 ``.bag``), or
            ``synthetic[:options]``.
        format: one of ``READERS``; None recognises it by the source.
        width: width of the frames in pixels; None keeps the recorded size.
        start: index of the first frame.
        max_frames: largest number of frames; None reads to the end.
        topics: which topics of a bag to read; those that are None are found by type.
        stride: read every n-th frame; ``max_frames`` counts the frames that are read.
        crop: number of pixels to cut off each edge, after resizing.
        split: ``train`` or ``test`` part of a dataset that has such parts; None reads ``train``.
        skip_bad: True to skip frames that the dataset marks as bad.
        max_interval_s: largest difference between the stamps of a colour and a depth image; None leaves it to the reader.
        use_receive_time: True to take the times of recording of a bag's messages for their stamps.
        rgb_encoding: ``bgr8`` or ``rgb8``: how to read images of a bag whose encoding is 8UC3; None = bgr8, with a warning.

    Raises:
        DatasetError: the source has no known format, is damaged, or has no such frames.
        CameraError: its camera cannot be used.
    """
    options = ReadOptions(
        width=width, start=start, max_frames=max_frames, topics=topics or BagTopics(),
        stride=stride, crop=crop, split=split, skip_bad=skip_bad,
        max_interval_s=max_interval_s, use_receive_time=use_receive_time, rgb_encoding=rgb_encoding,
    )  # fmt: skip
    try:
        return _open(source, format, options)
    except OSError as error:
        raise DatasetError(f'{source}: cannot be read: {error.strerror or error}') from None


def _open(source: str, format: str | None, options: ReadOptions) -> Sequence:
    reader = _reader(format) if format is not None else _guess(source)
    if reader.is_path and not os.path.exists(source):
        raise DatasetError(f'{source}: there is no such file or folder')
    if not (reader.fits(source) if format is not None else reader.recognises(source)):
        nearby = _nearby(Path(source), [reader])
        raise DatasetError(f'{source}: {_found(Path(source))}; {reader.name} expects {reader.expects}{nearby}')
    _check_options(source, reader, options)
    return cut(reader.open(source, options), options)


def _check_options(source: str, reader: Format, options: ReadOptions) -> None:
    """Refuse options that the format does not have."""
    unsuitable = [
        ('there are no topics to choose', options.topics != BagTopics() and not reader.has_topics),
        ('there is no train or test split', options.split is not None and not reader.has_splits),
        ('no frames are flagged as bad', options.skip_bad and not reader.flags_bad),
        ('colour and depth are not paired by stamps', options.max_interval_s is not None and not reader.pairs_by_stamp),
        ('there are no times of recording', options.use_receive_time and not reader.has_topics),
        ('there are no encodings', options.rgb_encoding is not None and not reader.has_topics),
    ]
    for reason, is_given in unsuitable:
        if is_given:
            raise DatasetError(f'{source}: is read as {reader.name}, where {reason}; leave that option out')


def _reader(name: str) -> Format:
    if name not in READERS:
        raise DatasetError(f"format '{name}' is not one of {', '.join(READERS)}")
    return import_module(READERS[name]).FORMAT


def _guess(source: str) -> Format:
    readers = list(map(_reader, READERS))
    fitting = _fitting(source, readers)
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        names = ' and '.join(reader.name for reader in fitting)
        raise DatasetError(f'{source}: looks like {names} at once; choose one with --format')
    if not os.path.exists(source):
        raise DatasetError(f'{source}: there is no such file or folder')
    if nearby := _nearby(Path(source), readers):
        raise DatasetError(f'{source}: {_found(Path(source))}{nearby}')
    expected = '; '.join(f'{reader.name}: {reader.expects}' for reader in readers)
    raise DatasetError(f'{source}: {_found(Path(source))}. A recording is one of {expected}')


def _fitting(source: str, readers: list[Format]) -> list[Format]:
    """Returns the formats that a source looks like; the last resort only if it looks like no other."""
    fitting = [reader for reader in readers if reader.recognises(source)]
    return [reader for reader in fitting if not reader.is_last_resort] or fitting


def _nearby(path: Path, readers: list[Format], at_most: int = 100) -> str:
    """Returns a hint at a recording in the folder or above it, for an error message; empty if there is none."""
    inside = sorted(path.iterdir()) if path.is_dir() else []
    inside = [entry for entry in inside if entry.is_dir() or entry.suffix in ('.bag', '.mcap')][:at_most]
    guesses = [
        (reader.is_last_resort, other, reader.name)
        for other in (*inside, path.resolve().parent)
        for reader in _fitting(str(other), [reader for reader in readers if reader.is_path])
    ]
    if not guesses:
        return ''
    _, other, name = min(guesses, key=lambda guess: guess[0])
    return f'; but {other} looks like {name}: was that meant?'


def _found(path: Path, at_most: int = 6) -> str:
    if not path.is_dir():
        return f"is a '{path.suffix}' file" if path.suffix else 'is a file without a suffix'
    names = sorted(entry.name for entry in path.iterdir())
    if not names:
        return 'is an empty folder'
    more = f' and {len(names) - at_most} more' if len(names) > at_most else ''
    return f'holds {", ".join(names[:at_most])}{more}'
