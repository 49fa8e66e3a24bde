"""How reliable are a recording's ground truth and camera calibration, and how do they affect the trajectory error?

    python benchmarks/reference_poses.py SOURCE [--preset realtime] [--width 320] [--focal 1,1.02,1.04,1.06]

Prints the step of the reference poses that stands out most from its neighbours, and the error of the reference compared
with itself without that step. Then prints the error of a preset over all frames, before and after that step, with the
focal lengths as given and scaled. If the error falls with another focal length, the calibration is no better than that.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from itertools import pairwise

import numpy as np
from header import print_header
from numpy.typing import NDArray

from splatam_core.config import apply_threads, load_config
from splatam_core.datasets.registry import open_sequence
from splatam_core.evaluation.trajectory import trajectory_error
from splatam_core.geometry import se3
from splatam_core.geometry.trajectory import Trajectory
from splatam_core.slam import Slam
from splatam_core.types import RgbdFrame

NEIGHBOURS = 5


def steps(T_world_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """Returns the [N - 1, 6] twists from each pose to the next."""
    return np.array([se3.log(se3.inverse(a) @ b) for a, b in pairwise(T_world_cam)])


def without_step(T_world_cam: NDArray[np.float64], at: int) -> NDArray[np.float64]:
    """Returns the poses with one step replaced by the mean of the steps beside it."""
    twists = steps(T_world_cam)
    twists[at] = (twists[at - 1] + twists[at + 1]) / 2
    poses = [T_world_cam[0]]
    for twist in twists:
        poses.append(poses[-1] @ se3.exp(twist))
    return np.array(poses)


def tracked(frames: list[RgbdFrame], preset: str, focal: float) -> Trajectory:
    """Returns the trajectory of a preset with scaled focal lengths."""
    config = load_config(preset, ['threads=1'])
    apply_threads(config)
    slam, stamps_ns, poses = Slam(config), [], []
    for frame in frames:
        camera = replace(frame.camera, fx=focal * frame.camera.fx, fy=focal * frame.camera.fy)
        result = slam.process(replace(frame, camera=camera))
        if result.T_world_cam is not None:
            stamps_ns.append(frame.stamp_ns)
            poses.append(result.T_world_cam)
    return Trajectory(np.array(stamps_ns), np.array(poses))


def ate_cm(estimate: Trajectory, truth: Trajectory, begin: int = 0, end: int | None = None) -> float:
    """Returns the RMSE of the poses from ``begin`` to ``end``, aligned on their own, in centimetres."""
    part = Trajectory(estimate.stamps_ns[begin:end], estimate.T_world_cam[begin:end])
    return 100 * trajectory_error(part, truth).rmse_m


def main() -> None:
    """Print the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('source')
    parser.add_argument('--preset', default='realtime')
    parser.add_argument('--width', type=int, default=320)
    parser.add_argument('--focal', default='1,1.02,1.04,1.06')
    args = parser.parse_args()
    sequence = open_sequence(args.source, width=args.width)
    truth = sequence.ground_truth()
    if truth is None:
        parser.error(f'{args.source} has no reference poses')
    frames = [sequence[index] for index in range(len(sequence))]
    print_header(f'Reference poses of {sequence.name}', 1)

    lengths = np.linalg.norm(steps(truth.T_world_cam), axis=1)
    inner = range(1, len(lengths) - 1)
    usual = np.array([np.median(lengths[max(0, i - NEIGHBOURS) : i + NEIGHBOURS + 1]) for i in inner])
    at = int(np.argmax(lengths[1:-1] / usual)) + 1
    twist = steps(truth.T_world_cam)[at]
    around = steps(truth.T_world_cam)[[at - 2, at - 1, at + 1, at + 2]]
    print(
        f'Most sudden step of the reference: {at} to {at + 1}, {100 * np.linalg.norm(twist[:3]):.2f} cm and '
        f'{np.degrees(np.linalg.norm(twist[3:])):.2f} degrees; beside it '
        f'{100 * np.linalg.norm(around[:, :3], axis=1).mean():.2f} cm and '
        f'{np.degrees(np.linalg.norm(around[:, 3:], axis=1)).mean():.2f} degrees. The reference without it has an ATE of '
        f'{ate_cm(Trajectory(truth.stamps_ns, without_step(truth.T_world_cam, at)), truth):.2f} cm.\n'
    )
    print(f'| focal lengths | ATE cm | up to frame {at} | from frame {at + 1} |\n|---|---|---|---|')
    for focal in map(float, args.focal.split(',')):
        estimate = tracked(frames, args.preset, focal)
        split = int(np.searchsorted(estimate.stamps_ns, truth.stamps_ns[at + 1]))
        cells = ate_cm(estimate, truth), ate_cm(estimate, truth, end=split), ate_cm(estimate, truth, split)
        print(f'| x {focal:g} | ' + ' | '.join(f'{cell:.2f}' for cell in cells) + ' |', flush=True)


if __name__ == '__main__':
    main()
