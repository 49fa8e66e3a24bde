"""What every benchmark prints first: without it a number means nothing."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable

import numpy as np

from splatam_core.runs import provenance

CALIBRATION_RUNS = 7


def timed_ms(function: Callable[[], object], runs: int) -> list[float]:
    """Wall times of a few runs after one that does not count, milliseconds."""
    function()
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        function()
        times.append(1e3 * (time.perf_counter() - start))
    return times


def calibration_ms() -> float:
    """Median time of a fixed piece of work on one core: how fast this machine is right now."""
    values = np.linspace(0.1, 1.0, 1_000_000, dtype=np.float32)

    def work() -> None:
        for _ in range(5):
            np.exp(np.sqrt(values) * values)

    return statistics.median(timed_ms(work, CALIBRATION_RUNS))


def print_header(title: str, runs: int) -> None:
    """Commit, machine, calibration and number of runs, as Markdown."""
    machine = provenance.machine()
    print(f'### {title}\n')
    print(
        f'Commit `{(provenance.commit() or "unknown")[:18]}`; {machine["processor"]}, {machine["cores"]} cores, '
        f'{machine["memory_mb"] // 1024} GB; {", ".join(f"{k} {v}" for k, v in provenance.versions().items())}; '
        f'calibration kernel {calibration_ms():.1f} ms; runs: {runs}.\n',
        flush=True,
    )
