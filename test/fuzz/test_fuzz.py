"""A few inputs of every kind that is fuzzed (``make fuzz`` tries more), and what the fuzzer notices."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass, replace
from pathlib import Path

import kinds
import numpy as np
import pytest
from batches import Batch, Outcome, run_batch, values_of
from crossing import Crossing
from hypothesis import strategies as st
from kinds import KINDS, available
from kinds.base import Case, Kind, Tally
from processes import run_code

from splatam_core.errors import DatasetError

SEED = 14


@pytest.mark.slow
@pytest.mark.parametrize('name', KINDS)
def test_a_few_inputs(name: str, tmp_path: Path) -> None:
    """All generators of a kind in one test, because its material takes time to make."""
    kind = KINDS[name]
    if kind not in available():
        pytest.skip(f'needs {kind.needs}')
    for case in kind.cases(tmp_path):
        tally = Tally()

        def use(value: object, case: Case = case, tally: Tally = tally) -> None:
            try:
                case.check(tally, value)
            except BaseException:
                print(f'{name}, {case.name}: {value!r}')
                raise
            tally.end_input()

        crossings = min(case.crossings, 1)
        values_of(Batch(kind, replace(case, crossings=crossings), SEED, case.short // 2 * (1 + crossings)), use)
        assert tally.inputs >= case.short / 4, case.name


def test_every_kind_is_in_the_table_and_documented() -> None:
    folder = Path(kinds.__file__).parent
    modules = {path.stem for path in folder.glob('*.py') if '\nKIND = Kind(' in path.read_text()}
    assert modules == {name for name, module in vars(kinds).items() if hasattr(module, 'KIND')}
    page = (Path(__file__).resolve().parents[2] / 'docs' / 'fuzzing.md').read_text()
    assert [name for name in KINDS if f'| {name} | ' not in page] == []


# --- the fuzzer itself ---


def fuzz(check, hangs_after_s: float = 60.0, **bounds) -> Outcome:
    """Tries the numbers 0 to 20, in some order, some of them repeatedly."""
    case = Case('numbers', st.integers(0, 20), check)
    return run_batch(Batch(Kind('numbers', 1, lambda folder: [case], **bounds), case, SEED, 40), hangs_after_s)


@pytest.mark.slow
def test_an_input_repeats_whatever_was_tried_before_it(tmp_path: Path) -> None:
    """Hypothesis draws from the constants in the modules that are loaded: an input used to repeat only after the same kinds."""
    code = """
        import sys
        sys.path[:0] = ['test/fuzz', 'test']
        import run
        modules, sys.argv = sys.argv[1], ['run.py', *sys.argv[2:]]
        for module in filter(None, modules.split(',')):
            __import__(module)
        run.main()
    """
    words = '--kind', 'messages', '--case', 'images to send', '--seed', 5, '--index', 61, '--inputs', 100
    tried = [
        run_code(code, modules, *words, log=tmp_path / str(number))
        for number, modules in enumerate(['', 'splatam_core.evaluation.report.html,splatam_core.commands.bench'])
    ]
    assert [process.wait() for process in tried] == [0, 0], [process.text for process in tried]
    first, second = (process.text for process in tried)
    assert first == second and 'Tally(inputs=1' in first


def test_what_is_used_and_refused_is_counted() -> None:
    def refuse_odd(number: int) -> int:
        if number % 2:
            raise DatasetError(f'{number} is odd')
        return number

    outcome = fuzz(lambda tally, number: tally.attempt(lambda: refuse_odd(number)))
    assert not outcome.findings and outcome.values == outcome.inputs == outcome.used + outcome.refused
    assert outcome.used > 5 and outcome.refused > 5


@pytest.mark.parametrize('error', [KeyError('x'), MemoryError(), DatasetError(''), AssertionError('not finite')])
def test_an_error_that_is_not_clean_is_a_finding_and_the_batch_goes_on(error: Exception) -> None:
    def check(tally: Tally, number: int) -> None:
        if number == 7:
            tally.attempt(lambda: (_ for _ in ()).throw(error))

    outcome = fuzz(check)
    assert len(outcome.findings) == 1 and outcome.values >= 20 and not outcome.died
    assert outcome.findings[0].detail.startswith('7\n')


@pytest.mark.parametrize('end', [signal.SIGSEGV, signal.SIGABRT, None])
def test_a_crash_is_a_finding(end: signal.Signals | None) -> None:
    def check(tally: Tally, number: int) -> None:
        tally.attempt(lambda: number)
        if number == 7:
            os.kill(os.getpid(), end) if end else os._exit(3)

    outcome = fuzz(check)
    assert outcome.died and [finding.what for finding in outcome.findings] == [
        f'ends the process with {end.name if end else "exit code 3"}'
    ]
    assert outcome.values == outcome.inputs == outcome.findings[0].index  # what was tried before is counted


def test_what_never_ends_is_a_finding() -> None:
    outcome = fuzz(lambda tally, number: time.sleep(1000 * (number == 7)), hangs_after_s=0.5)
    assert outcome.died and outcome.findings[0].what == 'takes more than 0.5 s'


def test_time_and_memory_beyond_the_bounds_are_findings() -> None:
    def check(tally: Tally, number: int) -> None:
        if number == 7:
            np.ones(20 << 20)
        elif number == 9:
            end_s = time.process_time() + 0.2
            while time.process_time() < end_s:
                pass

    found = {finding.what for finding in fuzz(check, memory_mb=100, cpu_s=0.1).findings}
    assert 'takes more than 0.1 s of the processor' in found and 'takes more than 100 MB' in found


def test_a_seed_gives_the_same_values_again() -> None:
    def values() -> list[int]:
        found: list[int] = []
        case = Case('numbers', st.integers(0, 10**9), lambda tally, number: None, examples=(3,), crossings=2)
        values_of(Batch(Kind('numbers', 1, lambda folder: [case]), case, SEED, 30), found.append)
        return found

    assert values() == values() and values()[0] == 3


@dataclass(frozen=True)
class Parts:
    """A value of several parts."""

    seed: int
    word: str
    pair: tuple[int, int]
    some: list[int]


def test_crossed_values_are_made_of_the_parts_of_drawn_ones() -> None:
    crossing = Crossing(SEED)
    drawn = [Parts(number, f'word {number}', (number, -number), [number] * (2 + number)) for number in range(5)]
    for value in drawn:
        crossing.add(value)
    crossed = [crossing.next_to(value) for value in drawn * 20]
    assert {value.word for value in crossed} == {value.word for value in drawn}
    assert {sum(value.pair) for value in crossed} > {0}  # parts of two
    assert all(2 <= len(value.some) <= 6 for value in crossed)
    assert len({value.seed for value in crossed}) == len(crossed)


def test_crossed_texts_are_joined_of_two() -> None:
    crossing = Crossing(SEED)
    for value in (b'aaaa', b'bbbbbb'):
        crossing.add(value)
    crossed = {crossing.next_to(b'aaaa') for _ in range(50)}
    assert len(crossed) > 5 and all(4 <= len(value) <= 6 for value in crossed)
