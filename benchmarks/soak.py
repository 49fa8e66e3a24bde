"""The node over a long time: plays a recording in a loop and samples the memory of node and player.

    python benchmarks/soak.py [SOURCE] [--minutes 30] [--preset quick] [--width 320] [--rate 1] [--max-frames 150]

The stamps start again with each loop, so the node starts a new map. The node drops frames that it has no time for, as with
a live camera. Every output of the node has a subscriber, and the run is saved at each loop. Input frames are counted by
their CameraInfo, output frames by ``~/processed``.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from header import print_header
from live import Child, Graph, convert, graph
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header

from msg_adapters.factory import message_class
from splatam_ros.node.outputs import OUTPUTS

START_TIMEOUT_S = 60.0
SETTLING = 0.25  # fraction of the time in which memory may grow: caches, allocators, the first map


@dataclass(frozen=True, slots=True)
class Sample:
    """Memory and frame counts at one time.

    Attributes:
        minutes: time since the first frame.
        rss_mb: resident memory of the node, MiB.
        player_mb: resident memory of the player, MiB.
        frames_in: input frames so far.
        processed: frames tracked or lost so far.
        poses: poses published so far.
    """

    minutes: float
    rss_mb: float
    player_mb: float
    frames_in: int
    processed: int
    poses: int


def watch(opened: Graph, node: Child, player: Child, minutes: float, period_s: float) -> list[Sample]:
    """Sample while both run.

    Raises:
        SystemExit: one of them ended, or no frame was processed.
    """
    infos = opened.listen('/rgb/camera_info', CameraInfo)
    done = opened.listen('/splatam/processed', Header)
    poses = opened.listen('/splatam/pose')
    for output in OUTPUTS[1:]:
        opened.drain(f'/splatam/{output.topic}', message_class(output.type_name))
    if not opened.spin_until(lambda: done, START_TIMEOUT_S):
        sys.exit(f'no frame was processed; the output of the node:\n{node.log.read_text()}')
    samples: list[Sample] = []
    started_s = time.monotonic()
    while (elapsed_s := time.monotonic() - started_s) < 60 * minutes:
        for child in (node, player):
            if not child.is_running:
                sys.exit(f'ended after {elapsed_s / 60:.1f} minutes; its output:\n{child.log.read_text()}')
        samples.append(
            Sample(elapsed_s / 60, node.rss_mb(), player.rss_mb(), len(infos), len(done), len(poses))
        )  # fmt: skip
        opened.spin_for(period_s)
    return samples


def slope(samples: list[Sample]) -> float:
    """Returns the growth of the node's memory after the settling time, in MiB per minute (least squares)."""
    settled = [sample for sample in samples if sample.minutes >= SETTLING * samples[-1].minutes]
    return float(np.polyfit([s.minutes for s in settled], [s.rss_mb for s in settled], 1)[0])


def print_table(samples: list[Sample], rows: int) -> None:
    """Print ``rows`` of the samples, including the first and the last, and a summary of all."""
    print('| minute | node MB | player MB | frames in | processed | poses |\n|---|---|---|---|---|---|')
    for i in sorted(set(np.linspace(0, len(samples) - 1, rows).round().astype(int))):
        s = samples[i]
        print(f'| {s.minutes:.1f} | {s.rss_mb:.0f} | {s.player_mb:.0f} | {s.frames_in} | {s.processed} | {s.poses} |')
    first, last = samples[0], samples[-1]
    frames_in, processed = last.frames_in - first.frames_in, last.processed - first.processed
    print(f'\nNode: {slope(samples):+.2f} MB a minute after the first {SETTLING:.0%} of the time, '
          f'{max(s.rss_mb for s in samples):.0f} MB at most. {frames_in} frames in, {processed} processed, '
          f'{last.poses - first.poses} of them with a pose, {frames_in - processed} dropped.')  # fmt: skip


def main() -> None:
    """Play the recording and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('source', nargs='?', default='synthetic')
    parser.add_argument('--minutes', type=float, default=30.0)
    parser.add_argument('--preset', default='quick')
    parser.add_argument('--width', type=int, default=320)
    parser.add_argument('--max-frames', type=int, default=150)
    parser.add_argument('--rate', type=float, default=1.0, help='playback rate (default: %(default)s)')
    args = parser.parse_args()
    title = f'{Path(args.source).name}, {args.minutes:g} minutes of looping, preset `{args.preset}`'
    print_header(f'{title}, {args.width} pixels wide, rate {args.rate:g}', 1)
    period_s = min(5.0, args.minutes * 60 / 20)
    with tempfile.TemporaryDirectory() as scratch:
        convert(args.source, bag := Path(scratch) / 'bag', args.width, args.max_frames)
        with graph(Path(scratch) / 'logs') as opened:
            node = opened.start_node(args.preset, save_path=Path(scratch) / 'run')
            player = opened.start_player(bag, '--loop', '--rate', str(args.rate))
            samples = watch(opened, node, player, args.minutes, period_s)
            warnings = [line for line in node.log.read_text().splitlines() if '[WARN]' in line or '[ERROR]' in line]
    print_table(samples, rows=16)
    print(f'\nWarnings and errors of the node: {len(warnings)}' + (f', last: {warnings[-1]}' if warnings else '.'))


if __name__ == '__main__':
    main()
