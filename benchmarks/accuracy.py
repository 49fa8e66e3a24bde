"""Accuracy of a preset on many recordings: trajectory error, worst frame, error from frame to frame, lost frames.

    python benchmarks/accuracy.py [RECORDING ...] [--preset realtime] [--width 320] [--runs 5] [--data DIR] [--set KEY=VALUE]

Run k has seed k and one thread, so that it can be repeated bit for bit on the same kind of processor. RECORDING is a folder
in DIR, or FOLDER:START:END for some of its frames; without any, all recordings of DIR that are 320 pixels wide are taken.
"""

from __future__ import annotations

import argparse
import os
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from header import print_header

from splatam_core.config import apply_threads, load_config
from splatam_core.datasets.registry import open_sequence
from splatam_core.evaluation.trajectory import relative_pose_errors, trajectory_error
from splatam_core.geometry.trajectory import Trajectory
from splatam_core.slam import Slam

RECORDINGS = ('redkitchen_320', 'redkitchen_320:0:300', 'redkitchen_320:300:600', 'fr1_rpy_320', 'fr1_rpy_320:180:430', 'd435_desk')
COLUMNS = ('recording', 'runs', 'frames', 'lost', 'ATE cm', 'worst cm', 'RPE mm', 'RPE deg', 'Gaussians')


@dataclass(frozen=True, slots=True)
class Outcome:
    """One run: numbers of frames, errors in metres and degrees, size of the map."""

    frames: int
    lost: int
    ate_m: float
    worst_m: float
    rpe_m: float
    rpe_deg: float
    num_gaussians: int


def run(source: Path, name: str, args: argparse.Namespace, seed: int) -> Outcome:
    """Run the preset on a recording."""
    _, start, end = (*name.split(':'), '', '')[:3]
    config = load_config(args.preset, ['threads=1', f'seed={seed}', *args.overrides])
    apply_threads(config)
    max_frames = int(end) - int(start or 0) if end else None
    sequence = open_sequence(str(source), width=args.width, start=int(start or 0), max_frames=max_frames)
    slam = Slam(config, num_frames=len(sequence))
    results = [slam.process(sequence[index]) for index in range(len(sequence))]
    poses = [(result.stamp_ns, result.T_world_cam) for result in results if result.T_world_cam is not None]
    lost_ns = [result.stamp_ns for result in results if result.T_world_cam is None]
    estimate = Trajectory(np.array([stamp_ns for stamp_ns, _ in poses]), np.array([pose for _, pose in poses]))
    ground_truth = sequence.ground_truth()
    if ground_truth is None:
        raise SystemExit(f'{source} has no ground truth')
    error, (per_frame, _) = trajectory_error(estimate, ground_truth), relative_pose_errors(estimate, ground_truth, lost_ns)
    return Outcome(
        frames=len(results),
        lost=len(lost_ns),
        ate_m=error.rmse_m,
        worst_m=float(error.errors_m.max()),
        rpe_m=per_frame.translation_rmse_m or 0.0,
        rpe_deg=per_frame.rotation_rmse_deg or 0.0,
        num_gaussians=slam.num_gaussians,
    )


def row(name: str, outcomes: list[Outcome]) -> str:
    """Returns a line of the table: medians, with the least and the most; for frames lost and the worst frame the most."""

    def spread(of: Callable[[Outcome], float], digits: int) -> str:
        values = sorted(map(of, outcomes))
        return f'{statistics.median(values):.{digits}f} ({values[0]:.{digits}f}–{values[-1]:.{digits}f})'

    cells = [
        name.replace(':', ' ', 1).replace(':', '..'), str(len(outcomes)), str(outcomes[0].frames),
        str(max(outcome.lost for outcome in outcomes)), spread(lambda o: 100 * o.ate_m, 2), spread(lambda o: 100 * o.worst_m, 1),
        spread(lambda o: 1000 * o.rpe_m, 1), spread(lambda o: o.rpe_deg, 2), spread(lambda o: o.num_gaussians, 0),
    ]  # fmt: skip
    return '| ' + ' | '.join(cells) + ' |'


def main() -> None:
    """Run everything and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('recordings', nargs='*', default=RECORDINGS)
    parser.add_argument('--preset', default='realtime')
    parser.add_argument('--width', type=int, default=320)
    parser.add_argument('--runs', type=int, default=5)
    parser.add_argument('--data', type=Path, default=Path(os.environ.get('SPLATAM_DATA', '../shared/data')))
    parser.add_argument('--set', dest='overrides', action='append', default=[], metavar='KEY=VALUE')
    args = parser.parse_args()
    print_header(f'Preset `{args.preset}`, width {args.width}, one thread', args.runs)
    print('| ' + ' | '.join(COLUMNS) + ' |\n|' + '---|' * len(COLUMNS))
    for name in args.recordings:
        outcomes = [run(args.data / name.partition(':')[0], name, args, seed) for seed in range(args.runs)]
        print(row(name, outcomes), flush=True)


if __name__ == '__main__':
    main()
