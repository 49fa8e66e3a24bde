"""Slam with a keyframe graph: corrections move map, keyframes and tracking together, and a state holds all of it."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from splatam_core.config import load_config, preset_names
from splatam_core.datasets.registry import open_sequence
from splatam_core.errors import FrameError
from splatam_core.geometry import se3
from splatam_core.slam import Slam
from splatam_core.state import NO_KEYFRAMES, SavedKeyframes
from splatam_core.types import FrameResult, RgbdFrame, Status

OVERRIDES = ('threads=1', 'keyframes.every=2', 'mapping.iterations=3', 'graph.loop_after=8', 'graph.min_correction_m=0')


@pytest.fixture(scope='module')
def there_and_back() -> list[RgbdFrame]:
    """Eleven frames of the room, then the same backwards."""
    sequence = open_sequence('synthetic', width=96, max_frames=11)
    frames = [sequence[index] for index in range(11)]
    return [replace(frame, stamp_ns=10**9 + number * 33_333_333) for number, frame in enumerate([*frames, *frames[-2::-1]])]


def slam_with(*overrides: str) -> Slam:
    return Slam(load_config('realtime', [*OVERRIDES, *overrides]))


@pytest.fixture(scope='module')
def run(there_and_back: list[RgbdFrame]) -> tuple[Slam, list[FrameResult], Slam]:
    """The whole, its results, and another Slam that went on from a state in the middle."""
    slam, other = slam_with('graph.enabled=true'), slam_with('graph.enabled=true')
    results = [slam.process(frame) for frame in there_and_back[:15]]
    other.restore(slam.state())
    results += [slam.process(frame) for frame in there_and_back[15:]]
    for frame in there_and_back[15:]:
        other.process(frame)
    return slam, results, other


def test_corrections_move_everything_together(run: tuple[Slam, list[FrameResult], Slam]) -> None:
    slam, results, _ = run
    assert {result.status for result in results[1:]} == {Status.TRACKED}
    summary = slam.graph.summary
    assert summary.nodes >= 11 and summary.loops > 0 and summary.corrections > 0
    placed = np.array([se3.inverse(keyframe.T_cam_world.double().numpy()) for keyframe in slam._mapper.keyframes])
    is_keyframe = np.isin(slam.graph.nodes.frames, [keyframe.frame for keyframe in slam._mapper.keyframes])
    np.testing.assert_allclose(placed, slam.graph.nodes.T_world_cam[is_keyframe], atol=1e-5)  # float32
    steps = [se3.inverse(result.T_world_odom) @ result.T_world_cam for result in results]
    jumps = [np.linalg.norm((se3.inverse(a) @ b)[:3, 3]) for a, b in pairwise(steps)]
    assert max(jumps) < 0.05  # odometry: the camera moves by less than 2 cm per frame
    assert not (results[-1].T_world_odom == np.eye(4)).all()


def test_a_state_holds_the_graph(run: tuple[Slam, list[FrameResult], Slam]) -> None:
    first, second = run[0].state(), run[2].state()
    for one, other in ((first.graph, second.graph), (first.map, second.map)):
        assert one.keys() == other.keys()
        assert all(np.array_equal(one[name], other[name]) for name in one)
    assert (first.motion.T_world_cam == second.motion.T_world_cam).all()


def test_final_poses_are_those_in_the_final_map(run: tuple[Slam, list[FrameResult], Slam]) -> None:
    """The last pose and the poses of keyframes are where the graph has them; the first never moves."""
    slam, results, _ = run
    stamps_ns = np.array([result.stamp_ns for result in results])
    final = slam.graph.corrected(stamps_ns, np.array([result.T_world_cam for result in results]))
    np.testing.assert_allclose(final[slam.graph.nodes.frames], slam.graph.nodes.T_world_cam, atol=1e-9)
    assert (final[0] == np.eye(4)).all()


def test_only_the_robots_preset_has_a_graph() -> None:
    assert [name for name in preset_names() if load_config(name).graph.enabled] == ['realtime']


def test_true_poses_are_not_corrected() -> None:
    config = load_config('realtime', ['threads=1', 'tracking.method=truth', 'graph.enabled=true'])
    assert not Slam(config, true_motion=lambda *_: np.eye(4)).graph.is_used


def test_without_a_graph_nothing_is_kept(there_and_back: list[RgbdFrame]) -> None:
    slam = slam_with('graph.enabled=false')
    results = [slam.process(frame) for frame in there_and_back[:4]]
    assert slam.graph.summary.nodes == 0 and slam.optimize_graph() == 0
    poses = np.array([result.T_world_cam for result in results])
    assert (slam.graph.corrected(np.array([result.stamp_ns for result in results]), poses) == poses).all()


def test_keyframes_of_another_camera_close_loops(there_and_back: list[RgbdFrame]) -> None:
    """A map that was made with wider images is loaded: its keyframes and the new ones are compared."""
    before = slam_with('graph.enabled=true')
    sequence = open_sequence('synthetic', width=144, max_frames=11)
    for index in range(0, 11, 2):
        before.process(sequence[index])
    numbered = [replace(keyframe, frame=index - len(before.keyframes)) for index, keyframe in enumerate(before.keyframes)]
    slam = slam_with('graph.enabled=true', 'graph.loop_after=1')
    slam.load(before.map.gaussians.detached(), np.eye(4), SavedKeyframes(tuple(numbered), NO_KEYFRAMES.places))
    assert all(slam.process(frame).status.is_trusted for frame in there_and_back[:11])
    slam.optimize_graph()
    assert (slam.graph.pairs(loops=True)[:, 0] < len(numbered)).any()


def test_it_can_be_switched_on_and_off_between_frames(there_and_back: list[RgbdFrame]) -> None:
    slam = slam_with('graph.enabled=false')
    sizes = []
    for number, frame in enumerate(there_and_back):
        if number in (2, 6, 10):
            slam.configure(replace(slam.config, graph=replace(slam.config.graph, enabled=number != 6)))
        assert slam.process(frame).status.is_trusted
        sizes.append(slam.graph.summary.nodes)
    assert sizes[:2] == [0, 0] and sizes[5] == sizes[9] > 1 and sizes[-1] > sizes[9]
    assert slam.optimize_graph() >= 0 and slam.graph.num_loops > 0


def test_where_nothing_is_corrected_results_are_those_without_a_graph(there_and_back: list[RgbdFrame]) -> None:
    """Bit for bit, although loops are found."""
    with_graph, without = slam_with('graph.enabled=true', 'graph.min_correction_m=1'), slam_with('graph.enabled=false')
    ends = [[slam.process(frame) for frame in there_and_back] for slam in (with_graph, without)]
    assert with_graph.graph.num_loops > 0 == with_graph.graph.num_corrections
    assert all(np.array_equal(first.T_world_cam, second.T_world_cam) for first, second in zip(*ends, strict=True))
    assert all(np.array_equal(values, without.map.arrays()[name]) for name, values in with_graph.map.arrays().items())


@pytest.mark.parametrize(('broken', 'costs_the_frame'), [('track', True), ('_plan', False)])
def test_a_system_that_cannot_be_solved_costs_at_most_the_frame(
    there_and_back: list[RgbdFrame],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    broken: str,
    costs_the_frame: bool,
) -> None:
    """Wherever in a frame it is: in tracking, or in the graph, when the frame is in the map already."""
    slam = slam_with('graph.enabled=true')
    for frame in there_and_back[:2]:
        slam.process(frame)

    def unsolvable(*arguments: object, **options: object) -> None:
        raise np.linalg.LinAlgError('Singular matrix')

    with monkeypatch.context() as patch:
        patch.setattr(slam._tracker if broken == 'track' else slam.graph, broken, unsolvable)
        if costs_the_frame:
            with pytest.raises(FrameError, match='cannot be tracked: Singular matrix'):
                slam.process(there_and_back[2])
        else:
            assert slam.process(there_and_back[2]).status is Status.TRACKED
            assert 'frame 2 is not joined to the keyframe graph: Singular matrix' in caplog.text
    assert slam.process(there_and_back[3]).status is Status.TRACKED
    assert slam.process(there_and_back[4]).status is Status.TRACKED  # a keyframe
