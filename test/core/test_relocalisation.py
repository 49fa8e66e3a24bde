"""A camera that is carried away, put into another room, started without a pose, or told where it is."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from splatam_core.config import SlamConfig, load_config, preset_names, with_values
from splatam_core.datasets.known_poses import FramesWithGroundTruth
from splatam_core.datasets.registry import open_sequence
from splatam_core.errors import CheckpointError, ConfigError
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.graph import relocalisation
from splatam_core.graph.places import Places
from splatam_core.graph.relocalisation import RelocaliserState
from splatam_core.images.view import View
from splatam_core.mapping.posed import PosedView
from splatam_core.runs.archive import Content, pack, read_archive
from splatam_core.runs.checkpoints import Checkpoints, Progress, read_newest
from splatam_core.runs.map_keyframes import KIND, VERSION, read_map_keyframes, write_map_keyframes
from splatam_core.slam import Slam
from splatam_core.state import SlamState
from splatam_core.tracking import TrackingResult
from splatam_core.tracking.verdict import Verdict
from splatam_core.types import FrameResult, RgbdFrame, Status

MAPPED = range(0, 56, 4)  # half a turn
AWAY = range(1, 13, 2)  # frames that show what was seen at the beginning, between the keyframes
STEP_NS = 33_333_333
CONFIG = load_config('realtime', ['threads=1', 'keyframes.every=1', 'densification.every=1'])


@dataclasses.dataclass(frozen=True)
class Walk:
    """A map of a walk through the room.

    Attributes:
        state: of SLAM at its end.
        away: frames from near its beginning.
        true: [N, 4, 4] poses of ``away`` in the map's world.
        other_room: frames of another room, in a mirror.
    """

    state: SlamState
    away: list[RgbdFrame]
    true: np.ndarray
    other_room: list[RgbdFrame]


@pytest.fixture(scope='module')
def walk() -> Walk:
    """Mapped at the true poses, which takes few frames; then the last one is tracked."""
    room, other = (open_sequence(f'synthetic:motion=fast,seed={seed}', width=240) for seed in (0, 1))
    frames = FramesWithGroundTruth(room)
    mapper = Slam(with_values(CONFIG, {'tracking.method': 'truth'}), true_motion=frames.motion)
    for index in MAPPED:
        mapper.process(frames[index])
    slam = Slam(CONFIG)
    slam.restore(dataclasses.replace(mapper.state(), config=CONFIG))
    slam.rest()
    assert slam.process(frames[MAPPED[-1]]).status.is_trusted
    truth = room.ground_truth().T_world_cam
    true = se3.inverse(truth[0]) @ truth
    return Walk(slam.state(), [room[index] for index in AWAY], true[AWAY], [mirrored(other[index]) for index in range(0, 60, 10)])


def mirrored(frame: RgbdFrame) -> RgbdFrame:
    """Rooms of all seeds have the same furniture in about the same places: unmirrored, a sofa is rightly recognised."""
    rgb, depth_m = (np.ascontiguousarray(image[:, ::-1]) for image in (frame.rgb, frame.depth_m))
    return dataclasses.replace(frame, rgb=rgb, depth_m=depth_m)


def in_the_map(walk: Walk, config: SlamConfig = CONFIG) -> Slam:
    slam = Slam(config)
    slam.restore(dataclasses.replace(walk.state, config=config))
    return slam


def show(slam: Slam, frames: Sequence[RgbdFrame], after_ns: int) -> list[FrameResult]:
    """Processes frames, without a gap in the stamps."""
    stamped = [dataclasses.replace(frame, stamp_ns=after_ns + (k + 1) * STEP_NS) for k, frame in enumerate(frames)]
    return [slam.process(frame) for frame in stamped]


def off(result: FrameResult, true: np.ndarray) -> float:
    assert result.T_world_cam is not None
    return float(np.linalg.norm(result.T_world_cam[:3, 3] - true[:3, 3]))


def test_a_kidnapped_camera_is_found(walk: Walk) -> None:
    """Two frames are needed: one that is recognised, and one that confirms it. Afterwards it is tracked as always."""
    results = show(in_the_map(walk), walk.away, walk.state.last_stamp_ns)
    found = next(index for index, result in enumerate(results) if result.status.is_trusted)
    assert 1 <= found <= 4 and [result.is_relocalised for result in results] == [k == found for k in range(len(results))]
    assert not any(result.status is Status.TRACKED for result in results[:found])
    for result, true in zip(results[found:], walk.true[found:]):
        assert result.status is Status.TRACKED and off(result, true) < 0.05  # two pixels at the walls' 2.5 m
    assert results[found].covariance is not None and results[found].covariance.drift_position_m > 0
    odometry = se3.inverse(results[found].T_world_odom) @ results[found].T_world_cam
    np.testing.assert_allclose(odometry, walk.state.motion.T_world_cam, atol=1e-9)  # nobody knows the way there


def test_frames_confirm_a_place_until_the_pose_is_sure(walk: Walk, monkeypatch: pytest.MonkeyPatch) -> None:
    """Which place it is can be clear while the pose is not: it says so after some frames, and looks anew."""
    slam = in_the_map(walk, with_values(CONFIG, {'tracking.max_error_m': 1e-4}))
    work = Work(slam, monkeypatch)
    each, confirmed = [], []
    for number in range(9):
        each.append(work.of(slam, walk.away[number % 2])['compare'] > 0)
        recognised = slam.state().relocaliser.recognised
        confirmed.append(None if recognised is None else recognised.num_confirmed)
    first = confirmed.index(0)
    assert confirmed[first : first + 6] == [0, 1, 2, 3, 0, 1]
    assert [first + index for index, is_compared in enumerate(each[first : first + 6]) if is_compared] == [first, first + 4]
    slam.configure(CONFIG)
    assert show(slam, walk.away[:1], slam.state().last_stamp_ns)[0].status is Status.TRACKED


def test_a_camera_in_another_room_is_never_believed(walk: Walk) -> None:
    slam = in_the_map(walk)
    before = slam.snapshot()
    results = show(slam, walk.other_room, walk.state.last_stamp_ns)
    assert not any(result.status.is_trusted for result in results)
    assert np.array_equal(slam.snapshot().means, before.means)


def test_switched_off_it_stays_lost(walk: Walk) -> None:
    config = with_values(CONFIG, {'tracking.align.relocalisation.enabled': False})
    results = show(in_the_map(walk, config), walk.away, walk.state.last_stamp_ns)
    assert not any(result.status.is_trusted or result.is_relocalised for result in results)


def test_only_robots_presets_have_it() -> None:
    """The paper's has none."""
    assert [name for name in preset_names() if load_config(name).tracking.relocalises] == ['quick', 'realtime']


@pytest.mark.parametrize('stop_after', [1, 2])
def test_a_checkpoint_continues_exactly(walk: Walk, tmp_path: Path, stop_after: int) -> None:
    """Also between a frame that is recognised and the one that confirms it."""
    slam = in_the_map(walk)
    show(slam, walk.away[:stop_after], walk.state.last_stamp_ns)
    state = slam.state()
    Checkpoints(tmp_path, keep=1).save(state, Progress(100, stop_after, '', stop_after))
    resumed = Slam(CONFIG)
    resumed.restore(read_newest(tmp_path).state)
    ends = [show(each, walk.away[stop_after:], state.last_stamp_ns) for each in (slam, resumed)]
    assert any(result.is_relocalised for result in ends[0])
    for first, second in zip(*ends, strict=True):
        assert (first.status, first.reason, first.is_relocalised) == (second.status, second.reason, second.is_relocalised)
        assert first.T_world_cam is None or np.array_equal(first.T_world_cam, second.T_world_cam)
    assert all(np.array_equal(slam.map.arrays()[name], values) for name, values in resumed.map.arrays().items())


def test_a_camera_lost_for_long_is_looked_for_now_and_then(walk: Walk) -> None:
    slam = in_the_map(walk)
    frame = walk.away[0]
    covered = dataclasses.replace(frame, rgb=np.zeros_like(frame.rgb), depth_m=np.full_like(frame.depth_m, 0.3))
    results = show(slam, [covered] * 60, walk.state.last_stamp_ns)
    assert all(result.status is Status.LOST for result in results)
    looked_for = [index for index, result in enumerate(results) if 'every n-th frame' not in result.reason]
    assert looked_for == [*range(30), 30, 40, 50]
    assert any(result.is_relocalised for result in show(slam, walk.away * 2, slam.state().last_stamp_ns))


@pytest.mark.parametrize('every', [1, 2, 10])
def test_it_is_looked_for_on_fewer_frames_the_longer_it_is_lost(every: int) -> None:
    """On each of the first ten, then on every third, then on every n-th; an attempt has the number of those before it."""
    tracking = with_values(CONFIG, {'tracking.align.relocalisation.every': every}).tracking
    due = [*range(10), *range(10, 30, min(3, every)), *range(30, 60, every)]
    assert [count for count in range(60) if relocalisation._is_due(count, tracking)] == due
    assert [relocalisation._attempts(count, tracking) for count in due] == list(range(len(due)))


class Work:
    """Counts what takes time in a Slam: renders, steps of fitting, alignments, and comparisons of features."""

    def __init__(self, slam: Slam, monkeypatch: pytest.MonkeyPatch) -> None:
        self.counts = dict.fromkeys(('render', 'fit', 'track', 'compare'), 0)
        for owner, name in ((slam._rasterizer, 'render'), (slam._rasterizer, 'fit'), (slam._tracker, 'track')):
            self._count(owner, name, monkeypatch)
        self._count(slam.places, 'compare', monkeypatch)

    def _count(self, owner: object, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
        function = getattr(owner, name)

        def counted(*args: object, **kwargs: object) -> object:
            self.counts[name] += 1
            return function(*args, **kwargs)

        monkeypatch.setattr(owner, name, counted)

    def of(self, slam: Slam, frame: RgbdFrame) -> dict[str, int]:
        """Returns what a frame takes, without a gap in the stamps."""
        self.counts = dict.fromkeys(self.counts, 0)
        show(slam, [frame], slam.state().last_stamp_ns or 0)
        return self.counts


def test_a_frozen_map_takes_a_bounded_part_of_the_work(walk: Walk, monkeypatch: pytest.MonkeyPatch) -> None:
    """Localisation only: nothing is fitted, kept or remembered, however long it goes on; a frame is aligned a few times."""
    slam = in_the_map(walk, with_values(CONFIG, {'mapping.enabled': False, 'graph.enabled': True}))
    show(slam, walk.away, walk.state.last_stamp_ns)
    before, work = slam.state(), Work(slam, monkeypatch)
    for number in range(20):
        counts = work.of(slam, walk.away[-1 - number % 2])
        assert counts['track'] <= 2 and counts['render'] <= 4 and counts['fit'] == counts['compare'] == 0
    after = slam.state()
    for one, other in ((before.map, after.map), (before.places, after.places), (before.graph, after.graph)):
        assert one.keys() == other.keys() and all(np.array_equal(one[name], other[name]) for name in one)
    assert len(after.keyframes) == len(before.keyframes)
    assert slam.finish() == 0


def test_a_lost_camera_takes_a_bounded_part_of_the_work(walk: Walk, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frame by frame, and in the long run: from the thirtieth frame on only every tenth is looked at."""
    slam = in_the_map(walk)
    work, frame = Work(slam, monkeypatch), walk.away[0]
    mirrored = dataclasses.replace(frame, rgb=frame.rgb[:, ::-1].copy(), depth_m=frame.depth_m[:, ::-1].copy())
    slam._relocaliser.state = RelocaliserState(num_in_doubt=27)
    each = [work.of(slam, mirrored) for _ in range(25)]
    assert slam.state().relocaliser.num_in_doubt == 52
    assert max(counts['compare'] for counts in each) <= 12 and max(counts['track'] for counts in each) <= 2 + 3
    for counts in each:  # aligned twice, and once more from features that are found in a render
        assert counts['render'] <= 5 * counts['track'] and counts['fit'] == 0
    assert [27 + index for index, counts in enumerate(each) if counts['track'] or counts['compare']] == [27, 28, 29, 30, 40, 50]


def load(walk: Walk, T_world_cam: np.ndarray | None, tmp_path: Path) -> Slam:
    """Starts in the saved map."""
    mapped = in_the_map(walk)
    write_map_keyframes(tmp_path / 'map.keyframes', mapped.keyframes, mapped.places.arrays())
    slam = Slam(CONFIG)
    slam.load(mapped.map.gaussians.detached(), T_world_cam, read_map_keyframes(tmp_path / 'map.keyframes'))
    return slam


def test_a_camera_started_in_a_saved_map_finds_itself(walk: Walk, tmp_path: Path) -> None:
    """It waits where it recognises nothing."""
    slam = load(walk, None, tmp_path)
    blind = dataclasses.replace(walk.away[0], rgb=np.zeros_like(walk.away[0].rgb))
    waiting = show(slam, [blind] * 3, 10**9)
    assert all(result.status is Status.LOST and 'recognises' in result.reason for result in waiting)
    results = show(slam, walk.away, 2 * 10**9)
    found = next(index for index, result in enumerate(results) if result.status.is_trusted)
    assert results[found].is_relocalised and off(results[found], walk.true[found]) < 0.05
    assert len(slam.keyframes) >= len(walk.state.keyframes)


@pytest.mark.parametrize('what', ['spacing', 'pose', 'counts'])
def test_keyframes_that_no_camera_made_are_refused(tmp_path: Path, what: str) -> None:
    """What only a later frame would trip over."""
    view = View(PinholeCamera(32, 24, 30.0, 30.0, 15.5, 11.5), torch.zeros(24, 32, 3, dtype=torch.uint8), torch.ones(24, 32))
    places = Places()
    keyframes = [PosedView.at(view, np.eye(4), 0)] * 4
    path = tmp_path / 'map.keyframes'
    write_map_keyframes(path, keyframes, places.arrays())
    content = read_archive(path, KIND, VERSION)
    wrong = {
        'spacing': ({'spacings': [1e308] * 4}, {}), 'pose': ({}, {'T_cam_world': np.full((4, 4, 4), 1e20, np.float32)}),
        'counts': ({}, {'places.frames': np.arange(-4, 0), 'places.counts': np.full(4, 1 << 62)}),
    }  # fmt: skip
    values, arrays = wrong[what]
    pack(KIND, VERSION, Content({**content.values, **values}, {**content.arrays, **arrays})).write(path)
    with pytest.raises(CheckpointError, match={'pose': 'no rigid motion', 'counts': 'features of 0'}.get(what, what)):
        read_map_keyframes(path)


def test_a_map_without_keyframes_needs_a_pose(walk: Walk) -> None:
    slam = Slam(CONFIG)
    with pytest.raises(ConfigError, match='state its pose'):
        slam.load(in_the_map(walk).map.gaussians.detached(), None)


@pytest.mark.parametrize('is_right', [True, False])
def test_a_pose_that_is_told_is_verified(walk: Walk, caplog: pytest.LogCaptureFixture, is_right: bool) -> None:
    """It may be off by some 30 cm and 10 degrees, as a mouse points. What does not fit is refused in one line."""
    config = with_values(CONFIG, {'tracking.align.relocalisation.enabled': False})
    slam = in_the_map(walk, config)
    slip = se3.exp(np.array([0.25, 0.0, -0.15, 0.0, 0.15, 0.0]))
    slam.suggest(walk.true[0] @ slip if is_right else walk.true[0] @ se3.exp(np.array([0.0, 0, 0, 0, 2.5, 0])))
    with caplog.at_level(logging.INFO):
        results = show(slam, walk.away[:3], walk.state.last_stamp_ns)
    assert [result.is_relocalised for result in results] == [False, is_right, False]
    assert results[2].status.is_trusted == is_right
    assert sum('is refused' in record.message for record in caplog.records) == (not is_right)


@pytest.mark.parametrize('rests', [False, True])
def test_a_pose_that_is_told_to_a_tracked_camera_is_answered(
    walk: Walk, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, rests: bool
) -> None:
    """Whatever the frames after it say: it is tracked already, and where the person says it cannot be sure. Or there is a pause."""

    class Unsure(relocalisation.Judge):
        def decide(self, *args: object) -> tuple[TrackingResult, Verdict]:
            result, verdict = super().decide(*args)
            return result, dataclasses.replace(verdict, status=Status.UNCERTAIN)

    slam = in_the_map(walk)
    show(slam, walk.away, walk.state.last_stamp_ns)
    slam.suggest(walk.true[-1])
    if rests:
        show(slam, walk.away[-1:], slam.state().last_stamp_ns)
        slam.rest()
    else:
        monkeypatch.setattr(relocalisation, 'Judge', Unsure)
    results = show(slam, walk.away[-1:] * 6, slam.state().last_stamp_ns or 10**12)
    assert all(result.status.is_trusted for result in results)
    is_refused = 'is refused: the next frames do not confirm it' in caplog.text
    assert [is_refused, any(result.is_relocalised for result in results)] == [not rests, rests]
