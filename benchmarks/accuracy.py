"""Accuracy of a preset on many recordings, beside Open3D's dense SLAM and OpenCV's RGB-D odometry on the same frames.

    python benchmarks/accuracy.py [RECORDING ...] [--runs 5] [--systems realtime,open3d,opencv] [--width 320] [--data DIR]
                                  [--out out/benchmarks/accuracy] [--limit-s 280] [--plots docs/images] [--html FILE]

RECORDING is a folder in DIR, or FOLDER:START:END for some of its frames; without any, all recordings of DIR that are 320 pixels
wide are taken. Run k of a preset has seed k and one thread, so that it can be repeated bit for bit on the same kind of processor;
the others run once. Each run leaves a file in --out, a folder for one set of settings. A call goes on where the last one has
stopped, and begins no further run after --limit-s seconds. Once all files are there it prints the table, and draws a picture of
each recording into --plots.

Numbers are medians (least and most), counts of frames those of the worst run. `longest` is the longest stretch of frames that
were not tracked. ATE, RPE and `worst` are those of all frames with a pose, tracked and uncertain. `false` counts tracked frames
farther off than 10 cm and than three standard deviations. `deviations` is the median error of the pose relative to that ten frames
before, in standard deviations (0.95 if they are true); the noise of the ground truth counts as below.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path

import numpy as np
from header import print_header
from systems import run_open3d, run_opencv

from splatam_core.config import apply_threads, load_config
from splatam_core.datasets.base import Sequence as Recording
from splatam_core.datasets.registry import open_sequence
from splatam_core.evaluation.calibration import TruthNoise, normalized_errors
from splatam_core.evaluation.report.tables import Table, page
from splatam_core.evaluation.trajectory import falsely_tracked, relative_pose_errors, trajectory_error
from splatam_core.geometry import se3
from splatam_core.geometry.trajectory import Trajectory, interpolate_poses
from splatam_core.runs import provenance
from splatam_core.slam import Slam
from splatam_core.types import PoseCovariance

RECORDINGS = (
    'redkitchen_320', 'redkitchen_320:0:300', 'redkitchen_320:300:600', 'fr1_rpy_320', 'fr1_rpy_320:180:430', 'd435_desk',
)  # fmt: skip
PEERS = {'open3d': run_open3d, 'opencv': run_opencv}
COLUMNS = (
    'recording', 'system', 'runs', 'frames', 'uncertain', 'lost', 'longest', 'false', 'ATE cm', 'ATE tracked cm', 'worst cm',
    'worst tracked cm', 'RPE mm', 'RPE deg', 'deviations', 'Gaussians',
)  # fmt: skip
TRUTH_NOISE = {
    'redkitchen_320': TruthNoise(0.005, np.radians(0.2)),  # KinectFusion, consistent to about half a centimetre
    'fr1_rpy_320': TruthNoise(0.001, np.radians(0.2)),  # motion capture
    'd435_desk': TruthNoise(0.003, np.radians(0.15)),  # a tracking camera, smooth from frame to frame
}
"""Of a pose relative to that ten frames before."""


@dataclass(frozen=True, slots=True)
class Job:
    """One run: a recording, as on the command line, a preset or peer, and a seed."""

    recording: str
    system: str
    seed: int

    @property
    def title(self) -> str:
        """The recording in words."""
        return self.recording.replace(':', ' ', 1).replace(':', '..')

    @property
    def file_name(self) -> str:
        """Of the result, without its suffix."""
        return f'{self.recording.replace(":", "_")}-{self.system}-{self.seed}'

    def frames(self, data: Path, width: int) -> Recording:
        """Opens the recording."""
        folder, start, end = (*self.recording.split(':'), '', '')[:3]
        max_frames = int(end) - int(start or 0) if end else None
        return open_sequence(str(data / folder), width=width, start=int(start or 0), max_frames=max_frames)


@dataclass(frozen=True, slots=True, eq=False)
class Said:
    """What a system says about a frame: its pose (None = lost), whether that may be trusted, and for a preset its covariance."""

    stamp_ns: int
    T_world_cam: np.ndarray | None
    is_trusted: bool
    covariance: PoseCovariance | None = None


@dataclass(frozen=True, slots=True)
class Outcome:
    """What came of a run: numbers of frames, errors, their size in standard deviations, size of the map.

    Attributes:
        commit: of the code.
        errors_m: for each frame after alignment; None without a pose.
        steps_m: for each frame, error of the motion since the frame before; None without a pose of both.
        trusted: for each frame, whether it was called tracked.
    """

    commit: str
    frames: int
    uncertain: int
    lost: int
    longest: int
    false: int
    ate_m: float
    ate_tracked_m: float
    worst_m: float
    worst_tracked_m: float
    rpe_m: float
    rpe_deg: float
    deviations: float | None
    num_gaussians: int
    errors_m: list[float | None]
    steps_m: list[float | None]
    trusted: list[bool]


def run(job: Job, args: argparse.Namespace) -> Outcome:
    """Runs a system on a recording."""
    sequence = job.frames(args.data, args.width)
    ground_truth, num_gaussians = sequence.ground_truth(), 0
    if ground_truth is None:
        raise SystemExit(f'{job.recording} has no ground truth')
    if job.system in PEERS:
        frames = [sequence[index] for index in range(len(sequence))]
        poses = PEERS[job.system](frames).poses
        said = [Said(frame.stamp_ns, pose, pose is not None) for frame, pose in zip(frames, poses, strict=True)]
    else:
        config = load_config(job.system, ['threads=1', f'seed={job.seed}', *args.overrides])
        apply_threads(config)
        slam = Slam(config, num_frames=len(sequence))
        results = [slam.process(sequence[index]) for index in range(len(sequence))]
        said = [Said(result.stamp_ns, result.T_world_cam, result.status.is_trusted, result.covariance) for result in results]
        num_gaussians = slam.num_gaussians
    noise = TRUTH_NOISE.get(job.recording.partition(':')[0], TruthNoise())
    return outcome(said, ground_truth, noise, num_gaussians)


def outcome(said: Sequence[Said], ground_truth: Trajectory, noise: TruthNoise, num_gaussians: int) -> Outcome:
    """Compares what was said with the ground truth."""
    estimate, tracked = trajectory(said), trajectory([frame for frame in said if frame.is_trusted])
    lost_ns = [frame.stamp_ns for frame in said if frame.T_world_cam is None]
    covariances = {frame.stamp_ns: frame.covariance for frame in said if frame.covariance is not None}
    error, tracked_error = trajectory_error(estimate, ground_truth), trajectory_error(tracked, ground_truth)
    per_frame, _ = relative_pose_errors(estimate, ground_truth, lost_ns)
    deviations = normalized_errors(estimate, ground_truth, covariances, noise=noise)
    by_stamp = dict(zip(error.stamps_ns.tolist(), error.errors_m.tolist()))
    steps = step_errors(estimate, ground_truth)
    return Outcome(
        commit=provenance.commit() or 'unknown',
        frames=len(said),
        uncertain=sum(frame.T_world_cam is not None and not frame.is_trusted for frame in said),
        lost=len(lost_ns),
        longest=max(
            (len(list(group)) for is_trusted, group in groupby(said, lambda frame: frame.is_trusted) if not is_trusted), default=0
        ),
        false=int(falsely_tracked(tracked_error, covariances).sum()) if covariances else 0,
        ate_m=error.rmse_m,
        ate_tracked_m=tracked_error.rmse_m,
        worst_m=float(error.errors_m.max()),
        worst_tracked_m=float(tracked_error.errors_m.max()),
        rpe_m=per_frame.translation_rmse_m or 0.0,
        rpe_deg=per_frame.rotation_rmse_deg or 0.0,
        deviations=float(np.median(deviations)) if len(deviations) else None,
        num_gaussians=num_gaussians,
        errors_m=[by_stamp.get(frame.stamp_ns) for frame in said],
        steps_m=[steps.get(frame.stamp_ns) for frame in said],
        trusted=[frame.is_trusted for frame in said],
    )


def trajectory(said: Sequence[Said]) -> Trajectory:
    """Returns the poses of the frames that have one."""
    posed = [(frame.stamp_ns, frame.T_world_cam) for frame in said if frame.T_world_cam is not None]
    return Trajectory(np.array([stamp_ns for stamp_ns, _ in posed]), np.array([pose for _, pose in posed]))


def step_errors(estimate: Trajectory, ground_truth: Trajectory) -> dict[int, float]:
    """Returns the error in metres of the motion to each frame, by its stamp, from the one before with a pose."""
    true_poses, known = interpolate_poses(ground_truth, estimate.stamps_ns)
    poses = estimate.T_world_cam
    motion, true_motion = (se3.inverse(T[:-1]) @ T[1:] for T in (poses, true_poses))
    errors = np.linalg.norm((se3.inverse(true_motion) @ motion)[:, :3, 3], axis=1)
    both = known[:-1] & known[1:]
    return dict(zip(estimate.stamps_ns[1:][both].tolist(), errors[both].tolist()))


def row(job: Job, outcomes: list[Outcome]) -> list[str]:
    """Returns the cells of a line of the table."""

    def spread(of: Callable[[Outcome], float], digits: int) -> str:
        values = sorted(map(of, outcomes))
        median, least, most = (f'{value:.{digits}f}' for value in (statistics.median(values), values[0], values[-1]))
        return median if least == most else f'{median} ({least}–{most})'

    counts = ('uncertain', 'lost', 'longest', 'false')
    is_peer = job.system in PEERS
    return [
        job.title, job.system, str(len(outcomes)), str(outcomes[0].frames),
        *('–' if is_peer and count == 'false' else str(max(getattr(o, count) for o in outcomes)) for count in counts),
        spread(lambda o: 100 * o.ate_m, 2), '–' if is_peer else spread(lambda o: 100 * o.ate_tracked_m, 2),
        spread(lambda o: 100 * o.worst_m, 1), '–' if is_peer else spread(lambda o: 100 * o.worst_tracked_m, 1),
        spread(lambda o: 1000 * o.rpe_m, 1), spread(lambda o: o.rpe_deg, 2),
        '–' if is_peer else spread(lambda o: o.deviations or 0.0, 2), '–' if is_peer else spread(lambda o: o.num_gaussians, 0),
    ]  # fmt: skip


def plot(path: Path, title: str, outcomes: dict[str, Outcome]) -> None:
    """Draws the error of each frame, and of each motion from frame to frame, of one run of each system."""
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot

    figure, (above, below) = pyplot.subplots(2, 1, figsize=(8, 5), sharex=True, layout='constrained')
    for system, found in outcomes.items():
        style = {'lw': 0.8, 'alpha': 0.7} if system in PEERS else {'lw': 1.2, 'zorder': 3}
        for axes, values, factor in ((above, found.errors_m, 100), (below, found.steps_m, 1000)):
            axes.plot(factor * np.array([np.nan if value is None else value for value in values]), label=system, **style)
        if system not in PEERS:
            for index in np.flatnonzero(~np.array(found.trusted)):
                above.axvspan(index - 0.5, index + 0.5, color='0.85', lw=0)
    above.set(ylabel='error, cm', title=title, ylim=(0, None))
    below.set(ylabel='error of the step, mm', xlabel='frame', yscale='log')
    above.legend(loc='upper left', fontsize='small')
    for axes in (above, below):
        axes.grid(alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
    pyplot.close(figure)


def run_missing(jobs: list[Job], args: argparse.Namespace) -> int:
    """Runs what has no result yet, as long as there is time. Returns the number of runs that are left."""
    begin, missing = time.monotonic(), [job for job in jobs if not (args.out / f'{job.file_name}.json').exists()]
    while missing and time.monotonic() - begin < args.limit_s:
        job = missing.pop(0)
        text = json.dumps(asdict(run(job, args)))
        unfinished = args.out / f'.{job.file_name}.unfinished'
        unfinished.write_text(text)
        unfinished.rename(args.out / f'{job.file_name}.json')
    return len(missing)


def main() -> None:
    """Run what is missing; print the table once nothing is."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('recordings', nargs='*', default=RECORDINGS)
    parser.add_argument('--systems', default='realtime,open3d,opencv')
    parser.add_argument('--width', type=int, default=320)
    parser.add_argument('--runs', type=int, default=5)
    parser.add_argument('--data', type=Path, default=Path(os.environ.get('SPLATAM_DATA', '../shared/data')))
    parser.add_argument('--out', type=Path, default=Path('out/benchmarks/accuracy'))
    parser.add_argument('--limit-s', type=float, default=float('inf'))
    parser.add_argument('--plots', type=Path)
    parser.add_argument('--html', type=Path, help='write the table as a page, too')
    parser.add_argument('--set', dest='overrides', action='append', default=[], metavar='KEY=VALUE')
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    systems = args.systems.split(',')
    jobs = [
        Job(recording, system, seed)
        for recording in args.recordings for system in systems for seed in range(1 if system in PEERS else args.runs)
    ]  # fmt: skip
    if left := run_missing(jobs, args):
        print(f'{len(jobs) - left} of {len(jobs)} runs are done')
        return
    outcomes = {job: Outcome(**json.loads((args.out / f'{job.file_name}.json').read_text())) for job in jobs}
    print_header(f'Accuracy, width {args.width}, one thread', args.runs)
    print(f'Results of commit {", ".join(sorted({found.commit[:10] for found in outcomes.values()}))}.\n')
    rows = []
    for recording in args.recordings:
        middle = {}
        for system in systems:
            runs = [outcomes[job] for job in jobs if (job.recording, job.system) == (recording, system)]
            rows.append(row(Job(recording, system, 0), runs))
            middle[system] = sorted(runs, key=lambda found: found.ate_m)[len(runs) // 2]
        if args.plots:
            job = Job(recording, '', 0)
            plot(args.plots / f'accuracy_{recording.replace(":", "_")}.png', job.title, middle)
    table = Table('', COLUMNS, rows)
    print(table.markdown())
    if args.html:
        args.html.write_text(page('Accuracy', f'width {args.width}, one thread, runs: {args.runs}', [table]))


if __name__ == '__main__':
    main()
