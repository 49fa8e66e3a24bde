"""What is said at each frame when a recording is damaged: a covered camera, jumps, no texture, a moving box, and more.

    python benchmarks/faults_injected.py [RECORDING ...] [--frames 150] [--jumps 60] [--seed 0] [--preset realtime] [--width 320]
                                         [--data DIR]

Each fault begins at frame 60 of RECORDING (by default redkitchen_320) and, where it lasts, ends after 15 frames. A line says
what each frame was called (i = initialized, t = tracked, u = uncertain, L = lost), the largest error of a tracked frame against the
ground truth, and how many tracked frames were false: farther off than 10 cm and than three standard deviations. --frames 0 leaves
the faults out.

With --jumps N, N jumps of 2 to 10 frames without a gap in the stamps follow, at places of the whole recording that --seed draws;
each run begins 30 frames before and ends 20 after. Errors are those of the pose relative to the last one before the jump. The
camera is found where one of the first 10 frames is tracked within 10 cm and 6 degrees; `false` counts tracked frames farther off
than 10 cm and three standard deviations, or than 6 degrees.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import numpy as np
from header import print_header

from splatam_core.config import SlamConfig, apply_threads, load_config
from splatam_core.datasets.registry import open_sequence
from splatam_core.evaluation.trajectory import falsely_tracked, trajectory_error
from splatam_core.geometry import se3
from splatam_core.geometry.trajectory import Trajectory, interpolate_poses
from splatam_core.slam import Slam
from splatam_core.types import FrameResult, RgbdFrame, Status

BEGIN, LENGTH = 60, 15
BEFORE, AFTER, SOON = 30, 20, 10  # frames before and after a jump; those within which the camera is found
RIGHT_M, RIGHT_DEG = 0.1, 6.0
JUMP_COLUMNS = (
    'recording', 'jumps', 'found within 10 frames', 'after (mean / most)', 'not found, and said', 'not found, not said', 'false',
)  # fmt: skip
BOX_M, BOX_SHARE = 0.8, 0.32  # distance; share of the width and of the height: a tenth of the view
LETTERS = {Status.INITIALIZED: 'i', Status.TRACKED: 't', Status.UNCERTAIN: 'u', Status.LOST: 'L'}


@dataclass(frozen=True, slots=True, eq=False)
class Damaged:
    """A frame as SLAM gets it.

    Attributes:
        frame: the frame.
        true_ns: stamp of the moment that it shows, where the ground truth has its pose.
    """

    frame: RgbdFrame
    true_ns: int


def unchanged(frames: list[RgbdFrame]) -> Iterator[Damaged]:
    """Yields the frames as they are."""
    for frame in frames:
        yield Damaged(frame, frame.stamp_ns)


def during(change: Callable[[RgbdFrame, int], RgbdFrame]) -> Callable[[list[RgbdFrame]], Iterator[Damaged]]:
    """Returns a fault that changes the frames while it lasts. change: gets a frame and the number of frames since the beginning."""

    def fault(frames: list[RgbdFrame]) -> Iterator[Damaged]:
        for index, frame in enumerate(frames):
            is_damaged = BEGIN <= index < BEGIN + LENGTH
            yield Damaged(change(frame, index - BEGIN) if is_damaged else frame, frame.stamp_ns)

    return fault


def covered(frame: RgbdFrame, _: int) -> RgbdFrame:
    """A hand on the lens."""
    return replace(frame, rgb=np.zeros_like(frame.rgb), depth_m=np.zeros_like(frame.depth_m))


def without_texture(frame: RgbdFrame, _: int) -> RgbdFrame:
    """A blank wall: one colour, and one distance."""
    rng = np.random.default_rng(frame.stamp_ns % 2**32)
    rgb = np.clip(frame.rgb.mean(axis=(0, 1)) + rng.normal(0, 2, frame.rgb.shape), 0, 255).astype(np.uint8)
    depth = np.median(frame.depth_m[frame.depth_m > 0]) + rng.normal(0, 0.005, frame.depth_m.shape)
    return replace(frame, rgb=rgb, depth_m=depth.astype(np.float32))


def with_box(frame: RgbdFrame, count: int) -> RgbdFrame:
    """A patterned box that moves through the view from left to right."""
    rgb, depth = frame.rgb.copy(), frame.depth_m.copy()
    height, width = depth.shape
    tall, wide = round(BOX_SHARE * height), round(BOX_SHARE * width)
    top, left = (height - tall) // 2, round((width - wide) * count / (LENGTH - 1))
    v, u = np.mgrid[:tall, :wide]
    pattern = np.where((u // 8 + v // 8) % 2, 220, 40).astype(np.uint8)
    rgb[top : top + tall, left : left + wide] = pattern[..., None]
    depth[top : top + tall, left : left + wide] = BOX_M
    return replace(frame, rgb=rgb, depth_m=depth)


def exposed(frame: RgbdFrame, count: int) -> RgbdFrame:
    """Exposure that steps up and down every five frames."""
    gain = (1.6, 0.6, 1.3)[count // 5 % 3]
    return replace(frame, rgb=np.clip(gain * frame.rgb.astype(np.float32), 0, 255).astype(np.uint8))


def dropped(frames: list[RgbdFrame]) -> Iterator[Damaged]:
    """Two of three frames are missing while it lasts."""
    for index, frame in enumerate(frames):
        if not (BEGIN <= index < BEGIN + LENGTH and index % 3):
            yield Damaged(frame, frame.stamp_ns)


def doubled(frames: list[RgbdFrame]) -> Iterator[Damaged]:
    """Every second frame is the one before once more, with a stamp of its own."""
    for index, frame in enumerate(frames):
        shown = frames[index - 1] if BEGIN <= index < BEGIN + LENGTH and index % 2 else frame
        yield Damaged(replace(shown, stamp_ns=frame.stamp_ns), shown.stamp_ns)


def jumped(length: int, begin: int = BEGIN) -> Callable[[list[RgbdFrame]], Iterator[Damaged]]:
    """Returns a fault that leaves frames out, and closes the gap in the stamps: the camera cannot have moved like that."""

    def fault(frames: list[RgbdFrame]) -> Iterator[Damaged]:
        for index, frame in enumerate(frames):
            if not begin <= index < begin + length:
                shift = frames[begin + length].stamp_ns - frames[begin].stamp_ns if index >= begin + length else 0
                yield Damaged(replace(frame, stamp_ns=frame.stamp_ns - shift), frame.stamp_ns)

    return fault


FAULTS: dict[str, Callable[[list[RgbdFrame]], Iterator[Damaged]]] = {
    'none': unchanged, 'covered camera': during(covered), 'jump of 10 frames': jumped(10), 'blank wall': during(without_texture),
    'moving box': during(with_box), 'exposure steps': during(exposed), 'frames dropped': dropped, 'frames doubled': doubled,
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What was said, and what was right.

    Attributes:
        results: of the frames.
        errors_m: [N] of all frames with a pose; NaN for the others.
        false: [N] which frames were called tracked and were not.
    """

    results: list[FrameResult]
    errors_m: np.ndarray
    false: np.ndarray

    @property
    def said(self) -> str:
        """What the frames were called, with the number of frames where it is more than one."""
        runs = [(letter, len(list(group))) for letter, group in groupby(LETTERS[result.status] for result in self.results)]
        return ' '.join(letter if count == 1 else f'{letter}{count}' for letter, count in runs)


def run(frames: list[Damaged], ground_truth: Trajectory, config: SlamConfig) -> Outcome:
    """Process frames and compare their poses with the true ones, aligned by the frames that were tracked."""
    slam = Slam(config, num_frames=len(frames))
    results = [slam.process(damaged.frame) for damaged in frames]
    tracked = [index for index, result in enumerate(results) if result.status.is_trusted]
    true_ns = np.array([damaged.true_ns for damaged in frames])
    first_of = {int(true_ns[index]): index for index in reversed(tracked)}  # a doubled frame is compared once
    chosen = sorted(first_of.values(), key=lambda index: true_ns[index])
    error = trajectory_error(Trajectory(true_ns[chosen], np.array([results[index].T_world_cam for index in chosen])), ground_truth)
    known = ((int(true_ns[index]), results[index].covariance) for index in chosen)
    covariances = {stamp_ns: covariance for stamp_ns, covariance in known if covariance is not None}
    errors, false = np.full(len(frames), np.nan), np.zeros(len(frames), bool)
    by_stamp = dict(zip(error.stamps_ns.tolist(), zip(error.errors_m, falsely_tracked(error, covariances))))
    for index in chosen:
        errors[index], false[index] = by_stamp.get(int(true_ns[index]), (np.nan, False))
    return Outcome(results, errors, false)


def faults(frames: list[RgbdFrame], ground_truth: Trajectory, config: SlamConfig) -> None:
    """Print a line for each fault."""
    print('| fault | said | worst tracked cm | false |\n|---|---|---|---|')
    for name, fault in FAULTS.items():
        outcome = run(list(fault(frames)), ground_truth, config)
        print(f'| {name} | {outcome.said} | {100 * np.nanmax(outcome.errors_m):.1f} | {outcome.false.sum()} |', flush=True)


@dataclass(frozen=True, slots=True)
class Landing:
    """What became of a jump.

    Attributes:
        found_after: frames until the camera was tracked at the right place; None where it was not within ten.
        said: whether none of the ten was called tracked.
        false: number of tracked frames at a wrong place.
    """

    found_after: int | None
    said: bool
    false: int


def landing(frames: list[Damaged], ground_truth: Trajectory, config: SlamConfig) -> Landing:
    """Process frames with a jump after the first ``BEFORE`` of them."""
    slam = Slam(config, num_frames=len(frames))
    results = [slam.process(damaged.frame) for damaged in frames]
    true_poses, known = interpolate_poses(ground_truth, np.array([damaged.true_ns for damaged in frames]))
    start = max(index for index in range(BEFORE) if results[index].status.is_trusted and known[index])
    right, false, last = [], 0, results[start].T_world_cam
    assert last is not None
    tracked = [index for index in range(BEFORE, len(frames)) if results[index].status.is_trusted and known[index]]
    for index in tracked:
        pose, covariance = results[index].T_world_cam, results[index].covariance
        assert pose is not None
        error = se3.inverse(se3.inverse(true_poses[start]) @ true_poses[index]) @ se3.inverse(last) @ pose
        off_m, off_deg = np.linalg.norm(error[:3, 3]), np.degrees(np.linalg.norm(se3.rotation_vector(error[:3, :3])))
        claimed_m = 3 * np.sqrt(np.trace(covariance.total[:3, :3])) if covariance is not None else 0.0
        right += [index] if off_m <= RIGHT_M and off_deg <= RIGHT_DEG else []
        false += bool(off_m > max(RIGHT_M, claimed_m) or off_deg > RIGHT_DEG)
    found = right[0] - BEFORE if right and right[0] < BEFORE + SOON else None
    return Landing(found, said=not any(index < BEFORE + SOON for index in tracked), false=false)


def jumps(frames: list[RgbdFrame], ground_truth: Trajectory, config: SlamConfig, rng: np.random.Generator, count: int) -> list[str]:
    """Returns the cells that say what became of random jumps."""
    landings = []
    for _ in range(count):
        length, begin = int(rng.integers(2, 11)), int(rng.integers(BEFORE, len(frames) - AFTER - 12))
        cut = frames[begin - BEFORE : begin + length + AFTER]
        landings.append(landing(list(jumped(length, BEFORE)(cut)), ground_truth, config))
    after = [landing.found_after for landing in landings if landing.found_after is not None]
    not_found = [landing for landing in landings if landing.found_after is None]
    return [
        str(count), str(len(after)), f'{np.mean(after):.1f} / {max(after)}' if after else '–',
        str(sum(landing.said for landing in not_found)), str(sum(not landing.said for landing in not_found)),
        str(sum(landing.false for landing in landings)),
    ]  # fmt: skip


def read(folder: Path, width: int) -> tuple[list[RgbdFrame], Trajectory]:
    """Returns the frames of a recording, and the true poses."""
    sequence = open_sequence(str(folder), width=width)
    ground_truth = sequence.ground_truth()
    if ground_truth is None:
        raise SystemExit(f'{folder} has no ground truth')
    return [sequence[index] for index in range(len(sequence))], ground_truth


def main() -> None:
    """Run everything."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('recordings', nargs='*', default=['redkitchen_320'])
    parser.add_argument('--preset', default='realtime')
    parser.add_argument('--width', type=int, default=320)
    parser.add_argument('--frames', type=int, default=150)
    parser.add_argument('--jumps', type=int, default=0)
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--data', type=Path, default=Path(os.environ.get('SPLATAM_DATA', '../shared/data')))
    parser.add_argument('--set', dest='overrides', action='append', default=[], metavar='KEY=VALUE')
    args = parser.parse_args()
    config = load_config(args.preset, ['threads=1', *args.overrides])
    apply_threads(config)
    print_header(f'Faults, preset `{args.preset}`, width {args.width}, one thread', 1)
    if args.frames:
        for recording in args.recordings:
            frames, ground_truth = read(args.data / recording, args.width)
            print(f'\n{recording}\n')
            faults(frames[: args.frames], ground_truth, config)
    if args.jumps:
        print('\n| ' + ' | '.join(JUMP_COLUMNS) + ' |\n|' + '---|' * len(JUMP_COLUMNS))
        for recording in args.recordings:
            rng = np.random.default_rng(args.seed)
            cells = [recording, *jumps(*read(args.data / recording, args.width), config, rng, args.jumps)]
            print('| ' + ' | '.join(cells) + ' |', flush=True)


if __name__ == '__main__':
    main()
