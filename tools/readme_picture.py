"""Draw the picture of the README: a camera image, the map seen from there, and the trajectory.

    python tools/readme_picture.py [--preset realtime] [--width 400] [--frames 300] [--out docs/images/synthetic_room.png]

The script runs SLAM on the synthetic room that ships with the project. It compares the estimated camera path with the exact
one, and prints the error and the number of Gaussians.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from splatam_core.config import load_config
from splatam_core.datasets.registry import open_sequence
from splatam_core.evaluation.trajectory import TrajectoryError, trajectory_error
from splatam_core.geometry.trajectory import Trajectory
from splatam_core.slam import Slam

DPI = 92
SIZE_IN = (13.0, 3.7)
INK, MUTED, FAINT = '#1b1f24', '#6b7480', '#e3e6ea'
ESTIMATE, GROUND_TRUTH = '#1769e0', '#9aa2ad'
RIGHT, FORWARD = 0, 2


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """What the picture shows.

    Attributes:
        photo: [H, W, 3] uint8, the camera image.
        render: [H, W, 3] uint8, the final map from the pose that was estimated for that image.
        error: the estimated path, aligned with the ground truth.
        num_gaussians: size of the final map.
    """

    photo: NDArray[np.uint8]
    render: NDArray[np.uint8]
    error: TrajectoryError
    num_gaussians: int


def main() -> None:
    """Run SLAM and write the picture."""
    root = Path(__file__).resolve().parents[1]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--preset', default='realtime')
    parser.add_argument('--width', type=int, default=400, help='width of the frames in pixels')
    parser.add_argument('--frames', type=int, default=300, help='number of frames; 300 close the loop')
    parser.add_argument('--shown', type=int, default=60, help='index of the frame to show')
    parser.add_argument('--out', type=Path, default=root / 'docs/images/synthetic_room.png')
    args = parser.parse_args()

    run = run_slam(args.preset, args.width, args.frames, args.shown)
    draw(run).savefig(args.out, dpi=DPI)
    print(f'{args.out}: ATE RMSE {100 * run.error.rmse_m:.2f} cm, {run.num_gaussians:,} Gaussians, {args.out.stat().st_size} bytes')


def run_slam(preset: str, width: int, frames: int, shown: int) -> Run:
    """Run SLAM over the synthetic room, then render the final map at the pose of one frame."""
    sequence = open_sequence('synthetic', width=width, max_frames=frames)
    ground_truth = sequence.ground_truth()
    slam = Slam(load_config(preset))
    results = [slam.process(sequence[index]) for index in range(frames)]
    slam.finish()
    poses = {result.stamp_ns: result.T_world_cam for result in results if result.T_world_cam is not None}
    shown_pose = results[shown].T_world_cam
    if ground_truth is None or shown_pose is None:
        raise SystemExit(f'frame {shown} is lost: choose another one with --shown')
    estimate = Trajectory(np.array(list(poses), np.int64), np.stack(list(poses.values())))
    error = trajectory_error(estimate, ground_truth)
    return Run(sequence[shown].rgb, slam.render(shown_pose).rgb, error, slam.num_gaussians)


def draw(run: Run) -> Figure:
    """The picture: camera image, render and path, side by side."""
    figure = Figure(figsize=SIZE_IN, facecolor='white', layout='constrained')
    FigureCanvasAgg(figure)
    photo, render, path = figure.subplots(1, 3, width_ratios=[1.0, 1.0, 0.9])
    for ax, image, title in ((photo, run.photo, 'Camera image'), (render, run.render, 'The map, rendered from the same pose')):
        ax.imshow(image)
        ax.set_axis_off()
        ax.set_title(title, loc='left', color=INK, fontsize=11, fontweight='bold')
    draw_path(path, run.error)
    return figure


def draw_path(ax: Axes, error: TrajectoryError) -> None:
    """The estimated and the exact path from above, in metres."""
    ax.plot(error.ground_truth_m[:, RIGHT], error.ground_truth_m[:, FORWARD], color=GROUND_TRUTH, linewidth=4, label='ground truth')
    ax.plot(error.estimate_m[:, RIGHT], error.estimate_m[:, FORWARD], color=ESTIMATE, linewidth=1.4, label='estimated')
    ax.set_title(
        f'Camera path from above, error {100 * error.rmse_m:.1f} cm', loc='left', color=INK, fontsize=11, fontweight='bold'
    )
    ax.set_xlabel('right (m)', color=MUTED)
    ax.set_ylabel('forward (m)', color=MUTED)
    ax.set_aspect('equal', adjustable='datalim')
    ax.grid(color=FAINT)
    ax.tick_params(colors=MUTED)
    ax.spines[['top', 'right']].set_visible(False)
    ax.legend(frameon=False)


if __name__ == '__main__':
    main()
