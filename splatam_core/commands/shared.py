"""What the commands of ``splatam`` share: their form, common arguments, opening recordings and runs, and messages."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, TYPE_CHECKING, TypeVar

from splatam_core.config import DEVICES, computed_on
from splatam_core.errors import SplatamError, printable

if TYPE_CHECKING:
    from splatam_core.config import SlamConfig
    from splatam_core.datasets.base import Sequence as FrameSequence
    from splatam_core.geometry.trajectory import Trajectory
    from splatam_core.runs.record import RunRecord, Source

BAG_SUFFIXES = ('.db3', '.mcap', '.bag')
EXIT_ERROR = 2
MAX_NUMBER = 10**9
"""Of a whole number on the command line."""

EXIT_INTERRUPTED = 130
Number = TypeVar('Number', int, float)


@dataclass(frozen=True, slots=True)
class Command:
    """A subcommand.

    Attributes:
        name: as typed.
        help: one line.
        add_arguments: adds its arguments to a parser.
        run: runs it; returns the exit code.
    """

    name: str
    help: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], int]


def add_source_arguments(parser: argparse.ArgumentParser, *, nargs: str | None = None) -> None:
    """Adds SOURCE and how to read it.

    Args:
        parser: gets the arguments.
        nargs: how many sources are given: None = one, '?' = one or none, '+' = any number, all read alike.
    """
    parser.add_argument(
        'source',
        metavar='SOURCE',
        nargs=nargs,
        help='dataset folder, bag (folder, .db3, .mcap, ROS 1 .bag), synthetic[:seed=0,...]',
    )
    parser.add_argument('--format', metavar='F', help='reader of SOURCE (default: found from its files)')
    parser.add_argument('--start', type=int, default=0, metavar='N', help='skip the first N frames')
    parser.add_argument('--max-frames', type=positive, metavar='N', help='read at most N frames')
    parser.add_argument('--stride', type=positive, default=1, metavar='N', help='read every n-th frame only (default: 1)')
    parser.add_argument('--width', type=positive, metavar='W', help='resize the frames to a width of W pixels')
    parser.add_argument('--crop', type=int, default=0, metavar='P', help='cut P pixels off each edge after resizing')
    parser.add_argument('--split', choices=('train', 'test'), help='split of Replica-V2 and ScanNet++ to read (default: train)')
    parser.add_argument('--skip-bad', action='store_true', help='skip the frames that ScanNet++ flags as bad')
    parser.add_argument(
        '--max-interval', type=seconds, metavar='S', help='pair colour and depth at most S seconds apart (default: by their rate)'
    )
    parser.add_argument('--use-receive-time', action='store_true', help='take the times of recording of a bag for stamps')
    parser.add_argument('--rgb-encoding', choices=('bgr8', 'rgb8'), help='how to read images of encoding 8UC3 (default: bgr8)')
    for topic, what in (('rgb', 'colour'), ('depth', 'depth'), ('info', 'camera info')):
        parser.add_argument(f'--{topic}', metavar='TOPIC', help=f'{what} topic of a bag (default: found by type)')


def add_preset_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds --preset and --set."""
    parser.add_argument('--preset', default='splatam', help='a shipped preset or a .yaml file (default: %(default)s)')
    add_set_argument(parser)


def add_set_argument(parser: argparse.ArgumentParser) -> None:
    """Adds --set."""
    parser.add_argument('--set', action='append', default=[], metavar='KEY=VALUE', help='change a setting; may be repeated')


def add_run_argument(parser: argparse.ArgumentParser) -> None:
    """Adds DIR, a run folder, and --device."""
    parser.add_argument('dir', type=Path, metavar='DIR', help='run folder, written by splatam run or the node')
    add_device_argument(parser, "device to compute on (default: as the run's settings say)")


def add_device_argument(parser: argparse.ArgumentParser, help: str) -> None:
    """Adds --device."""
    parser.add_argument('--device', choices=DEVICES, help=help)


def source_of(args: argparse.Namespace, path: str | None = None) -> Source:
    """Returns the recording that the arguments name.

    Args:
        args: of ``add_source_arguments``.
        path: one of several recordings; None = the only one.
    """
    from splatam_core.runs.record import Source

    path = args.source if path is None else path
    return Source(
        path=str(Path(path).resolve()) if os.path.exists(path) else path,  # False for impossible names, too
        format=args.format,
        start=args.start,
        max_frames=args.max_frames,
        width=args.width,
        rgb=args.rgb,
        depth=args.depth,
        info=args.info,
        stride=args.stride,
        crop=args.crop,
        split=args.split,
        skip_bad=args.skip_bad,
        max_interval_s=args.max_interval,
        use_receive_time=args.use_receive_time,
        rgb_encoding=args.rgb_encoding,
    )


def at_width(source: Source, config: SlamConfig) -> Source:
    """Returns the source at the configuration's width if it names no width itself and its frames are wider.

    Args:
        source: the recording.
        config: its ``width`` is used.

    Raises:
        DatasetError, CameraError: it cannot be read.
    """
    if source.width is not None or config.width == 0:
        return source
    recorded = open_source(source).camera.width + 2 * source.crop
    return replace(source, width=config.width) if recorded > config.width else source


def source_words(source: Source) -> list[str]:
    """Returns the command-line arguments that name a source."""
    given = {
        '--format': source.format, '--start': source.start, '--max-frames': source.max_frames, '--stride': source.stride,
        '--width': source.width, '--crop': source.crop, '--split': source.split, '--rgb': source.rgb,
        '--depth': source.depth, '--info': source.info, '--max-interval': source.max_interval_s,
        '--rgb-encoding': source.rgb_encoding,
    }  # fmt: skip
    words = [str(word) for name, value in given.items() if value is not None for word in (name, value)]
    switches = {'--skip-bad': source.skip_bad, '--use-receive-time': source.use_receive_time}
    return [source.path, *words, *(name for name, is_given in switches.items() if is_given)]


def open_source(source: Source) -> FrameSequence:
    """Opens a recording.

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
        max_interval_s=source.max_interval_s,
        use_receive_time=source.use_receive_time,
        rgb_encoding=source.rgb_encoding,
    )


def usable_ground_truth(sequence: FrameSequence) -> Trajectory | None:
    """Returns the true poses of a recording; None if it has none. A fault in them is said, and costs nothing but them."""
    try:
        return sequence.ground_truth()
    except SplatamError as error:
        say(f'the ground truth is not used: {error}')
        return None


def open_run(path: Path, device: str | None = None) -> RunRecord:
    """Reads a run folder, and limits the libraries to the run's number of threads.

    Args:
        path: the folder.
        device: where to compute; None = as the run's settings say.

    Raises:
        RunFolderError: the path is no run folder, or one of its files is damaged.
    """
    from splatam_core.config import apply_threads
    from splatam_core.runs.record import read_run

    run = read_run(path)
    run = replace(run, config=computed_on(run.config, device))
    apply_threads(run.config)
    return run


def run_in_own_process(arguments: Iterable[object], stdout: IO[str] | None = None) -> int:
    """Runs ``splatam`` in a process of its own, which frees all its memory in the end. Returns its exit code.

    Args:
        arguments: the words after ``splatam``.
        stdout: where it prints; None = where this process prints.

    Raises:
        KeyboardInterrupt: Ctrl-C stopped it.
    """
    command = [sys.executable, '-m', 'splatam_core.cli', *map(str, arguments)]
    code = subprocess.run(command, stdout=stdout, check=False).returncode
    if code == EXIT_INTERRUPTED:
        raise KeyboardInterrupt
    return code


def process_that_ends_with_this(arguments: Sequence[str]) -> list[str]:
    """Returns a command line of ``splatam`` for a process that Linux kills when this one ends, however it ends.

    Args:
        arguments: the words after ``splatam``.
    """
    return [sys.executable, '-c', _END_WITH_PARENT, str(os.getpid()), *arguments]


_END_WITH_PARENT = """
import ctypes, os, signal, sys
if sys.platform == 'linux':
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG
if os.getppid() != int(sys.argv[1]):
    sys.exit('the process that started this one has ended')
from splatam_core.cli import main
sys.exit(main(sys.argv[2:]))
"""


def as_number(text: str, kind: type[Number]) -> Number:
    """Returns a number of a kind, for argparse, which otherwise would name the function that reads it."""
    try:
        return kind(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a {'whole ' if kind is int else ''}number") from None


def positive(text: str) -> int:
    """Returns a whole number of at least 1, for argparse."""
    value = as_number(text, int)
    if value < 1:
        raise argparse.ArgumentTypeError(f'{value} is not at least 1')
    if value > MAX_NUMBER:
        raise argparse.ArgumentTypeError(f'{value} is more than {MAX_NUMBER}')
    return value


def seconds(text: str) -> float:
    """Returns a time of 0 to 10 s, for argparse."""
    value = as_number(text, float)
    if not 0 <= value <= 10:
        raise argparse.ArgumentTypeError(f'{text} is not from 0 to 10')
    return value


def progress(what: str, unit: str = 'frame') -> Callable[[range], Iterable[int]]:
    """Returns a wrapper for loops that shows a progress bar until the loop ends."""
    from tqdm import tqdm

    return lambda indices: tqdm(indices, unit=unit, desc=what, dynamic_ncols=True, leave=False, disable=None)


def say(text: str) -> None:
    """Prints a message to the user on stderr, above a progress bar."""
    from tqdm import tqdm

    tqdm.write(f'splatam: {printable(text)}', file=sys.stderr)
