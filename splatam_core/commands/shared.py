"""What the commands of ``splatam`` share: their form, the arguments that name a recording, and how they speak."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from splatam_core.config import DEVICES, computed_on

if TYPE_CHECKING:
    from splatam_core.config import SlamConfig
    from splatam_core.datasets.base import Sequence
    from splatam_core.runs.run_folder import RunRecord, Source

BAG_SUFFIXES = ('.db3', '.mcap', '.bag')


@dataclass(frozen=True, slots=True)
class Command:
    """A subcommand.

    Attributes:
        name: as typed.
        help: one line.
        add_arguments: declares its arguments.
        run: does it; returns the exit code.
    """

    name: str
    help: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]


def add_source_arguments(parser: argparse.ArgumentParser, *, optional: bool = False) -> None:
    """SOURCE and how to read it."""
    parser.add_argument(
        'source',
        metavar='SOURCE',
        nargs='?' if optional else None,
        help='dataset folder, bag (folder, .db3, .mcap, ROS 1 .bag), synthetic[:seed=0,...]',
    )
    parser.add_argument('--format', metavar='F', help='reader to use (default: guessed from SOURCE)')
    parser.add_argument('--start', type=int, default=0, metavar='N', help='leave out the first N frames')
    parser.add_argument('--max-frames', type=positive, metavar='N', help='read at most N frames')
    parser.add_argument('--stride', type=positive, default=1, metavar='N', help='read every n-th frame only')
    parser.add_argument('--width', type=positive, metavar='W', help='resize the frames to W pixels across')
    parser.add_argument('--crop', type=int, default=0, metavar='P', help='cut P pixels off each edge, after resizing')
    parser.add_argument('--split', choices=('train', 'test'), help='of Replica-V2 and ScanNet++ (default: train)')
    parser.add_argument('--skip-bad', action='store_true', help='leave out what ScanNet++ flags as bad')
    for topic, what in (('rgb', 'colour'), ('depth', 'depth'), ('info', 'camera info')):
        parser.add_argument(f'--{topic}', metavar='TOPIC', help=f'{what} topic of a bag (default: found by type)')


def add_run_argument(parser: argparse.ArgumentParser) -> None:
    """DIR, a run's folder."""
    parser.add_argument('dir', type=Path, metavar='DIR', help="folder of a run, the command line's or the node's")
    add_device_argument(parser, "where to compute (default: as the run's settings say)")


def add_device_argument(parser: argparse.ArgumentParser, help: str) -> None:
    """--device."""
    parser.add_argument('--device', choices=DEVICES, help=help)


def source_of(args: argparse.Namespace) -> Source:
    """The recording that the arguments name."""
    from splatam_core.runs.run_folder import Source

    path = str(Path(args.source).resolve()) if Path(args.source).exists() else args.source
    return Source(
        path, args.format, args.start, args.max_frames, args.width, args.rgb, args.depth, args.info,
        args.stride, args.crop, args.split, args.skip_bad,
    )  # fmt: skip


def at_width(source: Source, config: SlamConfig) -> Source:
    """The source at the configuration's width, where none was asked for and its frames are wider.

    Raises:
        DatasetError, CameraError: it cannot be read.
    """
    if source.width is not None or config.width == 0:
        return source
    recorded = open_source(source).camera.width + 2 * source.crop
    return replace(source, width=config.width) if recorded > config.width else source


def source_words(source: Source) -> list[str]:
    """The arguments that name a source, as they are typed."""
    given = {
        '--format': source.format, '--start': source.start, '--max-frames': source.max_frames, '--stride': source.stride,
        '--width': source.width, '--crop': source.crop, '--split': source.split, '--rgb': source.rgb,
        '--depth': source.depth, '--info': source.info,
    }  # fmt: skip
    words = [str(word) for name, value in given.items() if value is not None for word in (name, value)]
    return [source.path, *words, *(['--skip-bad'] if source.skip_bad else [])]


def open_source(source: Source) -> Sequence:
    """Open a recording.

    Raises:
        DatasetError, CameraError: it cannot be read.
    """
    from splatam_core.datasets.base import BagTopics
    from splatam_core.datasets.registry import open_sequence

    return open_sequence(
        source.path,
        format=source.format,
        width=source.width,
        start=source.start,
        max_frames=source.max_frames,
        topics=BagTopics(source.rgb, source.depth, source.info),
        stride=source.stride,
        crop=source.crop,
        split=source.split,
        skip_bad=source.skip_bad,
    )


def open_run(path: Path, device: str | None = None) -> RunRecord:
    """Read a run's folder and keep the libraries within its threads.

    Args:
        path: the folder.
        device: where to compute; None = as the run's settings say.

    Raises:
        RunFolderError: it is no run folder, or one of its files is damaged.
    """
    from splatam_core.config import apply_threads
    from splatam_core.runs.run_folder import read_run

    run = read_run(path)
    run = replace(run, config=computed_on(run.config, device))
    apply_threads(run.config)
    return run


def positive(text: str) -> int:
    """A whole number that is at least 1, for argparse."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f'{value} is not at least 1')
    return value


def progress(what: str, unit: str = 'frame') -> Callable[[range], Iterable[int]]:
    """Wraps a loop in a progress bar that goes away when it is done."""
    from tqdm import tqdm

    return lambda indices: tqdm(indices, unit=unit, desc=what, dynamic_ncols=True, leave=False, disable=None)


def say(text: str) -> None:
    """To the user, beside results and above a progress bar."""
    from tqdm import tqdm

    tqdm.write(f'splatam: {text}', file=sys.stderr)
