"""How consistent a map is where the camera comes back: online and final trajectory, loops, and what the graph costs.

    python benchmarks/consistency.py [RECORDING ...] [--preset realtime] [--width 320] [--runs 1] [--data DIR] [--set KEY=VALUE]
        [--cost]

RECORDING is a folder in DIR, FOLDER:START:END for some of its frames, ``corridor:N`` for N synthetic frames along the wall of
growth.py and N back, ``wall:N`` for the way there alone, or ``ring:N`` for once around the ring of ring.py in N frames and a
tenth of it again. Run k has seed k and one thread. A loop is false if it differs from the ground truth by more than 8 cm. `graph`
is the time in the graph, as a share of the whole; `slowest` the longest of a frame. `PSNR` is that of the final map at the final
poses, every 10th frame; `again` that of the frames that see a synthetic place for the second time.

With --cost the same frames go through a SLAM without and one with the graph, in turn, and the processor time of both is compared,
so that other work on the machine hardly counts: `more` is what the graph adds; `growth` the time of the last hundred frames
relative to frames 200 to 299; `part` the graph's time in a frame: mean, that of 99 in 100, and the longest; `ms per loop` what is
not spent on keyframes that follow each other, by the number of loops; `kB` what the graph and the places hold of a keyframe,
beside its images.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import growth
import numpy as np
import ring
from header import print_header
from numpy.typing import NDArray

from splatam_core.config import SlamConfig, apply_threads, load_config
from splatam_core.datasets.registry import open_sequence
from splatam_core.evaluation.trajectory import trajectory_error
from splatam_core.geometry import se3
from splatam_core.geometry.trajectory import Trajectory, interpolate_poses
from splatam_core.slam import Slam
from splatam_core.types import FrameResult, RgbdFrame, Status

RECORDINGS = ('redkitchen_320:0:1000', 'redkitchen_320:300:600', 'fr1_rpy_320:0:430', 'd435_desk', 'corridor:500', 'ring:500')
COLUMNS = (
    'recording', 'seed', 'frames', 'uncertain', 'lost', 'ATE cm online', 'final', 'end cm online', 'final', 'loops', 'false',
    'corrections', 'ms per frame', 'graph %', 'slowest ms', 'Gaussians', 'PSNR dB', 'again',
)  # fmt: skip
COST_COLUMNS = (
    'recording', 'seed', 'frames', 'CPU ms without', 'with', 'more', 'growth without', 'with', 'part ms', 'of 99', 'longest',
    'loops', 'corrections', 'ms per loop', 'kB',
)  # fmt: skip
KEY_BYTES = 16  # of a feature, beside what a checkpoint holds
FALSE_M = 0.08


SCORED_EVERY = 10


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Frames and their true poses.

    Attributes:
        length: number of frames.
        frame: returns the frame of a number.
        ground_truth: the true poses.
        again_from: number of the first frame that sees a place again; the length where that is not known.
    """

    length: int
    frame: Callable[[int], RgbdFrame]
    ground_truth: Trajectory
    again_from: int


def opened(name: str, args: argparse.Namespace) -> Recording:
    """Opens a recording, or makes a synthetic one."""
    folder, *limits = name.split(':')
    if folder in ('corridor', 'ring', 'wall'):
        return synthetic(folder, int(limits[0]), args.width)
    start, end = (int(limits[0]), int(limits[1])) if limits else (0, None)
    max_frames = None if end is None else end - start
    sequence = open_sequence(str(args.data / folder), width=args.width, start=start, max_frames=max_frames)
    ground_truth = sequence.ground_truth()
    if ground_truth is None:
        raise SystemExit(f'{name} has no ground truth')
    return Recording(len(sequence), sequence.__getitem__, ground_truth, len(sequence))


def synthetic(kind: str, count: int, width: int) -> Recording:
    """Makes the corridor, there and back or there only, or the ring. Each frame has noise of its own, the same every time."""
    cam = growth.camera(width)
    if kind == 'wall':
        poses, again_from = [growth.pose(place) for place in range(count)], count
    elif kind == 'corridor':
        poses, again_from = [growth.pose(place) for place in (*range(count), *reversed(range(count)))], count
    else:
        poses, again_from = [ring.pose(place, count) for place in range(count + count // 10)], count
    stamps_ns = 10**9 + np.arange(len(poses)) * 33_333_333

    def frame(index: int) -> RgbdFrame:
        T, stamp_ns, rng = poses[index], int(stamps_ns[index]), np.random.default_rng(index)
        return ring.frame_at(T, stamp_ns, count, cam, rng) if kind == 'ring' else growth.frame_at(T, stamp_ns, cam, rng)

    return Recording(len(poses), frame, Trajectory(stamps_ns, np.array(poses)), again_from)


def row(name: str, seed: int, args: argparse.Namespace) -> str:
    """Runs the preset on a recording. Returns a line of the table."""
    config = load_config(args.preset, ['threads=1', f'seed={seed}', *args.overrides])
    apply_threads(config)
    recording = opened(name, args)
    slam = Slam(config, num_frames=recording.length)
    results = [slam.process(recording.frame(index)) for index in range(recording.length)]
    online = poses(results)
    slam.finish()
    final = Trajectory(online.stamps_ns, slam.graph.corrected(online.stamps_ns, online.T_world_cam))
    loops = loop_errors_m(slam, recording.ground_truth)
    total, graph = (np.array([getattr(result.timings, stage) for result in results]) for stage in ('total', 'graph'))
    errors = [trajectory_error(estimate, recording.ground_truth) for estimate in (online, final)]
    ends = [end_error_m(estimate, recording.ground_truth) for estimate in (online, final)]
    cells = [
        name, seed, len(results), *(sum(r.status is status for r in results) for status in (Status.UNCERTAIN, Status.LOST)),
        *(f'{100 * error.rmse_m:.2f}' for error in errors), *(f'{100 * end:.1f}' for end in ends), len(loops),
        int((loops > FALSE_M).sum()), slam.graph.num_corrections, f'{total.mean():.1f}', f'{100 * graph.sum() / total.sum():.1f}',
        f'{graph.max():.0f}', slam.num_gaussians, *psnr_db(slam, recording, final),
    ]  # fmt: skip
    return '| ' + ' | '.join(map(str, cells)) + ' |'


def time_method(owner: object, name: str, taken_ms: list[float]) -> None:
    """Appends to a list what each call of a method takes from now on."""
    function = getattr(owner, name)

    def timed(*arguments: Any, **options: Any) -> Any:
        start = time.process_time()
        try:
            return function(*arguments, **options)
        finally:
            taken_ms.append(1e3 * (time.process_time() - start))

    vars(owner)[name] = timed


class Timed:
    """A SLAM whose processor time is taken.

    Attributes:
        slam: it.
        frames_ms: of each frame.
        graph_ms: of the graph, in each tracked frame, with the correction of the map.
        joins_ms: of each alignment of keyframes that follow each other, part of that.
    """

    def __init__(self, config: SlamConfig, length: int) -> None:
        self.slam, self.frames_ms = Slam(config, num_frames=length), list[float]()
        self.graph_ms, self.joins_ms = list[float](), list[float]()
        time_method(self.slam, '_follow_graph', self.graph_ms)
        time_method(self.slam.graph, '_join', self.joins_ms)

    def process(self, frame: RgbdFrame) -> None:
        """Processes a frame."""
        start = time.process_time()
        self.slam.process(frame)
        self.frames_ms.append(1e3 * (time.process_time() - start))

    @property
    def growth(self) -> str:
        """How much longer a frame takes at the end than at the beginning; nothing where there are too few."""
        return f'{np.mean(self.frames_ms[-100:]) / np.mean(self.frames_ms[200:300]):.2f}' if len(self.frames_ms) >= 500 else ''


def cost_row(name: str, seed: int, args: argparse.Namespace) -> str:
    """Runs the preset with and without the graph, frame by frame in turn. Returns a line of the table."""
    recording = opened(name, args)
    overrides = ['threads=1', f'seed={seed}', *args.overrides]
    configs = [load_config(args.preset, [*overrides, f'graph.enabled={on}']) for on in ('false', 'true')]
    apply_threads(configs[0])
    both = plain, graphed = [Timed(config, recording.length) for config in configs]
    for index in range(recording.length):
        frame = recording.frame(index)
        for timed in both:
            timed.process(frame)
    graph, frames_ms = np.array(graphed.graph_ms), [np.mean(timed.frames_ms) for timed in both]
    slam = graphed.slam
    arrays = [*slam.graph.arrays().values(), *slam.places.arrays().values()]
    kept = sum(array.nbytes for array in arrays) + KEY_BYTES * len(slam.places.arrays()['points'])
    loops, for_loops_ms = slam.graph.num_loops, graph.sum() - sum(graphed.joins_ms)
    cells = [
        name, seed, recording.length, *(f'{ms:.1f}' for ms in frames_ms), f'{100 * (frames_ms[1] / frames_ms[0] - 1):.1f} %',
        plain.growth, graphed.growth, *(f'{ms:.1f}' for ms in (graph.mean(), np.percentile(graph, 99), graph.max())), loops,
        slam.graph.num_corrections, f'{for_loops_ms / loops:.0f}' if loops else '', f'{1e-3 * kept / len(slam.keyframes):.0f}',
    ]  # fmt: skip
    return '| ' + ' | '.join(map(str, cells)) + ' |'


def poses(results: list[FrameResult]) -> Trajectory:
    """Returns the poses of the frames that have one."""
    posed = [(result.stamp_ns, result.T_world_cam) for result in results if result.T_world_cam is not None]
    return Trajectory(np.array([stamp_ns for stamp_ns, _ in posed]), np.array([T for _, T in posed]))


def psnr_db(slam: Slam, recording: Recording, final: Trajectory) -> list[str]:
    """Returns the mean PSNR of some frames, and of those that see a place again."""
    posed, scores = dict(zip(final.stamps_ns.tolist(), final.T_world_cam)), {}
    for index in range(0, recording.length, SCORED_EVERY):
        frame = recording.frame(index)
        if frame.stamp_ns in posed:
            rendered, seen = slam.render(posed[frame.stamp_ns]).rgb.astype(np.float64), frame.depth_m > 0
            scores[index] = -10 * np.log10(np.mean(np.square((rendered - frame.rgb)[seen] / 255)))
    parts = list(scores.values()), [score for index, score in scores.items() if index >= recording.again_from]
    return [f'{np.mean(part):.2f}' if part else '' for part in parts]


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
    parser.add_argument('--cost', action='store_true', help='compare the processor time with that without the graph')
    args = parser.parse_args()
    print_header(f'Preset `{args.preset}`, width {args.width}, one thread', args.runs)
    columns, make_row = (COST_COLUMNS, cost_row) if args.cost else (COLUMNS, row)
    print('| ' + ' | '.join(columns) + ' |\n|' + '---|' * len(columns))
    for name in args.recordings:
        for seed in range(args.runs):
            print(make_row(name, seed, args), flush=True)


if __name__ == '__main__':
    main()
