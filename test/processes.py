"""Processes under test, whose output goes into a file."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from forked import Forked, can_fork, fork

ROOT = Path(__file__).resolve().parents[1]
TIMEOUT_S = 60.0  # only ever waited out when a test fails; two busy cores make everything slow


class Patience:
    """Counts the time in which a test has looked at what it waits for.

    A test that the scheduler put aside for a second has looked once, and what happened meanwhile is yet to be seen: so
    each look counts no more than ``LOOK_S``.
    """

    LOOK_S = 0.05

    def __init__(self, seconds: float) -> None:
        self._left_s = self._seconds = seconds
        self._looked_s = time.monotonic()

    def restart(self) -> None:
        self._left_s = self._seconds

    @property
    def is_over(self) -> bool:
        """To be asked after each look."""
        now_s = time.monotonic()
        self._left_s -= min(now_s - self._looked_s, self.LOOK_S)
        self._looked_s = now_s
        return self._left_s <= 0


class Process:
    """A process under test; its output goes into a file."""

    def __init__(
        self, arguments: Sequence[str], environment: Mapping[str, str], log: Path, stdin: int = subprocess.DEVNULL
    ) -> None:
        self._log, self._process = log, _started(arguments, environment, log, stdin)

    @property
    def text(self) -> str:
        return self._log.read_text(errors='replace')

    @property
    def lines(self) -> list[str]:
        return self.text.splitlines()

    @property
    def is_running(self) -> bool:
        return self._process.poll() is None

    @property
    def pid(self) -> int:
        return self._process.pid

    def send(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    def wait(self, timeout_s: float = TIMEOUT_S) -> int:
        """Wait for its end; returns the exit code."""
        try:
            return self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise AssertionError(f'still running after {timeout_s} s, and said:\n{self.text}') from None

    def says(self, *parts: str) -> bool:
        """Returns True if one line of the output contains all parts."""
        return any(all(part in line for part in parts) for line in self.lines)

    def wait_says(self, *parts: str, timeout_s: float = TIMEOUT_S) -> None:
        wait_until(lambda: self.says(*parts) or not self.is_running, timeout_s, lambda: self.text)
        assert self.says(*parts), f'not said: {parts}; but:\n{self.text}'

    def end(self, grace_s: float = 3.0) -> None:
        """Asked first: a participant that is killed leaves its shared memory, 35 MB, behind."""
        if self.is_running:
            self.send(signal.SIGTERM)
        try:
            self._process.wait(grace_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _started(arguments: Sequence[str], environment: Mapping[str, str], log: Path, stdin: int) -> subprocess.Popen[bytes] | Forked:
    log.touch()
    if stdin == subprocess.DEVNULL and can_fork(environment):
        return fork(arguments, environment, log)
    command = [sys.executable, *arguments]
    with log.open('ab') as file:
        return subprocess.Popen(command, cwd=ROOT, env=environment, stdin=stdin, stdout=file, stderr=subprocess.STDOUT)


def wait_until(condition: Callable[[], object], timeout_s: float = TIMEOUT_S, explain: Callable[[], str] = lambda: '') -> None:
    patience = Patience(timeout_s)
    while not condition():
        assert not patience.is_over, f'not so within {timeout_s} s. {explain()}'
        time.sleep(0.02)


def run_code(code: str, *words: object, log: Path) -> Process:
    """Start Python code in a process of its own. The words are its arguments."""
    return Process(['-c', textwrap.dedent(code), *map(str, words)], os.environ, log)
