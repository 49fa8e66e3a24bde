"""Frames per second beside other work: k processes that compute without a pause, with the default threads and with one.

    python benchmarks/busy.py SOURCE [--width 320] [--frames 100] [--loads 0,1,2,4] [--runs 1] [--preset realtime]

Each run is a process of its own; frames are decoded before the clock starts. The default threads' fair share of C cores
beside k loops is min(1, C / (C + k)) of their rate without load. Columns: frames per second with the default threads and
with one, the default's rate over its fair share, and over that of one thread under the same load. Needs an idle machine.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from header import print_header

from splatam_core.config import apply_threads, load_config
from splatam_core.datasets.registry import open_sequence
from splatam_core.slam import Slam


def loop() -> None:
    """Compute for ever."""
    while True:
        pass


@contextmanager
def load(count: int) -> Iterator[None]:
    """Runs busy loops beside the block."""
    context = multiprocessing.get_context('spawn')  # a fork would inherit this process's libraries and their threads
    loops = [context.Process(target=loop, daemon=True) for _ in range(count)]
    for process in loops:
        process.start()
    time.sleep(1.0 if loops else 0.0)
    try:
        yield
    finally:
        for process in loops:
            process.kill()
            process.join()


def frames_per_second(args: argparse.Namespace, threads: int) -> float:
    """Runs the preset in this process, without refining the map at the end."""
    config = load_config(args.preset, [f'threads={threads}'])
    apply_threads(config)
    sequence = open_sequence(args.source, width=args.width, max_frames=args.frames)
    frames, slam = [sequence[index] for index in range(len(sequence))], Slam(config)
    begin = time.perf_counter()
    for frame in frames:
        slam.process(frame)
    return len(frames) / (time.perf_counter() - begin)


def in_a_process(args: argparse.Namespace, threads: int) -> float:
    """Runs the preset in a new process."""
    command = [sys.executable, __file__, args.source, '--width', str(args.width), '--frames', str(args.frames)]
    command += ['--preset', args.preset, '--one', str(threads)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return float(done.stdout.split()[-1])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('source')
    parser.add_argument('--width', type=int, default=320)
    parser.add_argument('--frames', type=int, default=100)
    parser.add_argument('--loads', default='0,1,2,4', help='numbers of busy loops; the first is 0')
    parser.add_argument('--runs', type=int, default=1)
    parser.add_argument('--preset', default='realtime')
    parser.add_argument('--one', type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one is not None:
        print(frames_per_second(args, args.one))
        return
    cores = len(os.sched_getaffinity(0))
    print_header(f'`{args.preset}` beside busy loops, {args.frames} frames, width {args.width}, {cores} cores', args.runs)
    print('| busy loops | default threads | one thread | default / fair share | default / one thread |\n|---|---|---|---|---|')
    alone: float | None = None
    for count in map(int, args.loads.split(',')):
        with load(count):
            pairs = [(in_a_process(args, 0), in_a_process(args, 1)) for _ in range(args.runs)]
        many, one = (statistics.median(rates) for rates in zip(*pairs, strict=True))
        alone = many if alone is None else alone
        fair = alone * min(1.0, cores / (cores + count))
        print(f'| {count} | {many:.1f} | {one:.1f} | {many / fair:.2f} | {many / one:.2f} |', flush=True)


if __name__ == '__main__':
    main()
