"""The header that every benchmark prints: commit, machine and speed, without which a number means nothing."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import numpy as np

from splatam_core.runs import provenance

CALIBRATION_RUNS = 7


def timed_ms(function: Callable[[], object], runs: int) -> list[float]:
    """Returns the wall times of several runs after one warm-up run, in milliseconds."""
    function()
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        function()
        times.append(1e3 * (time.perf_counter() - start))
    return times


def calibration_ms() -> float:
    """Returns the median time of a fixed computation on one core, a measure of the machine's current speed."""
    values = np.linspace(0.1, 1.0, 1_000_000, dtype=np.float32)

    def work() -> None:
        for _ in range(5):
            np.exp(np.sqrt(values) * values)

    return statistics.median(timed_ms(work, CALIBRATION_RUNS))


def print_header(title: str, runs: int) -> None:
    """Print commit, machine, calibration time and number of runs as Markdown."""
    machine = provenance.machine()
    memory_mb = machine['memory_mb']
    memory = f'{memory_mb // 1024} GB' if isinstance(memory_mb, int) else 'unknown memory'
    print(f'### {title}\n')
    print(
        f'Commit `{(provenance.commit() or "unknown")[:18]}`; {machine["processor"]}, {machine["cores"]} cores, '
        f'{memory}; {", ".join(f"{k} {v}" for k, v in provenance.versions().items())}; '
        f'calibration kernel {calibration_ms():.1f} ms; runs: {runs}.\n',
        flush=True,
    )
