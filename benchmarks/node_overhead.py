"""The latency that the node adds to SLAM: from a camera's stamp to the published pose, with a core that does nothing.

    python benchmarks/node_overhead.py [--seconds 20] [--runs 3] [--width 640]

A camera process stamps and publishes colour, depth and CameraInfo at 30 Hz. Two nodes take turns in answering with a pose:
the SLAM node, whose SLAM does nothing (``null.yaml``), and a minimal node (``echo.py``: same subscriptions, no decoding).
Latency ends when the answer is handed to ROS. Overhead is the difference of the medians.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from header import print_header
from live import HERE, Child, Graph, convert, graph, milliseconds

RATE_HZ = 30.0
WARM_UP_FRAMES = 150  # the first frame starts the map, which takes seconds; discovery may also take a while


@dataclass(frozen=True, slots=True)
class Run:
    """One process under one camera.

    Attributes:
        latency_ms: time from the stamp to the publishing of the answer, for each frame.
        cpu_percent: CPU load, in percent of one core.
        answered: fraction of the frames answered after warming up.
    """

    latency_ms: list[float]
    cpu_percent: float
    answered: float


def measure(opened: Graph, child: Child, topic: str, bag: Path, frames: int) -> Run:
    """Run the camera for some frames and collect the answers.

    Raises:
        SystemExit: no answer arrived, or a process failed.
    """
    log = child.log.with_suffix('.frames')
    arrivals = opened.listen(topic)
    camera = opened.start_camera(bag, log, '--now', '--rate', str(RATE_HZ), '--frames', str(WARM_UP_FRAMES + frames))
    if not opened.spin_until(lambda: arrivals, timeout_s=60):
        sys.exit(f'no answers on {topic}: see {child.log} and {camera.log}')
    opened.spin_for(WARM_UP_FRAMES / RATE_HZ)
    cpu_percent = opened.cpu_percent(child, frames / RATE_HZ - 1)
    opened.spin_until(lambda: not camera.is_running, timeout_s=60)
    camera.require(0)
    child.stop()
    stamps = [int(line.split()[0]) for line in log.read_text().splitlines()][WARM_UP_FRAMES:]
    counted = [arrival for arrival in arrivals if arrival.stamp_ns >= stamps[0]]
    return Run(
        milliseconds([arrival.published_ns - arrival.stamp_ns for arrival in counted]),
        cpu_percent,
        len(counted) / len(stamps),
    )


def run_once(name: str, bag: Path, frames: int, folder: Path) -> Run:
    """Run the SLAM node or the minimal node once, on a graph of its own."""
    with graph(folder) as opened:
        if name == 'node':
            child = opened.start_node(str(HERE / 'null.yaml'))
            return measure(opened, child, '/splatam/pose', bag, frames)
        return measure(opened, opened.start(str(HERE / 'echo.py'), '/echo/pose'), '/echo/pose', bag, frames)


def row(name: str, runs: list[Run]) -> str:
    """Returns a line of the table: medians over the runs, and their spread."""
    medians = [statistics.median(run.latency_ms) for run in runs]
    p95 = statistics.median(float(np.percentile(run.latency_ms, 95)) for run in runs)
    cpu = statistics.median(run.cpu_percent for run in runs)
    answered = 100 * statistics.mean(run.answered for run in runs)
    return (
        f'| {name} | {statistics.median(medians):.2f} ({min(medians):.2f}-{max(medians):.2f}) | {p95:.2f} '
        f'| {cpu:.0f} | {answered:.1f} |'
    )


def main() -> None:
    """Measure in turns and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--seconds', type=float, default=20.0, help='duration of each run after warming up (default: %(default)s)')
    parser.add_argument('--runs', type=int, default=3, help='number of runs of each node (default: %(default)s)')
    parser.add_argument('--width', type=int, default=640)
    args = parser.parse_args()
    frames = round(args.seconds * RATE_HZ)
    with tempfile.TemporaryDirectory() as scratch:
        bag = Path(scratch) / 'bag'
        convert('synthetic', bag, args.width, max_frames=15)
        runs: dict[str, list[Run]] = {'echo': [], 'node': []}
        for turn in range(args.runs):
            for name, done in runs.items():
                done.append(run_once(name, bag, frames, Path(scratch) / f'{name}{turn}'))
    print_header(f'Node overhead, {args.width} pixels wide, {RATE_HZ:g} Hz, {args.seconds:g} s a run', args.runs)
    print('| process | stamp to pose, ms, median (spread) | p95 ms | CPU % of a core | frames answered % |')
    print('|---|---|---|---|---|')
    print(row('minimal node', runs['echo']))
    print(row('node, SLAM does nothing', runs['node']))
    pairs = zip(runs['node'], runs['echo'], strict=True)
    overheads = [statistics.median(node.latency_ms) - statistics.median(echo.latency_ms) for node, echo in pairs]
    print(f'\nMedian overhead {statistics.median(overheads):.2f} ms '
          f'({min(overheads):.2f} to {max(overheads):.2f} over the runs).')  # fmt: skip


if __name__ == '__main__':
    main()
