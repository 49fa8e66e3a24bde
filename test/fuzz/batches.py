"""Tries many generated values in a child process, and notices whatever becomes of it."""

from __future__ import annotations

import faulthandler
import json
import mmap
import os
import resource
import signal
import struct
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any

import cv2
import torch
from crossing import Crossing
from hypothesis import HealthCheck, Phase, given, seed, settings
from kinds.base import Case, Kind, Tally

ROOT = Path(__file__).resolve().parents[2]
HANGS_AFTER_S = 120.0  # generous: other programs may run beside
MEMORY_LIMIT = 12 << 30  # bytes of addresses of a child, so that a finding does not end other programs


@dataclass(frozen=True)
class Batch:
    """Values that one generator makes from one seed.

    Attributes:
        kind, case: what the values are.
        seed: of all that is random.
        size: number of values, drawn and crossed ones together.
    """

    kind: Kind
    case: Case
    seed: int
    size: int


@dataclass(frozen=True)
class Finding:
    """Something that must not happen.

    Attributes:
        what: one line; the same for findings of the same sort.
        index: number of the value in its batch.
        detail: the value, and where in the code.
    """

    what: str
    index: int
    detail: str = ''


@dataclass
class Outcome:
    """What became of a batch.

    Attributes:
        values: number of generated values; each may be several inputs.
        inputs, used, refused: as ``Tally`` counts them.
        died: True if the child did not come to its end.
        findings: what must not happen.
    """

    values: int = 0
    inputs: int = 0
    used: int = 0
    refused: int = 0
    died: bool = False
    findings: list[Finding] = field(default_factory=list)


class Board:
    """Numbers that parent and child share: also what a child that died had counted is known."""

    FORM = struct.Struct('<4q')

    def __init__(self) -> None:
        self._memory = mmap.mmap(-1, self.FORM.size)

    def write(self, values: int, tally: Tally) -> None:
        """The child's side."""
        self.FORM.pack_into(self._memory, 0, values, tally.inputs, tally.used, tally.refused)

    def read(self) -> tuple[int, ...]:
        """Returns values, inputs, used, refused."""
        return self.FORM.unpack_from(self._memory, 0)


def values_of(batch: Batch, use: Callable[[Any], None]) -> None:
    """Calls a function, which must not raise, with each value of a batch: the case's examples, then the generated ones.

    Between the values that are drawn, some are crossed from those drawn so far, where the case says so.
    """
    for example in batch.case.examples:
        use(example)
    crossings = batch.case.crossings
    crossing = Crossing(batch.seed)

    @settings(
        max_examples=-(-batch.size // (1 + crossings)), deadline=None, database=None, phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @seed(batch.seed)
    @given(batch.case.strategy)
    def generated(value: Any) -> None:
        use(value)
        if crossings:
            crossing.add(value)
            for _ in range(crossings):
                use(crossing.next_to(value))

    generated()


def run_here(batch: Batch, index: int) -> None:
    """Uses one value of a batch in this process, after it has printed the value."""
    number = iter(range(1 << 62))

    def use(value: Any) -> None:
        if next(number) == index:
            print(f'{value!r}', flush=True)
            tally = Tally()
            batch.case.check(tally, value)
            tally.end_input()
            print(tally)

    values_of(batch, use)


def run_batch(batch: Batch, hangs_after_s: float = HANGS_AFTER_S) -> Outcome:
    """Tries the values of a batch in a child process. A value that takes longer than the limit ends it."""
    torch.set_num_threads(1)  # a process with running threads cannot be copied
    cv2.setNumThreads(1)
    board = Board()
    with tempfile.TemporaryFile('w+') as report, tempfile.TemporaryFile('w+', errors='replace') as said:
        sys.stdout.flush()
        sys.stderr.flush()
        child = os.fork()
        if child == 0:
            _be_child(batch, board, report, said)
        status, is_hanging = _wait(child, board, hangs_after_s)
        values, inputs, used, refused = board.read()
        outcome = Outcome(values, inputs, used, refused)
        report.seek(0)
        outcome.findings += [Finding(**finding) for finding in map(json.loads, report)]
        if is_hanging or status != 0:
            outcome.died = True
            said.seek(0)
            what = f'takes more than {hangs_after_s:g} s' if is_hanging else _death(status)
            outcome.findings.append(Finding(what, values, said.read()[-4000:]))
        return outcome


def _wait(child: int, board: Board, limit_s: float) -> tuple[int, bool]:
    """Waits for the end of a child. Returns its status, and whether it had to be ended."""
    progress, since_s = board.read(), time.monotonic()
    while True:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return status, False
        if board.read() != progress:
            progress, since_s = board.read(), time.monotonic()
        if time.monotonic() - since_s > limit_s:
            os.kill(child, signal.SIGABRT)
            time.sleep(1.0)
            os.kill(child, signal.SIGKILL)
            return os.waitpid(child, 0)[1], True
        time.sleep(0.02)


def _death(status: int) -> str:
    if os.WIFSIGNALED(status):
        return f'ends the process with {signal.Signals(os.WTERMSIG(status)).name}'
    return f'ends the process with exit code {os.WEXITSTATUS(status)}'


def _be_child(batch: Batch, board: Board, report: IO[str], said: IO[str]) -> None:
    """The child: tries every value, writes findings as lines of JSON, and ends the process."""
    code = 1
    try:
        for stream in (1, 2):
            os.dup2(said.fileno(), stream)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent is told
        if not os.environ.get('SPLATAM_NATIVE'):  # sanitizers reserve terabytes
            resource.setrlimit(resource.RLIMIT_AS, (MEMORY_LIMIT, MEMORY_LIMIT))
        faulthandler.enable(said)
        trial = _Trial(batch, board, report)
        values_of(batch, trial.use)
        code = 0
    except BaseException:  # noqa: BLE001 - the parent reports it
        traceback.print_exc(file=said)
    finally:
        said.flush()
        report.flush()
        os._exit(code)


class _Trial:
    """Uses values one by one, and keeps the first finding of each sort."""

    def __init__(self, batch: Batch, board: Board, report: IO[str]) -> None:
        self._batch, self._board, self._report = batch, board, report
        self._tally = Tally()
        self._number = 0
        self._known: set[str] = set()
        self._peak_mb = _peak_mb()

    def use(self, value: Any) -> None:
        """Check a value, and whether it kept the bounds of its kind."""
        start_s = time.process_time()
        try:
            self._batch.case.check(self._tally, value)
        except Exception as error:  # noqa: BLE001 - it is what is searched for
            self._found(_sort(error), value, ''.join(traceback.format_exception(error)[-6:]))
        self._tally.end_input()
        kind = self._batch.kind
        if (took_s := time.process_time() - start_s) > kind.cpu_s:
            self._found(f'takes more than {kind.cpu_s:g} s of the processor', value, f'{took_s:.1f} s')
        peak_mb = _peak_mb()
        is_measured = not os.environ.get('SPLATAM_NATIVE')
        if is_measured and peak_mb > self._peak_mb + kind.memory_mb:
            self._found(f'takes more than {kind.memory_mb} MB', value, f'{peak_mb - self._peak_mb:.0f} MB more')
        self._peak_mb = max(self._peak_mb, peak_mb) if self._number else peak_mb
        self._number += 1
        self._board.write(self._number, self._tally)

    def _found(self, what: str, value: Any, detail: str) -> None:
        if what in self._known:
            return
        self._known.add(what)
        text = repr(value)
        shown = text if len(text) < 1500 else f'{text[:1000]} ... {text[-400:]}'
        self._report.write(json.dumps(asdict(Finding(what, self._number, f'{shown}\n{detail}'))) + '\n')
        self._report.flush()


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _sort(error: Exception) -> str:
    """What an error is, and where in the project it came from: the same for findings of the same sort."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if str(ROOT) in frame.filename]
    own = [frame for frame in frames if '/test/' not in frame.filename] or frames
    where = f'{Path(own[-1].filename).relative_to(ROOT)}:{own[-1].lineno}' if own else 'somewhere'
    text = ' '.join(str(error).split())[:150]
    return f'{type(error).__name__} at {where}' + (f': {text}' if isinstance(error, AssertionError) else '')
