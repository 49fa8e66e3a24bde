"""How consistent a map is where the camera comes back: online and final trajectory, loops, and what the graph costs.

    python benchmarks/consistency.py [RECORDING ...] [--preset realtime] [--width 320] [--runs 1] [--data DIR] [--set KEY=VALUE]

RECORDING is a folder in DIR, FOLDER:START:END for some of its frames, or ``corridor:N`` for N synthetic frames along the wall of
growth.py and N back. Run k has seed k and one thread. A loop is false if it differs from the ground truth by more than 8 cm.
`graph` is the mean time per frame in the graph, as a share of the whole; `slowest` the longest of a keyframe.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from growth import camera, frame_at, pose
from header import print_header
from numpy.typing import NDArray

from splatam_core.config import apply_threads, load_config
from splatam_core.datasets.registry import open_sequence
from splatam_core.evaluation.trajectory import trajectory_error
from splatam_core.geometry import se3
from splatam_core.geometry.trajectory import Trajectory, interpolate_poses
from splatam_core.slam import Slam
from splatam_core.types import FrameResult, RgbdFrame, Status

RECORDINGS = ('redkitchen_320:0:1000', 'redkitchen_320:300:600', 'fr1_rpy_320:0:430', 'corridor:500')
COLUMNS = (
    'recording', 'seed', 'frames', 'uncertain', 'lost', 'ATE cm online', 'final', 'end cm online', 'final', 'loops', 'false',
    'corrections', 'ms per frame', 'graph %', 'slowest ms', 'Gaussians',
)  # fmt: skip
FALSE_M = 0.08


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Frames and their true poses."""

    length: int
    frames: Iterator[RgbdFrame]
    ground_truth: Trajectory


def opened(name: str, args: argparse.Namespace) -> Recording:
    """Opens a recording, or makes the corridor."""
    folder, *limits = name.split(':')
    if folder == 'corridor':
        there = int(limits[0])
        places = [*range(there), *reversed(range(there))]
        cam, rng = camera(args.width), np.random.default_rng(0)
        stamps_ns = 10**9 + np.arange(len(places)) * 33_333_333
        frames = (frame_at(pose(place), int(stamp_ns), cam, rng) for place, stamp_ns in zip(places, stamps_ns))
        return Recording(len(places), frames, Trajectory(stamps_ns, np.array([pose(place) for place in places])))
    start, end = (int(limits[0]), int(limits[1])) if limits else (0, None)
    max_frames = None if end is None else end - start
    sequence = open_sequence(str(args.data / folder), width=args.width, start=start, max_frames=max_frames)
    ground_truth = sequence.ground_truth()
    if ground_truth is None:
        raise SystemExit(f'{name} has no ground truth')
    return Recording(len(sequence), (sequence[index] for index in range(len(sequence))), ground_truth)


def row(name: str, seed: int, args: argparse.Namespace) -> str:
    """Runs the preset on a recording. Returns a line of the table."""
    config = load_config(args.preset, ['threads=1', f'seed={seed}', *args.overrides])
    apply_threads(config)
    recording = opened(name, args)
    slam = Slam(config, num_frames=recording.length)
    results = [slam.process(frame) for frame in recording.frames]
    online = poses(results)
    slam.optimize_graph()
    final = Trajectory(online.stamps_ns, slam.graph.corrected(online.stamps_ns, online.T_world_cam))
    loops = loop_errors_m(slam, recording.ground_truth)
    total, graph = (np.array([getattr(result.timings, stage) for result in results]) for stage in ('total', 'graph'))
    errors = [trajectory_error(estimate, recording.ground_truth) for estimate in (online, final)]
    ends = [end_error_m(estimate, recording.ground_truth) for estimate in (online, final)]
    cells = [
        name, seed, len(results), *(sum(r.status is status for r in results) for status in (Status.UNCERTAIN, Status.LOST)),
        *(f'{100 * error.rmse_m:.2f}' for error in errors), *(f'{100 * end:.1f}' for end in ends), len(loops),
        int((loops > FALSE_M).sum()), slam.graph.num_corrections, f'{total.mean():.1f}', f'{100 * graph.sum() / total.sum():.1f}',
        f'{graph.max():.0f}', slam.num_gaussians,
    ]  # fmt: skip
    return '| ' + ' | '.join(map(str, cells)) + ' |'


def poses(results: list[FrameResult]) -> Trajectory:
    """Returns the poses of the frames that have one."""
    posed = [(result.stamp_ns, result.T_world_cam) for result in results if result.T_world_cam is not None]
    return Trajectory(np.array([stamp_ns for stamp_ns, _ in posed]), np.array([T for _, T in posed]))


def end_error_m(estimate: Trajectory, ground_truth: Trajectory) -> float:
    """Returns by how much the last camera is off relative to the first one."""
    true_poses, _ = interpolate_poses(ground_truth, estimate.stamps_ns[[0, -1]])
    moved, truly = (se3.inverse(T[0]) @ T[-1] for T in (estimate.T_world_cam, true_poses))
    return float(np.linalg.norm(moved[:3, 3] - truly[:3, 3]))


def loop_errors_m(slam: Slam, ground_truth: Trajectory) -> NDArray[np.float64]:
    """Returns [L] by how much the measured motions of the loops are off."""
    true_poses, _ = interpolate_poses(ground_truth, slam.graph.nodes.stamps_ns)
    return np.array(
        [
            np.linalg.norm((se3.inverse(true_poses[loop.first]) @ true_poses[loop.second])[:3, 3] - loop.T_first_second[:3, 3])
            for loop in slam.graph.loops()
        ]
    )


def main() -> None:
    """Run everything and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('recordings', nargs='*', default=RECORDINGS)
    parser.add_argument('--preset', default='realtime')
    parser.add_argument('--width', type=int, default=320)
    parser.add_argument('--runs', type=int, default=1)
    parser.add_argument('--data', type=Path, default=Path(os.environ.get('SPLATAM_DATA', '../shared/data')))
    parser.add_argument('--set', dest='overrides', action='append', default=[], metavar='KEY=VALUE')
    args = parser.parse_args()
    print_header(f'Preset `{args.preset}`, width {args.width}, one thread', args.runs)
    print('| ' + ' | '.join(COLUMNS) + ' |\n|' + '---|' * len(COLUMNS))
    for name in args.recordings:
        for seed in range(args.runs):
            print(row(name, seed, args), flush=True)


if __name__ == '__main__':
    main()
