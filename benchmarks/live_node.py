"""The node with a live camera: the age of its poses, the frames that it drops, and its CPU and memory use.

    python benchmarks/live_node.py SOURCE [--preset quick] [--width 320] [--rate 30] [--max-frames N] [--runs 1]

The recording is published like a camera's images, at a fixed rate and without waiting for the node, whose ``queue_policy`` is
``latest``. Latency is the time from handing the later of a frame's two images to ROS until the pose is received. Frames
published before the first pose are not counted, because starting a map takes longer than a frame.
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
from live import Arrival, convert, graph, milliseconds
from std_msgs.msg import Header

START_TIMEOUT_S = 60.0
MEASURING_S = 1.0  # duration of one measurement of the CPU load; the result is their mean


@dataclass(frozen=True, slots=True)
class Counts:
    """The frames of one recording played into the node.

    Attributes:
        latency_ms: latency of each pose.
        early: frames dropped between the first processed frame and the first pose.
        published: frames published after the first pose.
        processed: those of them that were tracked or lost.
        tracked: those of them with a pose.
    """

    latency_ms: list[float]
    early: int
    published: int
    processed: int
    tracked: int


@dataclass(frozen=True, slots=True)
class Run:
    """One run of the node.

    Attributes:
        counts: its frames.
        cpu_percent: mean CPU load of the node, in percent of one core.
        rss_mb: resident memory of the node at the end, MiB.
    """

    counts: Counts
    cpu_percent: float
    rss_mb: float


def count(published_ns: dict[int, int], poses: list[Arrival], done: list[Arrival]) -> Counts:
    """Count frames and measure latencies.

    Frames that arrive while the first one starts the map are dropped, and are not counted here.
    """
    first, answers = poses[0], {item.stamp_ns for item in done}
    counted = {stamp_ns: at_ns for stamp_ns, at_ns in published_ns.items() if at_ns > first.received_ns}
    early = [stamp_ns for stamp_ns in published_ns if first.stamp_ns < stamp_ns < min(counted, default=0)]
    answered = [pose for pose in poses if pose.stamp_ns in counted]
    latency_ms = milliseconds([pose.received_ns - counted[pose.stamp_ns] for pose in answered])
    dropped_early = sum(stamp_ns not in answers for stamp_ns in early)
    return Counts(latency_ms, dropped_early, len(counted), len(answers & counted.keys()), len(answered))


def run_once(bag: Path, preset: str, rate_hz: float, folder: Path, parameters: dict[str, str]) -> Run:
    """Publish a recording once.

    Raises:
        SystemExit: no pose arrived.
    """
    with graph(folder) as opened:
        poses = opened.listen('/splatam/pose')
        done = opened.listen('/splatam/processed', Header)
        node = opened.start_node(preset, **parameters)
        camera = opened.start_camera(bag, folder / 'frames', '--rate', str(rate_hz))
        if not opened.spin_until(lambda: poses or not camera.is_running, START_TIMEOUT_S) or not poses:
            sys.exit(f'no pose arrived; the output of the node:\n{node.log.read_text()}')
        loads = []
        while camera.is_running:
            loads.append(opened.cpu_percent(node, MEASURING_S))
        camera.require(0)
        rss_mb = node.rss_mb()
        lines = (line.split() for line in (folder / 'frames').read_text().splitlines())
        counts = count({int(stamp_ns): int(at_ns) for stamp_ns, at_ns in lines}, poses, done)
        return Run(counts, statistics.mean(loads[:-1] or loads), rss_mb)  # the last load extends beyond the last frame


def row(number: int, run: Run) -> str:
    """Returns a line of the table."""
    frames = run.counts
    if not frames.published:
        sys.exit('the recording ended before the first pose: choose a longer one')
    latency = frames.latency_ms or [np.nan]
    dropped = 100 * (1 - frames.processed / frames.published)
    return (
        f'| {number} | {statistics.median(latency):.0f} | {np.percentile(latency, 95):.0f} | {frames.early} | {frames.published} '
        f'| {dropped:.1f} | {frames.processed - frames.tracked} | {run.cpu_percent:.0f} | {run.rss_mb:.0f} |'
    )


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('source', help="a recording, or 'synthetic'")
    parser.add_argument('--preset', default='quick')
    parser.add_argument('--width', type=int, default=320)
    parser.add_argument('--rate', type=float, default=30.0)
    parser.add_argument('--max-frames', type=int)
    parser.add_argument('--runs', type=int, default=1)
    parser.add_argument('-p', dest='parameters', action='append', default=[], metavar='NAME:=VALUE',
                        help='a parameter of the node, in the form that --ros-args takes')  # fmt: skip
    args = parser.parse_args()
    parameters = dict(entry.split(':=', 1) for entry in args.parameters)
    with tempfile.TemporaryDirectory() as scratch:
        convert(args.source, bag := Path(scratch) / 'bag', args.width, args.max_frames)
        runs = [
            run_once(bag, args.preset, args.rate, Path(scratch) / str(i), parameters) for i in range(args.runs)
        ]  # fmt: skip
    name = Path(args.source).name
    print_header(f'{name} live at {args.rate:g} Hz, preset `{args.preset}`, {args.width} pixels wide', args.runs)
    print('| run | latency ms, median | p95 | dropped before the first pose | frames after the first pose | dropped % | lost '
          '| CPU % of a core | RSS MB |')  # fmt: skip
    print('|---|---|---|---|---|---|---|---|---|')
    for number, run in enumerate(runs, 1):
        print(row(number, run))


if __name__ == '__main__':
    main()
