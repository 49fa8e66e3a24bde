"""``splatam``: the command line. ``run`` is here, every other command a file in ``commands/`` and a row below."""

from __future__ import annotations

import argparse
import logging
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType, TracebackType
from typing import TYPE_CHECKING

from splatam_core.commands import ablations, bench, compare, convert, evaluate, export, refine, render
from splatam_core.commands.evaluate import print_summary, score_own_run
from splatam_core.commands.shared import (
    Command,
    add_device_argument,
    add_source_arguments,
    at_width,
    open_source,
    positive,
    say,
    source_of,
)
from splatam_core.errors import DatasetError, FrameError, RunFolderError, SplatamError

# Whatever takes time to import (torch, OpenCV, matplotlib) is imported by the command that needs it.
if TYPE_CHECKING:
    from splatam_core.datasets.base import Sequence as FrameSequence
    from splatam_core.runs.resume import CheckpointWriter
    from splatam_core.runs.run_folder import RunFolder
    from splatam_core.slam import Slam

EXIT_ERROR = 2
EXIT_INTERRUPTED = 130


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
    add_source_arguments(parser, optional=True)
    parser.add_argument('--preset', default='splatam', help='a shipped preset or a .yaml file (default: %(default)s)')
    parser.add_argument(
        '--set', action='append', default=[], metavar='KEY=VALUE', help='change a setting; may be given several times'
    )
    add_device_argument(parser, 'where to compute, or with --resume to go on; the same as --set device=D')
    parser.add_argument('--out', type=Path, metavar='DIR', help='folder for the results')
    parser.add_argument('--overwrite', action='store_true', help='replace the run that is in DIR')
    parser.add_argument(
        '--holdout', type=positive, metavar='N',
        help='track every n-th frame, but keep it out of the map to score it on; the same as --set mapping.hold_out=N',
    )  # fmt: skip
    parser.add_argument(
        '--checkpoint-every', type=positive, metavar='N', help='save all that --resume needs after every n-th frame'
    )
    parser.add_argument('--keep-checkpoints', type=positive, metavar='K', help='remove all but the last K checkpoints (default: 2)')
    parser.add_argument(
        '--resume', type=Path, metavar='DIR', help='go on from the last checkpoint of the run in DIR, to the same result'
    )
    parser.add_argument('--no-evaluate', action='store_true', help='leave out scores of images and truth, and report')


def run(args: argparse.Namespace) -> int:
    """``splatam run``: SLAM over a recording, from its beginning or from a checkpoint."""
    from splatam_core.runs.run_folder import read_run

    job = _begin(args) if args.resume is None else _resume(args)
    path, length = job.folder.path, len(job.sequence)
    try:
        with job.folder, _StopRequest() as stop:
            failure = _process(job, stop)
            is_whole = failure is None and not stop.requested
            if not is_whole:
                job.checkpoints.at_stop(job.slam)
            finish_s = _finish(job, stop) if is_whole else 0.0
            metrics = job.folder.finish(job.slam, finish_s)
    except OSError as error:
        raise RunFolderError(f'{path}: cannot be written: {error.strerror}; make room{_resume_hint(path)}') from None
    if failure is not None:
        say(f'what was done before the error is in {path}{_resume_hint(path)}')
        raise failure
    if stop.requested:
        what = f'after {metrics.frames} of {length} frames' if not is_whole else 'while the map was fitted once more'
        say(f'stopped {what}; all of it is in {path}{_resume_hint(path)}')
        say(f"'splatam evaluate {path}' scores it")
        return EXIT_INTERRUPTED
    if metrics.frames == 0:
        raise RunFolderError(f'{job.sequence.name}: not one of its {length} frames could be used; see above')
    if not args.no_evaluate:
        metrics = score_own_run(read_run(path), job.sequence)
    print_summary(metrics, path)
    return 0


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """A run about to begin, or to go on.

    Attributes:
        sequence: its frames.
        first: index of the first one to process.
        slam: ready for it.
        folder: ready for it.
        checkpoints: saves them.
    """

    sequence: FrameSequence
    first: int
    slam: Slam
    folder: RunFolder
    checkpoints: CheckpointWriter


def _begin(args: argparse.Namespace) -> _Job:
    from splatam_core.config import apply_threads, load_config
    from splatam_core.runs.offline import prepare
    from splatam_core.runs.resume import CheckpointWriter
    from splatam_core.runs.run_folder import KEEP_CHECKPOINTS, RunDescription, RunFolder

    if args.source is None or args.out is None:
        make_parser().error('run needs SOURCE and --out DIR, or --resume DIR to go on with one')
    given = {'mapping.hold_out': args.holdout, 'device': args.device}
    config = load_config(args.preset, [*args.set, *(f'{name}={value}' for name, value in given.items() if value)])
    apply_threads(config)
    source = at_width(source_of(args), config)
    sequence, slam = prepare(open_source(source), config)
    _say_where(slam)
    every, keep = args.checkpoint_every, args.keep_checkpoints or KEEP_CHECKPOINTS
    description = RunDescription('splatam run', args.preset, source, every, keep)
    folder = RunFolder.create(args.out, config, description, overwrite=args.overwrite)
    return _Job(sequence, 0, slam, folder, CheckpointWriter(folder, len(sequence), every, keep, say))


def _resume(args: argparse.Namespace) -> _Job:
    from splatam_core.config import apply_threads
    from splatam_core.runs.resume import CheckpointWriter, resume

    _check_is_all(args)
    run = resume(args.resume, open_source, apply_threads, say, args.device)
    _say_where(run.slam)
    description = run.settings.description
    every = args.checkpoint_every or description.checkpoint_every
    keep = args.keep_checkpoints or description.keep_checkpoints
    say(f'going on with {args.resume} at frame {run.first} of {len(run.sequence)}')
    writer = CheckpointWriter(run.folder, len(run.sequence), every, keep, say)
    return _Job(run.sequence, run.first, run.slam, run.folder, writer)


def _say_where(slam: Slam) -> None:
    if slam.backend.why:
        say(str(slam.backend))


def _check_is_all(args: argparse.Namespace) -> None:
    """Make sure that nothing was asked for that the resumed run has settled already."""
    free = {'resume', 'run', 'checkpoint_every', 'keep_checkpoints', 'no_evaluate', 'device'}
    defaults = make_parser().parse_args(['run'])
    given = [name for name, value in vars(args).items() if name not in free and value != getattr(defaults, name)]
    if given:
        names = ', '.join('SOURCE' if name == 'source' else '--' + name.replace('_', '-') for name in given)
        raise SplatamError(f'--resume takes source and settings from the folder: leave out {names}')


def _resume_hint(path: Path) -> str:
    from splatam_core.runs.checkpoints import checkpoint_paths
    from splatam_core.runs.run_folder import CHECKPOINTS

    return f"; 'splatam run --resume {path}' goes on" if checkpoint_paths(path / CHECKPOINTS) else ''


class _StopRequest:
    """Turns Ctrl-C into a request to stop after the frame, or after the step; a second one interrupts at once."""

    def __init__(self) -> None:
        self.requested = False
        self.when = 'after this frame'

    def __enter__(self) -> _StopRequest:
        self._previous = signal.signal(signal.SIGINT, self._request)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        signal.signal(signal.SIGINT, self._previous)

    def _request(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
        signal.signal(signal.SIGINT, signal.default_int_handler)
        say(f'stopping {self.when}; Ctrl-C again stops at once, without saving the map')


def _finish(job: _Job, stop: _StopRequest) -> float:
    """Fit the map once more, where the settings ask for it; the seconds that took."""
    stop.when = 'where the map is by now'
    if job.slam.config.mapping.final_passes:
        say('all frames are processed; fitting the map to all keyframes once more')
    begin = time.perf_counter()
    job.slam.finish(stop=lambda: stop.requested)
    return time.perf_counter() - begin


def _process(job: _Job, stop: _StopRequest) -> DatasetError | None:
    """Process frame after frame, to the end or to a stop request. Returns what broke the recording, if anything."""
    from tqdm import tqdm

    tracked = lost = 0
    length = len(job.sequence)
    with tqdm(range(job.first, length), initial=job.first, total=length, unit='frame', dynamic_ncols=True) as bar:
        for index in bar:
            if stop.requested:
                break
            started_s = time.perf_counter()
            try:
                frame = job.sequence[index]
                decoded_s = time.perf_counter()
                result = job.slam.process(frame)
            except FrameError as error:
                say(f'frame {index} is left out: {error}')
                continue
            except DatasetError as error:
                return error
            job.folder.append(frame, result, time.perf_counter() - decoded_s, decoded_s - started_s)
            job.checkpoints.after_frame(index, frame, job.slam)
            tracked, lost = tracked + (result.T_world_cam is not None), lost + (result.T_world_cam is None)
            bar.set_postfix(tracked=tracked, lost=lost, gaussians=result.num_gaussians, refresh=False)
    return None


COMMANDS = (
    Command('run', 'run SLAM over a recording', _add_run_arguments, run),
    evaluate.COMMAND,
    ablations.COMMAND,
    convert.COMMAND,
    compare.COMMAND,
    render.COMMAND,
    refine.COMMAND,
    export.COMMAND,
    bench.COMMAND,
)


if __name__ == '__main__':
    sys.exit(main())
