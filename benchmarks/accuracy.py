"""Accuracy of a preset on many recordings: trajectory error, worst frame, error from frame to frame, and its verdicts.

    python benchmarks/accuracy.py [RECORDING ...] [--preset realtime] [--width 320] [--runs 5] [--data DIR] [--set KEY=VALUE]

Run k has seed k and one thread, so that it can be repeated bit for bit on the same kind of processor. RECORDING is a folder
in DIR, or FOLDER:START:END for some of its frames; without any, all recordings of DIR that are 320 pixels wide are taken.

ATE and RPE are those of all frames with a pose, tracked and uncertain; `worst` is the largest error of a tracked frame. `false`
counts tracked frames farther off than 10 cm and than three standard deviations. `deviations` is the median error of the pose
relative to that ten frames before, in standard deviations (0.95 if they are true); the noise of the ground truth counts as below.
"""

from __future__ import annotations

import argparse
import os
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from header import print_header

from splatam_core.config import apply_threads, load_config
from splatam_core.datasets.registry import open_sequence
from splatam_core.evaluation.calibration import TruthNoise, normalized_errors
from splatam_core.evaluation.trajectory import falsely_tracked, relative_pose_errors, trajectory_error
from splatam_core.geometry.trajectory import Trajectory
from splatam_core.slam import Slam
from splatam_core.types import FrameResult, Status

RECORDINGS = ('redkitchen_320', 'redkitchen_320:0:300', 'redkitchen_320:300:600', 'fr1_rpy_320', 'fr1_rpy_320:180:430', 'd435_desk')
COLUMNS = (
    'recording', 'runs', 'frames', 'uncertain', 'lost', 'false', 'ATE cm', 'ATE tracked cm', 'worst cm', 'RPE mm', 'RPE deg',
    'deviations', 'Gaussians',
)  # fmt: skip
TRUTH_NOISE = {
    'redkitchen_320': TruthNoise(0.005, np.radians(0.2)),  # KinectFusion, consistent to about half a centimetre
    'fr1_rpy_320': TruthNoise(0.001, np.radians(0.2)),  # motion capture
    'd435_desk': TruthNoise(0.003, np.radians(0.15)),  # a tracking camera, smooth from frame to frame
}
"""Of a pose relative to that ten frames before."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """One run: numbers of frames, errors in metres and degrees, their size in standard deviations, size of the map."""

    frames: int
    uncertain: int
    lost: int
    false: int
    ate_m: float
    ate_tracked_m: float
    worst_m: float
    rpe_m: float
    rpe_deg: float
    deviations: float
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
    lost_ns = [result.stamp_ns for result in results if result.T_world_cam is None]
    estimate, tracked = trajectory(results), trajectory([result for result in results if result.status.is_trusted])
    covariances = {result.stamp_ns: result.covariance for result in results if result.covariance is not None}
    ground_truth = sequence.ground_truth()
    if ground_truth is None:
        raise SystemExit(f'{source} has no ground truth')
    error, tracked_error = trajectory_error(estimate, ground_truth), trajectory_error(tracked, ground_truth)
    per_frame, _ = relative_pose_errors(estimate, ground_truth, lost_ns)
    noise = TRUTH_NOISE.get(source.name, TruthNoise())
    deviations = normalized_errors(estimate, ground_truth, covariances, noise=noise)
    return Outcome(
        frames=len(results),
        uncertain=sum(result.status is Status.UNCERTAIN for result in results),
        lost=len(lost_ns),
        false=int(falsely_tracked(tracked_error, covariances).sum()),
        ate_m=error.rmse_m,
        ate_tracked_m=tracked_error.rmse_m,
        worst_m=float(tracked_error.errors_m.max()),
        rpe_m=per_frame.translation_rmse_m or 0.0,
        rpe_deg=per_frame.rotation_rmse_deg or 0.0,
        deviations=float(np.median(deviations)) if len(deviations) else float('nan'),
        num_gaussians=slam.num_gaussians,
    )


def trajectory(results: Sequence[FrameResult]) -> Trajectory:
    """Returns the poses of the frames that have one."""
    posed = [(result.stamp_ns, result.T_world_cam) for result in results if result.T_world_cam is not None]
    return Trajectory(np.array([stamp_ns for stamp_ns, _ in posed]), np.array([pose for _, pose in posed]))


def row(name: str, outcomes: list[Outcome]) -> str:
    """Returns a line of the table: medians, with the least and the most; for counts of frames the most."""

    def spread(of: Callable[[Outcome], float], digits: int) -> str:
        values = sorted(map(of, outcomes))
        return f'{statistics.median(values):.{digits}f} ({values[0]:.{digits}f}–{values[-1]:.{digits}f})'

    cells = [
        name.replace(':', ' ', 1).replace(':', '..'), str(len(outcomes)), str(outcomes[0].frames),
        *(str(max(getattr(outcome, count) for outcome in outcomes)) for count in ('uncertain', 'lost', 'false')),
        spread(lambda o: 100 * o.ate_m, 2), spread(lambda o: 100 * o.ate_tracked_m, 2), spread(lambda o: 100 * o.worst_m, 1),
        spread(lambda o: 1000 * o.rpe_m, 1), spread(lambda o: o.rpe_deg, 2), spread(lambda o: o.deviations, 2),
        spread(lambda o: o.num_gaussians, 0),
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
