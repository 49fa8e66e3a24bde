"""Trajectory errors of a run beside those of evo, an independent tool that runs as a separate program.

    python -m venv evo-venv && evo-venv/bin/pip install evo
    python benchmarks/evo.py RUN --evo evo-venv/bin

evo reads two TUM trajectories that this script writes: the estimate, and the ground truth interpolated at its stamps. The
comparison is therefore about alignment and statistics, not about matching stamps. RUN is a run folder whose source has a
ground truth and in which every frame was tracked.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from header import print_header

from splatam_core.commands.shared import open_source
from splatam_core.evaluation.score import score_trajectory
from splatam_core.geometry.trajectory import Trajectory, interpolate_poses, pose_line
from splatam_core.runs.record import read_run

COLUMNS = '| | ours | evo | difference |'


def rmse(evo: Path, program: str, truth: Path, estimate: Path, *options: str) -> float:
    """Returns the RMSE that evo prints.

    Raises:
        SystemExit: evo printed none.
    """
    command = [str(evo / program), 'tum', str(truth), str(estimate), *options]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    found = re.search(r'rmse\s+([0-9.eE+-]+)', done.stdout)
    if found is None:
        sys.exit(f'{program} printed no rmse:\n{done.stdout}')
    return float(found[1])


def write(path: Path, trajectory: Trajectory) -> Path:
    """Write a trajectory in the TUM format. Returns the path."""
    path.write_text('\n'.join(map(pose_line, trajectory.stamps_ns.tolist(), trajectory.T_world_cam)) + '\n')
    return path


def main() -> None:
    """Compare and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('run', type=Path)
    parser.add_argument('--evo', type=Path, required=True, metavar='DIR', help='folder of evo_ape and evo_rpe')
    args = parser.parse_args()
    run = read_run(args.run)
    source = run.description.source
    truth = None if source is None else open_source(source).ground_truth()
    if truth is None:
        parser.error(f'{args.run}: its recording has no ground truth')
    ours = score_trajectory(run, truth)
    poses, known = interpolate_poses(truth, run.trajectory.stamps_ns)
    stamps_ns = run.trajectory.stamps_ns[known]
    with tempfile.TemporaryDirectory() as folder:
        files = (
            write(Path(folder) / 'truth.txt', Trajectory(stamps_ns, poses[known])),
            write(Path(folder) / 'estimate.txt', Trajectory(stamps_ns, run.trajectory.T_world_cam[known])),
        )
        frames_a_second = round(1e9 / float(np.median(np.diff(stamps_ns))))
        step = '--delta', '1', '--delta_unit', 'f', '--all_pairs'
        second = '--delta', str(frames_a_second), '--delta_unit', 'f', '--all_pairs'
        rows = [
            ('ATE RMSE, m', ours.error.rmse_m, ('evo_ape', '--align')),
            ('RPE per frame, m', ours.per_frame.translation_rmse_m, ('evo_rpe', *step)),
            ('RPE per frame, deg', ours.per_frame.rotation_rmse_deg, ('evo_rpe', *step, '-r', 'angle_deg')),
            ('RPE per second, m', ours.per_second.translation_rmse_m, ('evo_rpe', *second)),
            ('RPE per second, deg', ours.per_second.rotation_rmse_deg, ('evo_rpe', *second, '-r', 'angle_deg')),
        ]
        print_header(f'{len(stamps_ns)} poses of {args.run.name} against evo', 1)
        print(f'{COLUMNS}\n|---|---|---|---|')
        for name, own, (program, *options) in rows:
            if own is None:
                continue
            theirs = rmse(args.evo, program, *files, *options)
            print(f'| {name} | {own:.6f} | {theirs:.6f} | {abs(own - theirs):.1e} |')


if __name__ == '__main__':
    main()
