"""Depth with a grid of holes, as forward warping from a smaller image gives it, beside the same depth without them.

    python benchmarks/holes.py [RECORDING ...] [--preset realtime] [--width 320] [--runs 3] [--max-frames N] [--ratio 2 3]

RECORDING is a folder in SPLATAM_DATA, or ``synthetic``, of which run k is in room k. Run k has seed k and one thread. Images are
scored at the estimated poses against the depth without holes; closed is the fraction of its readings where the map's silhouette is
at least 0.5.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from header import print_header

from splatam_core.config import apply_threads, load_config
from splatam_core.datasets.registry import open_sequence
from splatam_core.evaluation.images import ViewScorer
from splatam_core.evaluation.trajectory import trajectory_error
from splatam_core.geometry.trajectory import Trajectory
from splatam_core.rasterizer import make_rasterizer
from splatam_core.slam import Slam

sys.path.append(str(Path(__file__).resolve().parents[1] / 'test/field'))
from thinned_depth import ThinnedSequence  # type: ignore[import-not-found]

DATA = Path(os.environ.get('SPLATAM_DATA', '../shared/data'))
RECORDINGS = ('synthetic', '7scenes_redkitchen', 'd435_desk')
SCORE_EVERY = 10  # frames
COLUMNS = ('recording', 'depth', 'frames', 'lost', 'ATE cm', 'worst cm', 'PSNR dB', 'depth L1 cm', 'closed %', 'Gaussians')


@dataclass(frozen=True, slots=True)
class Outcome:
    """One run: frames, errors in metres, image scores, size of the map."""

    frames: int
    lost: int
    ate_m: float
    worst_m: float
    psnr_db: float
    depth_l1_m: float
    closed: float
    num_gaussians: int


def run(dense: Any, given: Any, args: argparse.Namespace, seed: int) -> Outcome:
    """Run the preset on the given frames; score it against the dense ones."""
    config = load_config(args.preset, ['threads=1', f'seed={seed}', *args.overrides])
    apply_threads(config)
    slam = Slam(config, num_frames=len(given))
    results = [slam.process(given[index]) for index in range(len(given))]
    slam.finish()
    poses = {index: result.T_world_cam for index, result in enumerate(results) if result.T_world_cam is not None}
    estimate = Trajectory(np.array([results[index].stamp_ns for index in poses]), np.array(list(poses.values())))
    truth = dense.ground_truth()
    assert truth is not None
    error = trajectory_error(estimate, truth)
    scorer = ViewScorer(slam.map.gaussians, make_rasterizer(slam.backend.rasterizer, 1), config.depth)
    scores, closed = [], []
    for index in list(poses)[::SCORE_EVERY]:
        frame = dense[index]
        render, view = scorer.render(frame, poses[index]), scorer.view(frame)
        closed.append(float((render.silhouette[view.valid] >= 0.5).float().mean()))
        scores.append(scorer.score(frame, poses[index]).scores)
    return Outcome(
        frames=len(results),
        lost=len(results) - len(poses),
        ate_m=error.rmse_m,
        worst_m=float(error.errors_m.max()),
        psnr_db=statistics.mean(score.psnr_db or 0.0 for score in scores),
        depth_l1_m=statistics.mean(score.depth_l1_m or 0.0 for score in scores),
        closed=statistics.mean(closed),
        num_gaussians=slam.num_gaussians,
    )


def row(recording: str, depth: str, outcomes: list[Outcome]) -> str:
    """Returns a line of the table: medians; for the errors also the least and the most, for frames lost the most."""

    def median(of: Callable[[Outcome], float], digits: int) -> str:
        return f'{statistics.median(map(of, outcomes)):.{digits}f}'

    def spread(of: Callable[[Outcome], float]) -> str:
        values = sorted(map(of, outcomes))
        return f'{statistics.median(values):.2f} ({values[0]:.2f}–{values[-1]:.2f})'

    cells = [
        recording, depth, str(outcomes[0].frames), str(max(outcome.lost for outcome in outcomes)), spread(lambda o: 100 * o.ate_m),
        spread(lambda o: 100 * o.worst_m), median(lambda o: o.psnr_db, 2), median(lambda o: 100 * o.depth_l1_m, 2),
        median(lambda o: 100 * o.closed, 1), median(lambda o: o.num_gaussians, 0),
    ]  # fmt: skip
    return '| ' + ' | '.join(cells) + ' |'


def main() -> None:
    """Run everything and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('recordings', nargs='*', default=RECORDINGS)
    parser.add_argument('--preset', default='realtime')
    parser.add_argument('--width', type=int, default=320)
    parser.add_argument('--runs', type=int, default=3)
    parser.add_argument('--max-frames', type=int)
    parser.add_argument('--ratio', type=float, nargs='+', default=[1, 2, 3], help='size of colour over size of depth')
    parser.add_argument('--bent', action='store_true', help='bend the grid, as a turned and shifted depth camera does')
    parser.add_argument('--set', dest='overrides', action='append', default=[], metavar='KEY=VALUE')
    args = parser.parse_args()
    print_header(f'Preset `{args.preset}`, width {args.width}, one thread', args.runs)
    print('| ' + ' | '.join(COLUMNS) + ' |\n|' + '---|' * len(COLUMNS))
    for name in args.recordings:
        sources = [f'synthetic:seed={seed}' if name == 'synthetic' else str(DATA / name) for seed in range(args.runs)]
        dense = [open_sequence(source, width=args.width, max_frames=args.max_frames) for source in sources]
        for ratio in args.ratio:
            given = dense if ratio == 1 else [ThinnedSequence(each, ratio, args.bent) for each in dense]
            outcomes = [run(*sequences, args, seed) for seed, sequences in enumerate(zip(dense, given, strict=True))]
            bent = ', bent' if args.bent else ''
            print(row(name, 'dense' if ratio == 1 else f'1/{ratio:g}{bent}', outcomes), flush=True)


if __name__ == '__main__':
    main()
