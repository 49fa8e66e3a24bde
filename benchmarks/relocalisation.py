"""Kidnapped cameras: in how many of 100 joins the camera finds where it is, and in how many of 50 it believes a wrong place.

    python benchmarks/relocalisation.py [RECORDING:SPLIT ...] [--joins 100] [--strangers 50] [--lost 150] [--maps DIR]
        [--data DIR] [--preset realtime] [--width 320] [--set KEY=VALUE]

A map is made of the frames before SPLIT, once, and kept in --maps. From its end, without a gap in the stamps, the camera jumps

- to frames from SPLIT on that the map has seen from within 30 degrees and half a metre (by the ground truth), but not from the
  last frame: `right` counts joins whose first tracked frame is at most 15 cm and 8 degrees off, within 10 frames;
- to strangers: frames of the other recordings; `accepted` counts joins with a tracked frame among 30;
- to frames from SPLIT on that the map has not seen like that: there may be something of the map in view, so that only a pose that
  is farther off is wrong.

`frames` is the median number of frames until the camera is tracked. `CPU ms` is the time of a frame while the camera is lost. At
the end the camera stays with a stranger for --lost frames: how many cores that takes at 30 Hz, in its first second and after it.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from header import print_header

from splatam_core.config import SlamConfig, apply_threads, load_config
from splatam_core.datasets.base import Sequence
from splatam_core.datasets.registry import open_sequence
from splatam_core.evaluation.trajectory import align_poses
from splatam_core.geometry import se3
from splatam_core.geometry.trajectory import interpolate_poses
from splatam_core.runs.checkpoints import Checkpoints, Progress, read_newest
from splatam_core.runs.resume import frame_digest
from splatam_core.slam import Slam
from splatam_core.state import SlamState
from splatam_core.types import RgbdFrame

RECORDINGS = 'redkitchen_320:600', 'fr1_rpy_320:115', 'd435_desk:175'  # where there are most frames to join
NEAR_M, NEAR_DEG = 0.5, 30.0
RIGHT_M, RIGHT_DEG = 0.15, 8.0
WITHIN, STRANGERS_FOR = 10, 30  # frames
STEP_NS, RATE = 33_333_333, 30
POSES = 'poses.npz'


@dataclass(frozen=True, slots=True, eq=False)
class Mapped:
    """A recording whose first frames are mapped.

    Attributes:
        name: of the recording.
        split: number of frames that are mapped.
        frames: of the recording.
        state: of SLAM after the mapped frames.
        true: [N, 4, 4] poses of all frames in the world of the map.
        known: [N] which frames have such a pose.
    """

    name: str
    split: int
    frames: Sequence
    state: SlamState
    true: np.ndarray
    known: np.ndarray

    def is_seen(self, index: int) -> bool:
        """Returns whether a frame was seen before from near."""
        return any(apart(self.true[index], self.true[other]) for other in np.flatnonzero(self.known[: self.split]))


@dataclass(slots=True)
class Tally:
    """What came of a number of joins.

    Attributes:
        joins: how many.
        right: those that found the camera.
        wrong: those that believed another place: the frame and its error in m and degrees.
        never: those that found nothing: the frame.
        waited: frames until the camera was found.
        cpu_ms: of the frames while it was lost.
    """

    joins: int = 0
    right: int = 0
    wrong: list[str] = field(default_factory=list)
    never: list[int] = field(default_factory=list)
    waited: list[int] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)


def apart(first: np.ndarray, second: np.ndarray, max_m: float = NEAR_M, max_deg: float = NEAR_DEG) -> bool:
    """Returns whether two poses are near each other."""
    off_m, off_deg = error(first, second)
    return off_m < max_m and off_deg < max_deg


def error(first: np.ndarray, second: np.ndarray) -> tuple[float, float]:
    """Returns how far two poses are apart, in metres and degrees."""
    turn = se3.rotation_vector(first[:3, :3].T @ second[:3, :3])
    return float(np.linalg.norm(first[:3, 3] - second[:3, 3])), float(np.degrees(np.linalg.norm(turn)))


def mapped(text: str, folder: Path, data: Path, width: int, config: SlamConfig) -> Mapped:
    """Maps the first frames of a recording, or reads what was kept of that."""
    name, _, split = text.partition(':')
    frames, kept = open_sequence(str(data / name), width=width), folder / text.replace(':', '_')
    if not (kept / POSES).is_file():
        make_map(frames, int(split), kept, config)
    checkpoint, poses = read_newest(kept), np.load(kept / POSES)
    ground_truth = frames.ground_truth()
    if ground_truth is None:
        raise SystemExit(f'{name} has no ground truth')
    true, known = interpolate_poses(ground_truth, poses['stamps_ns'])
    usable = known[: int(split)] & poses['tracked']
    T = align_poses(true[: int(split)][usable], poses['T_world_cam'][usable])
    return Mapped(name, int(split), frames, replace(checkpoint.state, config=config), T @ true, known)


def make_map(frames: Sequence, split: int, folder: Path, config: SlamConfig) -> None:
    """Maps the first frames of a recording, and keeps state, poses and all stamps in a folder."""
    slam = Slam(config, num_frames=len(frames))
    results = [slam.process(frames[index]) for index in range(split)]
    progress = Progress(len(frames), split - 1, frame_digest(frames[split - 1]), split)
    Checkpoints(folder, keep=1).save(slam.state(), progress)
    np.savez(
        folder / POSES,
        stamps_ns=np.array([frames[index].stamp_ns for index in range(len(frames))]),
        T_world_cam=np.array([np.eye(4) if result.T_world_cam is None else result.T_world_cam for result in results]),
        tracked=np.array([result.status.is_trusted for result in results]),
    )


def join(slam: Slam, state: SlamState, frames: list[RgbdFrame], tally: Tally) -> tuple[int, np.ndarray] | None:
    """Lets a camera jump to some frames. Returns the number of the first one that is tracked, and its pose; None if none is."""
    slam.restore(state)
    assert state.last_stamp_ns is not None and state.camera is not None
    for count, frame in enumerate(frames):
        start = time.process_time()
        result = slam.process(replace(frame, stamp_ns=state.last_stamp_ns + (count + 1) * STEP_NS, camera=state.camera))
        if result.status.is_trusted:
            assert result.T_world_cam is not None
            return count, result.T_world_cam
        tally.cpu_ms.append(1e3 * (time.process_time() - start))
    return None


def kidnap(slam: Slam, place: Mapped, chosen: np.ndarray) -> Tally:
    """Lets the camera jump to frames of the same recording."""
    tally = Tally(joins=len(chosen))
    for index in chosen.tolist():
        frames = [place.frames[other] for other in range(index, min(index + WITHIN, len(place.frames)))]
        found = join(slam, place.state, frames, tally)
        if found is None:
            tally.never.append(index)
            continue
        count, T_world_cam = found
        off_m, off_deg = error(T_world_cam, place.true[index + count])
        tally.waited.append(count + 1)
        if off_m <= RIGHT_M and off_deg <= RIGHT_DEG:
            tally.right += 1
        else:
            tally.wrong.append(f'{index} ({off_m:.2f} m, {off_deg:.0f} deg)')
    return tally


def meet_strangers(slam: Slam, place: Mapped, others: list[Sequence], count: int, rng: np.random.Generator) -> Tally:
    """Lets the camera jump to frames of other recordings."""
    tally = Tally(joins=count)
    for number in range(count):
        frames = others[number % len(others)]
        first = int(rng.integers(len(frames) - STRANGERS_FOR))
        found = join(slam, place.state, [frames[index] for index in range(first, first + STRANGERS_FOR)], tally)
        if found is not None:
            tally.wrong.append(f'{number % len(others)}:{first + found[0]}')
    return tally


def stay_lost(slam: Slam, place: Mapped, frames: Sequence, count: int) -> tuple[float, float]:
    """Shows a stranger for some frames. Returns how many cores it takes at 30 Hz: in its first second, and after it."""
    tally = Tally()
    join(slam, place.state, [frames[index % len(frames)] for index in range(count)], tally)
    first_s, later_s = (1e-3 * float(np.mean(part)) for part in (tally.cpu_ms[:RATE], tally.cpu_ms[RATE:]))
    return RATE * first_s, RATE * later_s


def chosen_joins(place: Mapped, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Returns frames that were seen before, and some that were not."""
    later = [index for index in np.flatnonzero(place.known).tolist() if index >= place.split and index + 1 < len(place.frames)]
    last = place.true[place.split - 1]
    seen = np.array([index for index in later if not apart(place.true[index], last) and place.is_seen(index)], int)
    unseen = np.array([index for index in later if not place.is_seen(index)], int)
    return np.sort(rng.permutation(seen)[:count]), np.sort(rng.permutation(unseen)[: count // 4])


def main() -> None:
    """Run everything."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('recordings', nargs='*', default=RECORDINGS)
    parser.add_argument('--joins', type=int, default=100)
    parser.add_argument('--strangers', type=int, default=50)
    parser.add_argument('--lost', type=int, default=150)
    parser.add_argument('--maps', type=Path, default=Path('out/relocalisation'))
    parser.add_argument('--data', type=Path, default=Path(os.environ.get('SPLATAM_DATA', '../shared/data')))
    parser.add_argument('--preset', default='realtime')
    parser.add_argument('--width', type=int, default=320)
    parser.add_argument('--set', dest='overrides', action='append', default=[], metavar='KEY=VALUE')
    args = parser.parse_args()
    config = load_config(args.preset, ['threads=1', *args.overrides])
    apply_threads(config)
    print_header(f'Kidnapped cameras, preset `{args.preset}`, width {args.width}, one thread', 1)
    print('| map | joins | joined | right | wrong | never | frames | CPU ms |\n|---|---|---|---|---|---|---|---|')
    details = []
    for text in args.recordings:
        place, rng = mapped(text, args.maps, args.data, args.width, config), np.random.default_rng(0)
        names = [name for name in (entry.partition(':')[0] for entry in RECORDINGS) if name != place.name]
        others = [open_sequence(str(args.data / name), width=args.width) for name in names]
        seen, unseen = chosen_joins(place, args.joins, rng)
        slam = Slam(config)
        tallies = {'seen before': kidnap(slam, place, seen)}
        tallies['strangers'] = meet_strangers(slam, place, others, args.strangers, rng)
        tallies['not seen before'] = kidnap(slam, place, unseen)
        for kind, tally in tallies.items():
            waited, cpu_ms = (f'{np.median(values):.0f}' if values else '' for values in (tally.waited, tally.cpu_ms))
            never = tally.joins - tally.right - len(tally.wrong)
            print(
                f'| {text} | {kind} | {tally.joins} | {tally.right} | {len(tally.wrong)} | {never} | {waited} | {cpu_ms} |',
                flush=True,
            )
            details.append(f'{text}, {kind}: wrong {", ".join(tally.wrong) or "none"}; never {tally.never}')
        if args.lost > RATE:
            first, later = stay_lost(slam, place, others[0], args.lost)
            details.append(f'{text}, lost: {first:.2f} cores in the first second, {later:.2f} after it')
    print('\n' + '\n'.join(details))


if __name__ == '__main__':
    main()
