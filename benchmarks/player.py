"""The player's timing: how punctual its messages are at rate 1, and how fast a node that does nothing can take them.

    python benchmarks/player.py [SOURCE] [--seconds 20] [--width 640] [--runs 3]

A recording of colour, depth and CameraInfo at 30 Hz is played at rate 1. The difference between a message's publishing time
(the wall time that DDS records) and its recorded time should be constant; the deviation is measured from the median of all
messages. Then the recording is played with ``--rate max --wait-for`` into the node whose SLAM does nothing (``null.yaml``).
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from header import print_header
from live import HERE, Arrival, Graph, convert, graph
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from splatam_core.datasets.bag.topics import DEPTH_TOPIC, INFO_TOPIC, RGB_TOPIC

RATE_HZ = 30.0
TOPICS = ((RGB_TOPIC, Image), (DEPTH_TOPIC, Image), (INFO_TOPIC, CameraInfo))
START_TIMEOUT_S = 60.0


@dataclass(frozen=True, slots=True)
class Timing:
    """Playback at rate 1.

    Attributes:
        deviation_ms: how far the publishing time of each message is off.
        lost: messages that were played but did not arrive.
    """

    deviation_ms: list[float]
    lost: int


def deviations_ms(arrivals: list[Arrival]) -> list[float]:
    """Returns each message's deviation from the median offset between publishing and recorded time."""
    offsets_ns = np.array([arrival.published_ns - arrival.stamp_ns for arrival in arrivals], dtype=np.int64)
    return (np.abs(offsets_ns - np.int64(np.median(offsets_ns))) / 1e6).tolist()


def rate_one(opened: Graph, bag: Path, frames: int) -> Timing:
    """Play once at the speed of the recording."""
    received = {topic: opened.listen(topic, message_class) for topic, message_class in TOPICS}
    player = opened.start_player(bag, '--rate', '1', '--topics', *received)
    opened.spin_until(lambda: not player.is_running, START_TIMEOUT_S + frames / RATE_HZ)
    player.require(0)
    opened.spin_for(0.5)
    everything = [arrival for arrivals in received.values() for arrival in arrivals]
    return Timing(deviations_ms(everything), len(TOPICS) * frames - len(everything))


def as_fast_as_the_node_can(opened: Graph, bag: Path, frames: int) -> tuple[float, int]:
    """Play as fast as the node takes frames. Returns frames per second and the number of lost frames."""
    done = opened.listen('/splatam/processed', Header)
    opened.start_node(str(HERE / 'null.yaml'), queue_policy='all')
    player = opened.start_player(bag, '--rate', 'max', '--wait-for')
    opened.spin_until(lambda: done, START_TIMEOUT_S)
    started_s = time.monotonic()
    opened.spin_until(lambda: not player.is_running, START_TIMEOUT_S + frames)
    seconds = time.monotonic() - started_s
    player.require(0)
    return (frames - 1) / seconds, frames - len(done)


def main() -> None:
    """Play and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('source', nargs='?', default='synthetic')
    parser.add_argument('--seconds', type=float, default=20.0, help='length of the recording (default: %(default)s)')
    parser.add_argument('--width', type=int, default=640)
    parser.add_argument('--runs', type=int, default=3)
    args = parser.parse_args()
    frames = round(args.seconds * RATE_HZ)
    with tempfile.TemporaryDirectory() as scratch:
        convert(args.source, bag := Path(scratch) / 'bag', args.width, frames)
        timings, speeds = [], []
        for run in range(args.runs):
            with graph(Path(scratch) / f'one{run}') as opened:
                timings.append(rate_one(opened, bag, frames))
            with graph(Path(scratch) / f'max{run}') as opened:
                speeds.append(as_fast_as_the_node_can(opened, bag, frames))
    print_header(f'Player, {frames} frames, {args.width} pixels wide', args.runs)
    print('| run | rate 1: deviation ms, median | p95 | largest | messages lost '
          '| rate max: frames per second | frames lost |')  # fmt: skip
    print('|---|---|---|---|---|---|---|')
    for run, (timing, (speed, lost)) in enumerate(zip(timings, speeds, strict=True), start=1):
        off = timing.deviation_ms
        print(f'| {run} | {statistics.median(off):.2f} | {np.percentile(off, 95):.2f} | {max(off):.2f} | {timing.lost} '
              f'| {speed:.0f} | {lost} |')  # fmt: skip


if __name__ == '__main__':
    main()
