"""``splatam``: the command line. A command is a function, a function that adds its arguments, and a row below."""

from __future__ import annotations

import argparse
import logging
import signal
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType, TracebackType
from typing import TYPE_CHECKING

from splatam_core.errors import DatasetError, FrameError, RunFolderError, SplatamError

# Whatever takes time to import (torch, OpenCV, matplotlib) is imported by the command that needs it.
if TYPE_CHECKING:
    from splatam_core.datasets.base import Sequence as FrameSequence
    from splatam_core.evaluation.metrics import Metrics
    from splatam_core.run_folder import RunFolder, RunRecord, Source
    from splatam_core.slam import Slam
    from splatam_core.types import Trajectory

EXIT_ERROR = 2
EXIT_INTERRUPTED = 130
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


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line; returns the exit code. Errors that a user can cause are one line, others a traceback."""
    args = make_parser().parse_args(arguments)
    logging.basicConfig(level=logging.WARNING, format='splatam: %(levelname)s: %(message)s')
    try:
        return args.run(args)
    except SplatamError as error:
        print(f'splatam: error: {error}', file=sys.stderr)
        return EXIT_ERROR
    except KeyboardInterrupt:
        print('splatam: interrupted', file=sys.stderr)
        return EXIT_INTERRUPTED


def make_parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    parser = argparse.ArgumentParser('splatam', description='Dense RGB-D SLAM with 3D Gaussians.')
    commands = parser.add_subparsers(metavar='COMMAND', required=True)
    for command in COMMANDS:
        subparser = commands.add_parser(command.name, help=command.help, description=command.help)
        command.add_arguments(subparser)
        subparser.set_defaults(run=command.run)
    return parser


# --- run ---


def _add_run_arguments(parser: argparse.ArgumentParser) -> None:
    _add_source_arguments(parser)
    parser.add_argument('--preset', default='splatam', help='a shipped preset or a .yaml file (default: %(default)s)')
    parser.add_argument(
        '--set', action='append', default=[], metavar='KEY=VALUE', help='change a setting; may be given several times'
    )
    parser.add_argument('--out', type=Path, required=True, metavar='DIR', help='folder for the results')
    parser.add_argument('--overwrite', action='store_true', help='replace the run that is in DIR')
    parser.add_argument('--no-evaluate', action='store_true', help='leave out scores of images and truth, and report')


def run(args: argparse.Namespace) -> int:
    """``splatam run``: SLAM over a recording."""
    from splatam_core.config import apply_threads, load_config
    from splatam_core.run_folder import RunDescription, RunFolder, read_run
    from splatam_core.slam import Slam
    from splatam_core.truth import FramesWithTruth

    config = load_config(args.preset, args.set)
    apply_threads(config)
    source = _source(args)
    sequence = _open(source)
    if config.tracking.method == 'truth':
        sequence = FramesWithTruth(sequence)
    description = RunDescription('splatam run', args.preset, source)
    folder = RunFolder.create(args.out, config, description, overwrite=args.overwrite)
    with folder, _StopRequest() as stop:
        true_motion = sequence.motion if isinstance(sequence, FramesWithTruth) else None
        slam = Slam(config, true_motion=true_motion, num_frames=len(sequence))
        failure = _process(sequence, slam, folder, stop)
        metrics = folder.finish(slam)
    if failure is not None:
        _say(f'what was done before the error is in {args.out}')
        raise failure
    if stop.requested:
        _say(f'stopped after {metrics.frames} of {len(sequence)} frames; all of it is in {args.out}')
        _say(f"'splatam evaluate {args.out}' scores it")
        return EXIT_INTERRUPTED
    if metrics.frames == 0:
        raise RunFolderError(f'{sequence.name}: not one of its {len(sequence)} frames could be used; see above')
    if not args.no_evaluate:
        metrics = _score_own_run(read_run(args.out), sequence)
    _print_summary(metrics, args.out)
    return 0


def _score_own_run(run: RunRecord, sequence: FrameSequence) -> Metrics:
    """Score a run just done; where too little was tracked to compare with the truth, the images only."""
    try:
        return _score(run, sequence.ground_truth(), sequence, every=1)
    except RunFolderError as error:
        _say(f'no trajectory error: {error}')
        return _score(run, None, sequence, every=1)


class _StopRequest:
    """Turns Ctrl-C into a request to stop after the frame; a second one interrupts at once."""

    def __init__(self) -> None:
        self.requested = False

    def __enter__(self) -> _StopRequest:
        self._previous = signal.signal(signal.SIGINT, self._request)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        signal.signal(signal.SIGINT, self._previous)

    def _request(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
        signal.signal(signal.SIGINT, signal.default_int_handler)
        _say('stopping after this frame; Ctrl-C again stops at once, without saving the map')


def _process(sequence: FrameSequence, slam: Slam, folder: RunFolder, stop: _StopRequest) -> DatasetError | None:
    """Process frame after frame, to the end or to a stop request. Returns what broke the recording, if anything."""
    from tqdm import tqdm

    tracked = lost = 0
    with tqdm(range(len(sequence)), unit='frame', dynamic_ncols=True) as bar:
        for index in bar:
            if stop.requested:
                break
            started_s = time.perf_counter()
            try:
                frame = sequence[index]
                decoded_s = time.perf_counter()
                result = slam.process(frame)
            except FrameError as error:
                _say(f'frame {index} is left out: {error}')
                continue
            except DatasetError as error:
                return error
            folder.append(frame, result, time.perf_counter() - decoded_s, decoded_s - started_s)
            tracked, lost = tracked + (result.T_world_cam is not None), lost + (result.T_world_cam is None)
            bar.set_postfix(tracked=tracked, lost=lost, gaussians=result.num_gaussians, refresh=False)
    return None


# --- evaluate ---


def _add_evaluate_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('dir', type=Path, metavar='DIR', help="folder of a run, the command line's or the node's")
    parser.add_argument(
        '--truth', metavar='FILE|BAG|DATASET', help="TUM trajectory, bag or dataset (default: the run's own source)"
    )
    parser.add_argument(
        '--every', type=_positive, default=1, metavar='N', help='score the images of every n-th frame only'
    )


def evaluate(args: argparse.Namespace) -> int:
    """``splatam evaluate``: score a run and draw its report."""
    from splatam_core.config import apply_threads
    from splatam_core.run_folder import MAP, read_run

    run = read_run(args.dir)
    apply_threads(run.config)
    truth, sequence = _truth_and_frames(run, args.truth)
    if sequence is not None and not (run.path / MAP).is_file():
        _say(f'{run.path} has no {MAP}, the run ended before it was saved: trajectory only')
        sequence = None
    _print_summary(_score(run, truth, sequence, args.every), args.dir)
    return 0


def _truth_and_frames(run: RunRecord, given: str | None) -> tuple[Trajectory | None, FrameSequence | None]:
    """What to score against. The run's own source shows the frames where it can be opened."""
    from splatam_core.run_folder import Source
    from splatam_core.trajectory import read_trajectory

    if given is None:
        if run.description.source is None:
            raise RunFolderError(f'{run.path} does not say where its frames came from: pass --truth FILE|BAG|DATASET')
        sequence = _open(run.description.source)
        return sequence.ground_truth(), sequence
    own = _open_own_source(run)
    if Path(given).is_file() and Path(given).suffix not in BAG_SUFFIXES:
        return read_trajectory(Path(given)), own
    other = _open(Source(given, width=run.camera.width if run.camera else None))
    truth = other.ground_truth()
    if truth is None:
        _say(f'{given} has no true poses: images only')
    return truth, other if own is None else own


def _open_own_source(run: RunRecord) -> FrameSequence | None:
    if run.description.source is None:
        return None
    try:
        return _open(run.description.source)
    except SplatamError as error:
        _say(f"the run's own source is not used: {error}")
        return None


def _score(run: RunRecord, truth: Trajectory | None, sequence: FrameSequence | None, every: int) -> Metrics:
    """Score, then write ``metrics.json`` and ``report.png``; an error leaves both as they are."""
    from splatam_core.evaluation.report import write_report
    from splatam_core.evaluation.score import combine, score_images, score_trajectory
    from splatam_core.files import replace_text
    from splatam_core.run_folder import METRICS, REPORT

    against_truth = None if truth is None else score_trajectory(run, truth)
    against_images = None if sequence is None else score_images(run, sequence, every, _progress('scoring'))
    evaluation = combine(run, against_truth, against_images)
    replace_text(run.path / METRICS, evaluation.metrics.to_json())
    write_report(evaluation, run.path / REPORT)
    return evaluation.metrics


# --- convert ---


def _add_convert_arguments(parser: argparse.ArgumentParser) -> None:
    _add_source_arguments(parser)
    parser.add_argument('bag', type=Path, metavar='BAG', help='folder of the rosbag2 to write')
    parser.add_argument('--storage', choices=('sqlite3', 'mcap'), default='sqlite3', help='default: %(default)s')
    parser.add_argument('--compressed', action='store_true', help='JPEG colour and PNG depth')


def convert(args: argparse.Namespace) -> int:
    """``splatam convert``: write a recording as a rosbag2."""
    from splatam_core.datasets.convert import write_bag

    sequence = _open(_source(args))
    write_bag(sequence, args.bag, storage=args.storage, compressed=args.compressed, progress=_progress('writing'))
    print(f'{len(sequence)} frames of {sequence.name} are in {args.bag}')
    return 0


# --- ablations ---


def _add_ablations_arguments(parser: argparse.ArgumentParser) -> None:
    _add_source_arguments(parser)
    parser.add_argument('--preset', default='splatam', help='what all start from (default: %(default)s)')
    parser.add_argument('--set', action='append', default=[], metavar='KEY=VALUE', help='a setting of all of them')
    parser.add_argument('--only', nargs='+', metavar='NAME', help='some of them (default: all; see config/ablations)')
    parser.add_argument('--out', type=Path, required=True, metavar='DIR', help='folder of the runs; finished ones are kept')


def ablations(args: argparse.Namespace) -> int:
    """``splatam ablations``: the paper's ablations over a recording, as a table."""
    from splatam_core.ablations import provenance, run, table, variant_names, variants

    chosen = variants(args.only or variant_names(), args.preset, args.set)
    source = _source(args)
    _open(source)
    arguments = source_arguments(source)
    folders = {variant.name: args.out / variant.name for variant in chosen}
    for number, variant in enumerate(chosen, 1):
        _say(f'{variant.name} ({number} of {len(chosen)})')
        if not run(variant, arguments, source, folders[variant.name]):
            _say(f'{variant.name} failed; see above')
    title = f'{Path(source.path).name}{_window_text(source)}, preset `{args.preset}`'
    print(f'{title}; {provenance(folders.values())}; runs: 1.\n\n{table(folders)}')
    return 0


def _window_text(source: Source) -> str:
    parts = [
        f'from frame {source.start}' if source.start else '',
        f'stride {source.stride}' if source.stride > 1 else '',
        f'at most {source.max_frames} frames' if source.max_frames else '',
        f'width {source.width}' if source.width else '',
    ]
    return ''.join(f', {part}' for part in parts if part)


# --- shared ---


def _add_source_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        'source', metavar='SOURCE', help='dataset folder, bag (folder, .db3, .mcap, ROS 1 .bag), synthetic[:seed=0,...]'
    )
    parser.add_argument('--format', metavar='F', help='reader to use (default: guessed from SOURCE)')
    parser.add_argument('--start', type=int, default=0, metavar='N', help='leave out the first N frames')
    parser.add_argument('--max-frames', type=_positive, metavar='N', help='read at most N frames')
    parser.add_argument('--stride', type=_positive, default=1, metavar='N', help='read every n-th frame only')
    parser.add_argument('--width', type=_positive, metavar='W', help='resize the frames to W pixels across')
    parser.add_argument('--crop', type=int, default=0, metavar='P', help='cut P pixels off each edge, after resizing')
    parser.add_argument('--split', choices=('train', 'test'), help='of Replica-V2 and ScanNet++ (default: train)')
    parser.add_argument('--skip-bad', action='store_true', help='leave out what ScanNet++ flags as bad')
    for topic, what in (('rgb', 'colour'), ('depth', 'depth'), ('info', 'camera info')):
        parser.add_argument(f'--{topic}', metavar='TOPIC', help=f'{what} topic of a bag (default: found by type)')


def _source(args: argparse.Namespace) -> Source:
    from splatam_core.run_folder import Source

    path = str(Path(args.source).resolve()) if Path(args.source).exists() else args.source
    return Source(
        path, args.format, args.start, args.max_frames, args.width, args.rgb, args.depth, args.info,
        args.stride, args.crop, args.split, args.skip_bad,
    )  # fmt: skip


def source_arguments(source: Source) -> list[str]:
    """The arguments that name a source on the command line."""
    options = {
        '--format': source.format, '--start': source.start, '--max-frames': source.max_frames, '--width': source.width,
        '--rgb': source.rgb, '--depth': source.depth, '--info': source.info, '--stride': source.stride,
        '--crop': source.crop, '--split': source.split,
    }  # fmt: skip
    given = [word for name, value in options.items() if value is not None for word in (name, str(value))]
    return [source.path, *given, *(['--skip-bad'] if source.skip_bad else [])]


def _open(source: Source) -> FrameSequence:
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


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f'{value} is not at least 1')
    return value


def _progress(what: str) -> Callable[[range], Iterable[int]]:
    """Wraps a loop over frames in a progress bar that goes away when it is done."""
    from tqdm import tqdm

    return lambda indices: tqdm(indices, unit='frame', desc=what, dynamic_ncols=True, leave=False, disable=None)


def _say(text: str) -> None:
    """To the user, beside results and above a progress bar."""
    from tqdm import tqdm

    tqdm.write(f'splatam: {text}', file=sys.stderr)


def _print_summary(metrics: Metrics, folder: Path) -> None:
    rows = [
        ('tracked', f'{metrics.tracked} of {metrics.frames} frames'),
        ('speed', _text(metrics.fps, 1, '.2f', 'fps, decoding excluded')),
        ('ATE RMSE', _text(metrics.ate_rmse_m, 100, '.2f', 'cm')),
        ('PSNR', _text(metrics.psnr_db, 1, '.2f', 'dB')),
        ('SSIM', _text(metrics.ssim, 1, '.3f', '')),
        ('depth L1', _text(metrics.depth_l1_m, 100, '.2f', 'cm')),
        ('Gaussians', _text(metrics.num_gaussians, 1, ',', '')),
        ('results', str(folder)),
    ]
    for name, value in rows:
        print(f'{name:<10} {value}'.rstrip())


def _text(value: float | None, factor: float, digits: str, unit: str) -> str:
    return 'not known' if value is None else f'{value * factor:{digits}} {unit}'


COMMANDS = (
    Command('run', 'run SLAM over a recording', _add_run_arguments, run),
    Command('evaluate', 'score a run and draw its report', _add_evaluate_arguments, evaluate),
    Command('ablations', "run the paper's ablations over a recording", _add_ablations_arguments, ablations),
    Command('convert', 'write a recording as a rosbag2', _add_convert_arguments, convert),
)


if __name__ == '__main__':
    sys.exit(main())
