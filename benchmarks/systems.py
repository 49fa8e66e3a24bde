"""Whole systems side by side on one recording: our presets, Open3D's dense SLAM, OpenCV's RGB-D odometry.

    python benchmarks/systems.py SOURCE [--width 320] [--runs 5] [--systems realtime,quick,open3d,opencv] [--plot FILE.png]

Each run is a process of its own. Runs follow one another, and the systems take turns. Frames are decoded before the clock
starts. Run k of a preset has seed k. A system is a preset, ``open3d`` (``pip install open3d``; voxel-block grid, 3.0/512 m
voxels, frame to model) or ``opencv`` (frame to frame, no map). ``NAME:60`` uses the first 60 frames, ``NAME*1`` runs once
instead of --runs times, and ``NAME[key=value;...]`` changes settings of a preset.
"""

from __future__ import annotations

import argparse
import json
import re
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import cv2
import numpy as np
from header import print_header
from numpy.typing import NDArray

from splatam_core.config import apply_threads, load_config
from splatam_core.datasets.registry import open_sequence
from splatam_core.evaluation.images import ViewScorer, mean_scores
from splatam_core.evaluation.trajectory import trajectory_error
from splatam_core.geometry.trajectory import Trajectory
from splatam_core.rasterizer import rasterizer_for
from splatam_core.runs import provenance
from splatam_core.slam import Slam
from splatam_core.types import RgbdFrame, StageTimings

Poses = list[NDArray[np.float64] | None]
SCORED_EVERY = 7  # shares few frames with the keyframes, to which the map was fitted


@dataclass(frozen=True, slots=True)
class Outcome:
    """The result of one run; ``mean_stages_ms`` holds the mean time per frame of each stage, empty for other systems."""

    frames: int
    tracked: int
    seconds: float
    ate_cm: float | None
    psnr_db: float | None
    num_gaussians: int | None
    peak_rss_mb: float | None
    mean_stages_ms: dict[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The poses that a system found (None = lost), its wall time, and for a preset the map and the times of its stages."""

    poses: Poses
    seconds: float
    slam: Slam | None = None
    mean_stages_ms: dict[str, float] = field(default_factory=dict)


def run_ours(frames: Sequence[RgbdFrame], preset: str, overrides: list[str]) -> Estimate:
    """Run a preset. The time of ``finish`` is divided among the frames."""
    config = load_config(preset, overrides)
    apply_threads(config)
    slam = Slam(config)
    begin = time.perf_counter()
    results = [slam.process(frame) for frame in frames]
    processed = time.perf_counter()
    slam.finish()
    end = time.perf_counter()
    stages_ms = {name: statistics.mean(getattr(r.timings, name) for r in results) for name in StageTimings.__slots__}
    stages_ms['finish'] = 1e3 * (end - processed) / len(frames)
    return Estimate([result.T_world_cam for result in results], end - begin, slam, stages_ms)


def run_open3d(frames: Sequence[RgbdFrame]) -> Estimate:
    """Run dense SLAM as in Open3D's own example."""
    import open3d as o3d

    camera, device = frames[0].camera, o3d.core.Device('CPU:0')
    intrinsic = o3d.core.Tensor(camera.matrix)
    T_world_cam = o3d.core.Tensor(np.eye(4))
    model = o3d.t.pipelines.slam.Model(3.0 / 512, 16, 10000, T_world_cam, device)
    height, width = frames[0].depth_m.shape
    live = o3d.t.pipelines.slam.Frame(height, width, intrinsic, device)
    rendered = o3d.t.pipelines.slam.Frame(height, width, intrinsic, device)
    poses: Poses = []
    begin = time.perf_counter()
    for index, frame in enumerate(frames):
        depth_mm = np.rint(1000 * frame.depth_m).astype(np.uint16)
        live.set_data_from_image('depth', o3d.t.geometry.Image(o3d.core.Tensor(depth_mm[..., None])))
        live.set_data_from_image('color', o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(frame.rgb))))
        if index > 0:
            tracked = model.track_frame_to_model(live, rendered, 1000.0, 4.0, 0.07)
            T_world_cam = T_world_cam @ tracked.transformation
        poses.append(T_world_cam.numpy().copy())
        model.update_frame_pose(index, T_world_cam)
        model.integrate(live, 1000.0, 4.0, 8.0)
        model.synthesize_model_frame(rendered, 1000.0, 0.1, 4.0, 8.0, False)
    return Estimate(poses, time.perf_counter() - begin)


def run_opencv(frames: Sequence[RgbdFrame]) -> Estimate:
    """Run RGB-D odometry between consecutive frames."""
    settings = cv2.OdometrySettings()
    settings.setCameraMatrix(frames[0].camera.matrix.astype(np.float32))
    odometry = cv2.Odometry(cv2.OdometryType_RGB_DEPTH, settings, cv2.OdometryAlgoType_COMMON)
    T_world_cam, last = np.eye(4), None
    poses: Poses = []
    begin = time.perf_counter()
    for frame in frames:
        depth = np.where(frame.depth_m > 0, frame.depth_m, np.float32(np.nan))
        pair = depth, cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        if last is not None:
            found, motion = odometry.compute(last[0], last[1], pair[0], pair[1])
            if found:
                T_world_cam = T_world_cam @ np.linalg.inv(motion)
        poses.append(T_world_cam.copy())
        last = pair
    return Estimate(poses, time.perf_counter() - begin)


def run_one(system: System, source: str, width: int, seed: int) -> Outcome:
    """Run a system in this process."""
    sequence = open_sequence(source, width=width, max_frames=system.frames)
    frames = [sequence[index] for index in range(len(sequence))]
    if system.name == 'open3d':
        found = run_open3d(frames)
    elif system.name == 'opencv':
        found = run_opencv(frames)
    else:
        found = run_ours(frames, system.name, [f'seed={seed}', *system.overrides])
    peak = provenance.peak_rss_mb()
    tracked = [(frame, pose) for frame, pose in zip(frames, found.poses) if pose is not None]
    estimate = Trajectory(np.array([f.stamp_ns for f, _ in tracked]), np.array([pose for _, pose in tracked]))
    truth = sequence.ground_truth()
    psnr_db = None
    if (slam := found.slam) is not None:
        scorer = ViewScorer(slam.map.gaussians, rasterizer_for(slam.config)[0], slam.config.depth)
        final = slam.graph.corrected(estimate.stamps_ns, estimate.T_world_cam)
        scored = list(zip([frame for frame, _ in tracked], final))[::SCORED_EVERY]
        psnr_db = mean_scores(scorer.score(*pair) for pair in scored).psnr_db
    return Outcome(
        frames=len(frames),
        tracked=len(tracked),
        seconds=found.seconds,
        ate_cm=None if truth is None else 100 * trajectory_error(estimate, truth).rmse_m,
        psnr_db=psnr_db,
        num_gaussians=None if slam is None else slam.num_gaussians,
        peak_rss_mb=peak,
        mean_stages_ms=found.mean_stages_ms,
    )


@dataclass(frozen=True, slots=True)
class System:
    """One entry of --systems.

    Attributes:
        text: the entry itself.
        name: a preset, ``open3d`` or ``opencv``.
        overrides: ``key=value`` settings of a preset.
        frames: number of frames to use; None = all.
        runs: number of runs.
    """

    text: str
    name: str
    overrides: list[str]
    frames: int | None
    runs: int


def parsed(text: str, runs: int) -> System:
    """Parse ``NAME[settings]:frames*runs``."""
    match = re.fullmatch(r'(?P<name>[^\[:*]+)(\[(?P<set>[^\]]*)\])?(:(?P<frames>\d+))?(\*(?P<runs>\d+))?', text)
    if match is None:
        raise SystemExit(f"'{text}': expected NAME, NAME:FRAMES, NAME*RUNS or NAME[key=value;...]")
    overrides = [entry for entry in (match['set'] or '').split(';') if entry]
    frames = int(match['frames']) if match['frames'] else None
    return System(text=text, name=match['name'], overrides=overrides, frames=frames, runs=int(match['runs'] or runs))


def in_a_process(system: System, args: argparse.Namespace, seed: int) -> Outcome:
    """Run a system in a new process, so that memory and threads of one run do not affect the next."""
    command = [sys.executable, __file__, args.source, '--width', str(args.width), '--systems', system.text, '--one']
    command += ['--seed', str(seed)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return Outcome(**json.loads(done.stdout.splitlines()[-1]))


def row(system: System, outcomes: list[Outcome], open3d_fps: float | None) -> str:
    """Returns a line of the table: medians with spread, and the smallest number of tracked frames."""
    fps = [o.frames / o.seconds for o in outcomes]

    def known(name: str) -> list[float]:
        return [getattr(o, name) for o in outcomes if getattr(o, name) is not None]

    ratio = '' if open3d_fps is None else f'{statistics.median(fps) / open3d_fps:.2f}'
    cells = [
        f'`{system.text}`', str(len(outcomes)), f'{min(o.tracked for o in outcomes)}/{outcomes[0].frames}',
        spread(fps, 1 if min(fps) > 1 else 3), ratio, spread(known('ate_cm'), 2), spread(known('psnr_db'), 2),
        spread(known('num_gaussians'), 0, False), spread(known('peak_rss_mb'), 0, False),
    ]  # fmt: skip
    return '| ' + ' | '.join(cells) + ' |'


def spread(values: list[float], digits: int, with_extremes: bool = True) -> str:
    """Returns the median, followed by the least and the most value where they differ."""
    if not values:
        return '–'
    median, least, most = (f'{of(values):.{digits}f}' for of in (statistics.median, min, max))
    return f'{median} ({least}–{most})' if with_extremes and least != most else median


def plot(path: Path, systems: list[System], outcomes: dict[str, list[Outcome]], title: str) -> None:
    """Plot trajectory error over frames per second; the recording needs a ground truth."""
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6, 4), layout='constrained')
    ates_cm = [statistics.median(o.ate_cm for o in outcomes[system.text] if o.ate_cm is not None) for system in systems]
    for index, (system, y) in enumerate(zip(systems, ates_cm)):
        x = statistics.median(o.frames / o.seconds for o in outcomes[system.text])
        axes.plot(x, y, 'o')
        axes.annotate(system.text, (x, y), xytext=(5, 4 if index % 2 else -12), textcoords='offset points')
    axes.set(xscale='log', xlabel='frames per second', ylabel='ATE RMSE, cm', title=title, ylim=(0, 1.15 * max(ates_cm)))
    axes.margins(x=0.25)  # room for the names, to the right of their points
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=120)


def main() -> None:
    """Run the systems in turns and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('source')
    parser.add_argument('--width', type=int, default=320)
    parser.add_argument('--runs', type=int, default=5)
    parser.add_argument('--systems', default='realtime,quick,opencv')
    parser.add_argument('--plot', type=Path)
    parser.add_argument('--one', action='store_true', help=argparse.SUPPRESS)
    parser.add_argument('--seed', type=int, default=0, help=argparse.SUPPRESS)
    args = parser.parse_args()
    systems = [parsed(text, args.runs) for text in args.systems.split(',')]
    if args.one:
        print(json.dumps(asdict(run_one(systems[0], args.source, args.width, args.seed))))
        return
    name = f'{Path(args.source).name}, width {args.width}'
    print_header(f'Systems on {name}', args.runs)
    outcomes: dict[str, list[Outcome]] = {system.text: [] for system in systems}
    for turn in range(max(system.runs for system in systems)):
        for system in systems:
            if turn < system.runs:
                outcomes[system.text].append(in_a_process(system, args, turn))
    peer = outcomes.get('open3d')
    peer_fps = statistics.median(o.frames / o.seconds for o in peer) if peer else None
    print('Medians (least–most).\n')
    print('| system | runs | tracked | fps | x Open3D | ATE RMSE cm | PSNR dB | Gaussians | peak MB |')
    print('|' + '---|' * 9)
    for system in systems:
        print(row(system, outcomes[system.text], peer_fps))
    for system in systems:
        runs = [outcome.mean_stages_ms for outcome in outcomes[system.text]]
        if runs[0]:
            stages = (f'{name} {statistics.median(run[name] for run in runs):.1f}' for name in runs[0])
            print(f'\n`{system.text}`, mean ms per frame: ' + ', '.join(stages) + '.')
    print(f'\nPSNR over every {SCORED_EVERY}th frame, final map and poses, pixels with depth.')
    if args.plot:
        plot(args.plot, systems, outcomes, name)


if __name__ == '__main__':
    main()
