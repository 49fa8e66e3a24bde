"""Fuzzes: gives every kind of input to the code, and prints how many were used, how many refused cleanly, and what was found.

``make fuzz`` tries every kind for ten minutes in all, ``make fuzz-long`` until each has had its number of inputs. Inputs are tried
in child processes, so that a crash of native code, an endless loop or a full memory is a finding like any other::

    python test/fuzz/run.py --kind messages --minutes 1
    python test/fuzz/run.py --kind messages --case images --seed 7 --index 31   # one input of a finding, here and now

A finding is printed with the command that repeats it.
"""

from __future__ import annotations

import argparse
import faulthandler
import importlib
import json
import os
import pkgutil
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT / 'test'), str(ROOT)]
sys.dont_write_bytecode = True

from other_native import use_other_native_build  # noqa: E402

use_other_native_build()  # before anything imports it

from batches import Batch, Outcome, run_batch, run_here, values_of  # noqa: E402
from kinds import KINDS, available  # noqa: E402
from kinds.base import Case, Kind  # noqa: E402

PACKAGES = ('msg_adapters', 'splatam_core', 'splatam_ros')
FIRST_BATCH, BATCH_S = 30, 20.0
"""Values in the first batch of a case, and about how long the later ones take."""


@dataclass
class Count:
    """What became of the inputs of a kind.

    Attributes:
        inputs: number of inputs.
        used: those of which something was used.
        refused: those that the project's own errors refused.
        findings: a line for each.
        commits: under which they were counted.
        seconds: time that they took.
    """

    inputs: int = 0
    used: int = 0
    refused: int = 0
    findings: list[str] = field(default_factory=list)
    commits: list[str] = field(default_factory=list)
    seconds: float = 0.0

    def add(self, outcome: Outcome, seconds: float) -> None:
        """Add the outcome of a batch."""
        self.inputs += outcome.inputs
        self.used += outcome.used
        self.refused += outcome.refused
        self.seconds += seconds


@dataclass
class Fuzzer:
    """Runs the batches of one kind.

    Attributes:
        kind: the kind.
        count: what became of its inputs.
        seed: of the next batch.
    """

    kind: Kind
    count: Count
    seed: int
    _folder: tempfile.TemporaryDirectory[str] | None = None
    _cases: list[Case] = field(default_factory=list)
    _speeds: dict[str, float] = field(default_factory=dict)  # values per second
    _turn: int = 0
    _known: set[str] = field(default_factory=set)

    def prepare(self) -> None:
        """Make the material of the cases."""
        if self._folder is not None:
            self._folder.cleanup()
        self._folder = tempfile.TemporaryDirectory(prefix='fuzz_')
        self._cases = self.kind.cases(Path(self._folder.name))
        for case in self._cases:  # what generators look up once is then known to every child
            values_of(Batch(self.kind, case, 0, 2), lambda value: None)

    def only(self, case: str) -> None:
        """Keep one case."""
        self._cases = [known for known in self._cases if known.name == case]
        if not self._cases:
            raise SystemExit(f"{self.kind.name} has no case '{case}'")

    @property
    def case(self) -> Case:
        """The case whose turn it is."""
        return self._cases[self._turn % len(self._cases)]

    def step(self, at_most_s: float, at_most_inputs: float = float('inf')) -> None:
        """Run one batch of the next case."""
        if not self._cases:
            self.prepare()
        case, limit_s = self.case, min(BATCH_S, at_most_s)
        speed = self._speeds.get(case.name)
        size = FIRST_BATCH if speed is None else max(1, min(int(speed * limit_s), 4000))
        batch = Batch(self.kind, case, self.seed, int(max(1, min(size, at_most_inputs))))
        start_s = time.monotonic()
        outcome = run_batch(batch)
        took_s = time.monotonic() - start_s
        self.count.add(outcome, took_s)
        self._speeds[case.name] = max(outcome.values, 1) / max(took_s, 0.01)
        self._report(batch, outcome)
        if outcome.died:
            self.prepare()  # files may be left damaged
        self._turn += 1
        self.seed += 1

    def _report(self, batch: Batch, outcome: Outcome) -> None:
        for finding in outcome.findings:
            if finding.what not in self._known:  # the first of each sort
                self._known.add(finding.what)
                name = f'{batch.kind.name}, {batch.case.name}'
                command = f"--kind '{batch.kind.name}' --case '{batch.case.name}' --seed {batch.seed} --index {finding.index}"
                line = f'{name}: {finding.what}\n    repeat: python test/fuzz/run.py {command} --inputs {batch.size}'
                self.count.findings.append(line)
                print(line + (f'\n{finding.detail}' if finding.detail else ''), flush=True)

    def close(self) -> None:
        """Remove the material."""
        if self._folder is not None:
            self._folder.cleanup()


def fuzz_for(fuzzers: list[Fuzzer], minutes: float, save: Path | None) -> None:
    """Give each kind the same share of the time, a batch at a time."""
    begin_s = time.monotonic()
    batch_s = 60 * minutes / (8 * len(fuzzers))
    while (left_s := begin_s + 60 * minutes - time.monotonic()) > 0:
        min(fuzzers, key=lambda fuzzer: fuzzer.count.seconds).step(min(batch_s, max(left_s, 1.0)))
        save_counts(save, fuzzers)


def fuzz_to_the_goals(fuzzers: list[Fuzzer], minutes: float, save: Path | None) -> None:
    """Give each kind its number of inputs, always that which is farthest from it, until the time is over."""
    end_s = time.monotonic() + 60 * minutes
    while (left_s := end_s - time.monotonic()) > 0:
        fuzzer = min(fuzzers, key=lambda fuzzer: fuzzer.count.inputs / fuzzer.kind.long)
        if (left := fuzzer.kind.long - fuzzer.count.inputs) <= 0:
            break
        fuzzer.step(max(left_s, 1.0), left)
        save_counts(save, fuzzers)


def import_everything() -> None:
    """Load all modules of the project: Hypothesis draws from the constants in those that are loaded, and inputs must repeat."""
    for name in PACKAGES:
        with suppress(ImportError):
            for module in pkgutil.walk_packages(importlib.import_module(name).__path__, f'{name}.'):
                with suppress(ImportError):  # of what is optional
                    importlib.import_module(module.name)


def commit() -> str:
    """The commit of the checkout, with a mark if files differ from it."""
    described = subprocess.run(
        ['git', 'describe', '--always', '--dirty', '--abbrev=7'], cwd=ROOT, capture_output=True, text=True, check=False
    )
    return described.stdout.strip() or 'unknown'


def machine() -> str:
    """The processor, and whether the native code is the one with sanitizers."""
    names = [line for line in Path('/proc/cpuinfo').read_text().splitlines() if line.startswith('model name')]
    name = names[0].partition(':')[2].strip() if names else platform.machine()
    other = '; native code under the address and undefined-behaviour sanitizers' if os.environ.get('SPLATAM_NATIVE') else ''
    return f'{name}, {os.cpu_count()} processors, Python {platform.python_version()}{other}'


def table(fuzzers: list[Fuzzer]) -> str:
    """The counts by kind, in Markdown."""
    lines = ['| kind | inputs | used | refused cleanly | findings | inputs/s | commit |', '|---|---|---|---|---|---|---|']
    for fuzzer in fuzzers:
        count = fuzzer.count
        rate = count.inputs / count.seconds if count.seconds else 0.0
        lines.append(
            f'| {fuzzer.kind.name} | {count.inputs:,} | {count.used:,} | {count.refused:,} | {len(count.findings)} | {rate:,.0f} '
            f'| {", ".join(count.commits)} |'
        )
    return '\n'.join([*lines, '', f'{machine()}.'])


def goals_table(paths: Iterable[Path]) -> str:
    """The counts in files beside the goals, in Markdown, as in docs/fuzzing.md. Of a kind in several files, the largest count."""
    counts: dict[str, Count] = {}
    for path in paths:
        for name, saved in json.loads(path.read_text()).items():
            count = Count(**saved['count'])
            counts[name] = max(count, counts.get(name, count), key=lambda each: each.inputs)
    lines = ['| kind | goal | inputs so far | used | refused cleanly | findings |', '|---|---|---|---|---|---|']
    for name, kind in KINDS.items():
        count = counts.get(name, Count())
        lines.append(f'| {name} | {kind.long:,} | {count.inputs:,} | {count.used:,} | {count.refused:,} | {len(count.findings)} |')
    commits = sorted({commit for count in counts.values() for commit in count.commits})
    hours = sum(count.seconds for count in counts.values()) / 3600
    return '\n'.join([*lines, '', f'{hours:.1f} hours; commits {", ".join(commits)}. {machine()}.'])


def save_counts(path: Path | None, fuzzers: list[Fuzzer]) -> None:
    """Write the counts and the next seeds, from which ``read_counts`` continues, if there is a path."""
    if path is None:
        return
    before = json.loads(path.read_text()) if path.exists() else {}
    before |= {fuzzer.kind.name: {'count': asdict(fuzzer.count), 'seed': fuzzer.seed} for fuzzer in fuzzers}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(before, indent=1))


def read_counts(path: Path | None, kind: Kind, seed: int) -> Fuzzer:
    """Returns a fuzzer that continues from the saved counts, if there are some."""
    saved = json.loads(path.read_text()).get(kind.name) if path is not None and path.exists() else None
    fuzzer = Fuzzer(kind, Count(**saved['count']), saved['seed']) if saved else Fuzzer(kind, Count(), seed)
    if commit() not in fuzzer.count.commits:
        fuzzer.count.commits.append(commit())
    return fuzzer


def arguments() -> argparse.Namespace:
    """The options."""
    parser = argparse.ArgumentParser(description=(__doc__ or '').partition('\n')[0])
    parser.add_argument('--kind', action='append', choices=list(KINDS), help='fuzz this kind only; may be given repeatedly')
    parser.add_argument('--except', dest='leave_out', action='append', default=[], choices=list(KINDS), help='leave out this kind')
    parser.add_argument('--case', help='only this generator of the first kind')
    parser.add_argument('--minutes', type=float, default=10.0, help='stop after this long [min]; default 10')
    parser.add_argument('--long', action='store_true', help='stop when each kind has had its number of inputs')
    parser.add_argument('--counts', type=Path, help='continue from the counts in this file, and save them there')
    parser.add_argument(
        '--table', type=Path, nargs='+', metavar='FILE', help='print the counts in these files beside the goals, and end'
    )
    parser.add_argument('--seed', type=int, help='of the first batch; default: from the time, so that every run tries others')
    parser.add_argument('--inputs', type=int, default=4000, help='with --index: size of the batch of the finding')
    parser.add_argument('--index', type=int, help='try this value of the batch only, in this process')
    return parser.parse_args()


def main() -> int:
    """Returns 1 if there is a finding."""
    given = arguments()
    if given.table:
        print(goals_table(given.table))
        return 0
    import_everything()
    kinds = [KINDS[name] for name in given.kind or KINDS if name not in given.leave_out]
    for missing in [kind for kind in kinds if kind not in available()]:
        print(f'{missing.name}: left out, because {missing.needs} is not installed')
        kinds.remove(missing)
    seed = int(time.time()) * 1000 if given.seed is None else given.seed
    fuzzers = [read_counts(given.counts, kind, seed) for kind in kinds]
    if given.case:
        fuzzers[0].prepare()
        fuzzers[0].only(given.case)
    if given.index is not None:
        faulthandler.enable()
        run_here(Batch(kinds[0], fuzzers[0].case, seed, given.inputs), given.index)
        return 0
    print(f'fuzz: {", ".join(kind.name for kind in kinds)}; first seed {seed}', flush=True)
    try:
        (fuzz_to_the_goals if given.long else fuzz_for)(fuzzers, given.minutes, given.counts)
    except KeyboardInterrupt:
        print('stopped')
    for fuzzer in fuzzers:
        fuzzer.close()
    print(table(fuzzers))
    return 1 if any(fuzzer.count.findings for fuzzer in fuzzers) else 0


if __name__ == '__main__':
    sys.exit(main())
