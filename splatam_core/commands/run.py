"""``splatam run``: SLAM over a recording, from its beginning or from a checkpoint."""

from __future__ import annotations

import argparse
import signal
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType, TracebackType
from typing import TYPE_CHECKING

from splatam_core.commands.evaluate import print_summary, score_own_run
from splatam_core.commands.frame_notes import FrameNotes
from splatam_core.commands.shared import (
    EXIT_INTERRUPTED,
    Command,
    add_device_argument,
    add_preset_arguments,
    add_source_arguments,
    at_width,
    open_source,
    positive,
    say,
    source_of,
    usable_ground_truth,
)
from splatam_core.errors import FrameError, RunFolderError, SplatamError
from splatam_core.interruption import STOP_SIGNALS, on_stop_signals

if TYPE_CHECKING:
    from splatam_core.config import SlamConfig
    from splatam_core.datasets.base import Sequence as FrameSequence
    from splatam_core.geometry.trajectory import Trajectory
    from splatam_core.runs.metrics import Metrics
    from splatam_core.runs.resume import CheckpointWriter
    from splatam_core.runs.writer import RunFolder
    from splatam_core.slam import Slam


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_source_arguments(parser, nargs='?')
    add_preset_arguments(parser)
    add_device_argument(parser, 'device to compute on; same as --set device=D, and allowed with --resume')
    parser.add_argument('--out', type=Path, metavar='DIR', help='folder for the results')
    parser.add_argument('--overwrite', action='store_true', help='replace the run in DIR')
    parser.add_argument(
        '--holdout', type=positive, metavar='N',
        help='track every n-th frame but keep it out of the map, and score it apart; same as --set mapping.hold_out=N',
    )  # fmt: skip
    parser.add_argument(
        '--checkpoint-every', type=positive, metavar='N', help='save a checkpoint after every n-th frame, for --resume'
    )
    parser.add_argument('--keep-checkpoints', type=positive, metavar='K', help='keep the last K checkpoints only (default: 2)')
    parser.add_argument(
        '--resume', type=Path, metavar='DIR',
        help='continue the run in DIR from its last checkpoint; the result is that of an uninterrupted run',
    )  # fmt: skip
    parser.add_argument('--no-evaluate', action='store_true', help='skip the scores of trajectory and images, and the report')
    parser.set_defaults(parser=parser)


def run(args: argparse.Namespace) -> int:
    """Runs SLAM over a recording, and scores the run. Returns the exit code."""
    from splatam_core.runs.record import read_run

    job = _begin(args) if args.resume is None else _resume(args)
    path = job.folder.path
    outcome = _process_and_save(job)
    if outcome.failure is not None:
        say(f'the results up to the error are in {path}{_resume_hint(path)}')
        raise outcome.failure
    if outcome.stopped:
        say(f'stopped {outcome.stopped}; the results so far are in {path}{_resume_hint(path)}')
        say(f"'splatam evaluate {path}' scores them")
        return EXIT_INTERRUPTED
    metrics = outcome.metrics
    if metrics.frames == 0:
        raise RunFolderError(f'{job.sequence.name}: none of its {len(job.sequence)} frames could be used; see above')
    if metrics.num_gaussians == 0:
        say(
            f'nothing was mapped, all {metrics.frames} frames are lost, the last one because {job.notes.last_reason}; are the unit '
            'of depth (depth_scale in a camera.yaml), depth.min_m and depth.max_m right?'
        )
    if not args.no_evaluate:
        metrics = score_own_run(read_run(path), job.ground_truth, job.sequence)
    print_summary(metrics, path, left_out=len(job.sequence) - metrics.frames)
    return 0


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """A run that is ready to begin or to continue.

    Attributes:
        sequence: the recording.
        first: index of the first frame to process.
        slam: its state before that frame.
        folder: holds the frames before that frame.
        checkpoints: saves checkpoints.
        ground_truth: the true poses, to score the run; None if they are unknown.
        notes: say why frames are skipped or lost.
    """

    sequence: FrameSequence
    first: int
    slam: Slam
    folder: RunFolder
    checkpoints: CheckpointWriter
    ground_truth: Trajectory | None
    notes: FrameNotes = field(default_factory=FrameNotes)


@dataclass(frozen=True, slots=True, eq=False)
class _Outcome:
    """How processing ended.

    Attributes:
        metrics: of the frames that were processed.
        failure: the error that ended it; None if there was none.
        stopped: where Ctrl-C ended it, for the user; empty if it did not.
    """

    metrics: Metrics
    failure: SplatamError | None
    stopped: str


def _begin(args: argparse.Namespace) -> _Job:
    from splatam_core.config import apply_threads
    from splatam_core.runs.record import KEEP_CHECKPOINTS, RunDescription
    from splatam_core.runs.resume import CheckpointWriter, prepare
    from splatam_core.runs.writer import RunFolder

    if args.source is None or args.out is None:
        args.parser.error('give SOURCE and --out DIR to begin a run, or --resume DIR to continue one')
    config = _config(args)
    apply_threads(config)
    source = at_width(source_of(args), config)
    sequence, slam = prepare(open_source(source), config)
    truth = _checked_ground_truth(sequence, args)
    _say_backend(slam)
    every, keep = args.checkpoint_every, args.keep_checkpoints or KEEP_CHECKPOINTS
    description = RunDescription('splatam run', args.preset, source, every, keep)
    folder = RunFolder.create(args.out, config, description, overwrite=args.overwrite)
    return _Job(sequence, 0, slam, folder, CheckpointWriter(folder, len(sequence), every, keep, say), truth)


def _config(args: argparse.Namespace) -> SlamConfig:
    from splatam_core.config import load_config

    given = {'mapping.hold_out': args.holdout, 'device': args.device}
    return load_config(args.preset, [*args.set, *(f'{name}={value}' for name, value in given.items() if value)])


def _resume(args: argparse.Namespace) -> _Job:
    from splatam_core.config import apply_threads
    from splatam_core.runs.resume import CheckpointWriter, resume

    _check_nothing_else_is_given(args)
    run = resume(args.resume, open_source, apply_threads, say, args.device)
    _say_backend(run.slam)
    description = run.settings.description
    every = args.checkpoint_every or description.checkpoint_every
    keep = args.keep_checkpoints or description.keep_checkpoints
    say(f'continuing {args.resume} at frame {run.first} of {len(run.sequence)}')
    writer = CheckpointWriter(run.folder, len(run.sequence), every, keep, say)
    return _Job(run.sequence, run.first, run.slam, run.folder, writer, _checked_ground_truth(run.sequence, args))


def _checked_ground_truth(sequence: FrameSequence, args: argparse.Namespace) -> Trajectory | None:
    """Returns the true poses, read before the run begins, so that a fault in them is said before it and costs no time."""
    truth = None if args.no_evaluate else usable_ground_truth(sequence)
    if truth is None:
        return None
    stamps_ns = [stamp_ns for order in (1, -1) if (stamp_ns := _first_stamp_ns(sequence, order)) is not None]
    begin_ns, end_ns = int(truth.stamps_ns[0]), int(truth.stamps_ns[-1])
    if not stamps_ns or (begin_ns <= stamps_ns[-1] and stamps_ns[0] <= end_ns):
        return truth
    say(
        f'the ground truth is not used: the frames span {_span(stamps_ns[0], stamps_ns[-1])}, the ground truth '
        f'{_span(begin_ns, end_ns)}; are they of the same recording and clock?'
    )
    return None


def _first_stamp_ns(sequence: FrameSequence, order: int) -> int | None:
    """Returns the stamp of the first frame that can be read; None if none of ten can. order: 1, or -1 to begin at the end."""
    for index in range(len(sequence))[::order][:10]:
        try:
            return sequence[index].stamp_ns
        except FrameError:
            continue
        except SplatamError:  # processing stops there, and says so
            return None
    return None


def _span(first_ns: int, last_ns: int) -> str:
    from splatam_core.geometry.trajectory import stamp_text

    return f'{stamp_text(first_ns)} to {stamp_text(last_ns)} s'


def _say_backend(slam: Slam) -> None:
    if slam.backend.why:
        say(str(slam.backend))


def _check_nothing_else_is_given(args: argparse.Namespace) -> None:
    """Checks that no argument contradicts the settings of the run to resume."""
    allowed = {'resume', 'run', 'parser', 'checkpoint_every', 'keep_checkpoints', 'no_evaluate', 'device'}
    given = [name for name, value in vars(args).items() if name not in allowed and value != args.parser.get_default(name)]
    if given:
        names = ', '.join('SOURCE' if name == 'source' else '--' + name.replace('_', '-') for name in given)
        raise SplatamError(f'--resume takes source and settings from the folder: leave out {names}')


def _resume_hint(path: Path) -> str:
    from splatam_core.runs.checkpoints import checkpoint_paths
    from splatam_core.runs.layout import CHECKPOINTS

    return f"; 'splatam run --resume {path}' continues" if checkpoint_paths(path / CHECKPOINTS) else ''


class _StopRequest:
    """Turns a signal to stop into a request to stop after the frame or step at hand; the next Ctrl-C or SIGTERM interrupts at once.

    Attributes:
        requested: True once one of ``STOP_SIGNALS`` arrived.
        when: when the run will stop, for the user.
    """

    def __init__(self) -> None:
        self.requested = False
        self.when = 'after this frame'

    def __enter__(self) -> _StopRequest:
        self._handling = on_stop_signals(self._request)
        self._handling.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self._handling.__exit__(kind, error, traceback)

    def _request(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
        for each in STOP_SIGNALS[:2]:  # a terminal that ends may say so twice
            signal.signal(each, signal.default_int_handler)
        say(f'stopping {self.when}; Ctrl-C again stops at once, without saving the map')


def _process_and_save(job: _Job) -> _Outcome:
    """Processes the frames, and saves map and metrics, also after an error or Ctrl-C.

    Raises:
        RunFolderError: the folder cannot be written.
    """
    from splatam_core.runs.layout import why_not

    path, length = job.folder.path, len(job.sequence)
    try:
        with job.folder, _StopRequest() as stop:
            failure = _process(job, stop)
            job.notes.say_how_many_more()
            is_whole = failure is None and not stop.requested
            if not is_whole:
                job.checkpoints.at_stop(job.slam)
            finish_s = _finish(job, stop) if is_whole else 0.0
            metrics = job.folder.finish(job.slam, finish_s)
    except OSError as error:
        raise RunFolderError(f'{path}: cannot be written: {why_not(error)}; free some space{_resume_hint(path)}') from None
    where = 'during the final passes over the keyframes' if is_whole else f'after {metrics.frames} of {length} frames'
    return _Outcome(metrics, failure, where if stop.requested else '')


def _process(job: _Job, stop: _StopRequest) -> SplatamError | None:
    """Processes frame after frame, to the end or to a stop request. Returns the error that ended the recording, if any."""
    from tqdm import tqdm

    from splatam_core.types import Status

    counts = dict.fromkeys(('tracked', 'uncertain', 'lost'), 0)
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
                job.notes.skipped(index, str(error))
                continue
            except SplatamError as error:  # the recording ends here, or a view is too large: what was mapped is saved
                return error
            job.folder.append(frame, result, time.perf_counter() - decoded_s, decoded_s - started_s)
            job.checkpoints.after_frame(index, frame, job.slam)
            if result.status is Status.LOST:
                job.notes.lost(index, result.reason)
            counts['tracked' if result.status.is_trusted else result.status.value] += 1
            bar.set_postfix(counts | {'gaussians': result.num_gaussians}, refresh=False)
    return None


def _finish(job: _Job, stop: _StopRequest) -> float:
    """Makes the final passes over the keyframes, if the settings ask for them. Returns the wall time, seconds."""
    stop.when = 'after this step of the final passes'
    if job.slam.config.mapping.fused.final_passes:
        say('all frames are processed; now the final passes over the keyframes (mapping.fused.final_passes)')
    begin_s = time.perf_counter()
    job.slam.finish(stop=lambda: stop.requested)
    return time.perf_counter() - begin_s


COMMAND = Command('run', 'run SLAM over a recording', _add_arguments, run)
