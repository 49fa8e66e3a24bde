"""Runs tests while processes of theirs are put aside, as an overloaded machine does it.

``python tools/stalled_tests.py test/ros -n 3`` stops a random process of the run for 0.75 to 2.25 s (SIGSTOP, then SIGCONT),
again and again. A test that fails then, and not by itself, depends on time; but a process that the test has stopped meanwhile
may be woken too early, which is rare. ``make test-stalled`` runs all tests. Linux only.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

NUM_AT_ONCE = 3  # processes that may be stopped at the same time
STOPPED_S, RUNNING_S = (0.75, 2.25), (0.15, 1.0)


def descendants(pid: int) -> list[int]:
    """Returns the processes that a process has started, and theirs."""
    found = []
    for path in Path(f'/proc/{pid}/task').glob('*/children'):
        try:
            children = [int(word) for word in path.read_text().split()]
        except (FileNotFoundError, ProcessLookupError):  # the thread has ended
            continue
        for child in children:
            found += [child, *descendants(child)]
    return found


def is_stoppable(pid: int) -> bool:
    """Returns False for a process that a test has stopped itself, or that has ended."""
    try:
        return Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0] not in 'TZX'
    except (FileNotFoundError, ProcessLookupError):
        return False


def stall(run: subprocess.Popen[bytes], rng: random.Random) -> int:
    """Stops processes of a run, one at a time, until it has ended. Returns how many times."""
    num_stalls = 0
    while run.poll() is None:
        stoppable = [pid for pid in descendants(run.pid) if is_stoppable(pid)]
        if stoppable:
            stall_one(rng.choice(stoppable), rng.uniform(*STOPPED_S))
            num_stalls += 1
        time.sleep(rng.uniform(*RUNNING_S))
    return num_stalls


def stall_one(pid: int, seconds: float) -> None:
    """Stops a process for some time."""
    try:
        os.kill(pid, signal.SIGSTOP)
        time.sleep(seconds)
        os.kill(pid, signal.SIGCONT)
    except ProcessLookupError:  # it has ended meanwhile
        pass


def main(arguments: list[str]) -> int:
    """Run pytest with arguments; returns its exit code."""
    run = subprocess.Popen([sys.executable, '-m', 'pytest', *arguments])
    seed = time.time_ns()
    with ThreadPoolExecutor(NUM_AT_ONCE) as executor:
        num_stalls = sum(executor.map(lambda index: stall(run, random.Random(seed + index)), range(NUM_AT_ONCE)))
    print(f'processes were put aside {num_stalls} times, for {sum(STOPPED_S) / 2:g} s on average')
    return run.wait()


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
