"""The keyframe graph: loops correct drift, wrong ones do not, and it stays small. Pairs are measured from true poses here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatam_core.config import load_config
from splatam_core.geometry import motions, se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.graph.keyframe_graph import KeyframeGraph, TrackedFrame
from splatam_core.graph.links import Kind, Link
from splatam_core.graph.pairs import PairResult, Shot
from splatam_core.graph.places import NUM_FEATURES, Place
from splatam_core.images.view import View
from splatam_core.mapping.posed import PosedView
from splatam_core.tracking.evidence import Evidence
from splatam_core.tracking.torch_aligner import TorchAligner

CAMERA = PinholeCamera(32, 24, 30.0, 30.0, 15.5, 11.5)
EVERY = 5  # frames
DRIFT = np.array([0.002, 0.001, 0, 0, 0.0005, 0])  # per keyframe: 8 cm there and back
FRAME = TrackedFrame(0, 0, np.eye(4), np.zeros((6, 6)))
CONFIG = load_config('realtime', ['graph.enabled=true', 'graph.loop_after=50'])


def there_and_back(count: int) -> np.ndarray:
    """True poses: sideways for half of the keyframes, then back the same way."""
    way = 0.05 * np.minimum(np.arange(count), count - 1 - np.arange(count))
    return motions.exp(way[:, None] * np.array([1, 0, 0, 0, 0.1, 0.0]))


class TruePairs:
    """Measures pairs of views by their true poses, with noise of a millimetre."""

    def __init__(self, truth: np.ndarray, wrong: np.ndarray | None = None) -> None:
        self.truth, self.numbers, self.wrong, self.rng = truth, {}, wrong, np.random.default_rng(0)
        self.num_aligned = 0

    def align(self, first: Shot, second: Shot, T_second_first: np.ndarray) -> PairResult:
        i, j = self.numbers[first.view], self.numbers[second.view]
        self.num_aligned += 1
        T = motions.between(self.truth[j], self.truth[i]) @ se3.exp(0.001 * self.rng.standard_normal(6))
        if self.wrong is not None and j - i > 4:
            T = self.wrong @ T
        return PairResult(T, 0.8, 0.99, lambda: Evidence(1e-6 * np.eye(6), 0, 1.0, 48, 0.01))

    def way_back(self, first: Shot, second: Shot, T_second_first: np.ndarray) -> tuple[float, float]:
        self.num_aligned += 1
        return 0.0, 0.0


def num_steps(graph: KeyframeGraph) -> int:
    """How many steps the optimisation that goes on has taken."""
    return 0 if graph._solving is None else graph._solving.optimizer.state.steps


class Drifting:
    """A camera that tracks with drift, in the corrected map, and its keyframes."""

    def __init__(self, truth: np.ndarray, wrong: np.ndarray | None = None, budget: int = 0, drift: np.ndarray = DRIFT) -> None:
        self.graph = KeyframeGraph(CONFIG, TorchAligner())
        self.pairs = self.graph._pairs = TruePairs(truth, wrong)
        self.places, self.begins, self.drift = None, None, drift
        self.work: list[tuple[int, int]] = []  # alignments and steps of the optimisation, of each frame
        self.truth, self.budget, self.keyframes, self.published, self.where = truth, budget, [], [], np.eye(4)

    def run(self, begin: int = 0, end: int | None = None) -> Drifting:
        for number in range(begin, len(self.truth) if end is None else end):
            if number:
                self.where = self.where @ motions.between(self.truth[number - 1], self.truth[number]) @ se3.exp(self.drift)
            view = View(CAMERA, torch.zeros(24, 32, 3, dtype=torch.uint8), torch.full((24, 32), 2.0))
            self.pairs.numbers[view] = number
            self.published.append(self.where)
            self.keyframes.append(PosedView.at(view, se3.inverse(self.where), EVERY * number))
            if self.budget and len(self.keyframes) > self.budget:
                del self.keyframes[1 + number % (self.budget - 2)]
            for after in range(EVERY):  # the camera rests until the next keyframe
                frame = TrackedFrame(EVERY * number + after, 10 * number + after, self.where, np.zeros((6, 6)))
                if number == self.begins and not after:
                    frame = replace(frame, begins=True)
                before = self.pairs.num_aligned, num_steps(self.graph)
                corrections = self.graph.follow(frame, self.keyframes, self.places)
                self.work.append((self.pairs.num_aligned - before[0], max(0, num_steps(self.graph) - before[1])))
                if corrections is None:
                    continue
                moved = corrections.at(np.array([keyframe.frame for keyframe in self.keyframes]))
                before = [keyframe.T_cam_world.double().numpy() for keyframe in self.keyframes]
                placed = [T @ se3.inverse(motion) for T, motion in zip(before, moved)]
                self.keyframes = [PosedView.at(old.view, T, old.frame) for old, T in zip(self.keyframes, placed)]
                self.where = corrections.motions[-1] @ self.where
        return self

    def errors_m(self) -> np.ndarray:
        """How far the final poses are from the truth."""
        final = self.graph.corrected(10 * np.arange(len(self.published)), np.array(self.published))
        return np.linalg.norm(final[:, :3, 3] - self.truth[: len(final), :3, 3], axis=1)


def test_loops_take_drift_back() -> None:
    truth = there_and_back(60)
    camera = Drifting(truth).run()
    without = np.linalg.norm(np.array(camera.published)[:, :3, 3] - truth[:, :3, 3], axis=1)
    assert camera.graph.num_loops > 5 and camera.graph.num_corrections >= 1
    assert camera.errors_m().max() < 0.05 and camera.errors_m()[-1] < 0.03 < 0.1 < 60 * np.linalg.norm(DRIFT[:3])
    assert without.max() < 0.1  # published poses profit from the corrections as well
    np.testing.assert_allclose(camera.graph.T_world_odom[:3, :3] @ camera.graph.T_world_odom[:3, :3].T, np.eye(3), atol=1e-9)


def test_a_frame_has_a_bounded_part_of_the_work() -> None:
    """One alignment, or some steps of an optimisation; also where many loops are found, and correct poses."""
    camera = Drifting(there_and_back(60)).run()
    assert camera.graph.num_corrections >= 1 and {number for number, _ in camera.work} == {0, 1}
    assert max(steps for _, steps in camera.work) <= 4


def test_loops_that_agree_are_looked_for_more_and_more_rarely() -> None:
    """On the way back every keyframe sees a place again, at last from long ago; where poses drift, each is compared with two."""
    exact, drifting = (Drifting(there_and_back(200), drift=drift).run().graph for drift in (np.zeros(6), DRIFT))
    assert exact.num_corrections == 0 < drifting.num_corrections
    late = [sum(loop.second > 150 for loop in graph.loops()) for graph in (exact, drifting)]
    assert 5 < late[0] < 20 < 25 < late[1]


def test_a_wrong_loop_changes_nothing() -> None:
    """Half a metre off, where odometry and pairs know better."""
    camera = Drifting(there_and_back(40), wrong=se3.exp(np.array([0.5, 0, 0, 0, 0.3, 0]))).run()
    assert camera.graph.num_corrections == 0
    assert camera.graph.settle(None) is None
    assert camera.graph.num_loops == camera.graph.num_corrections == 0
    assert (camera.graph.T_world_odom == np.eye(4)).all()


def test_what_agrees_is_left_alone() -> None:
    camera = Drifting(there_and_back(60))
    camera.graph.configure(replace(CONFIG, graph=replace(CONFIG.graph, min_correction_m=1.0)))
    camera.graph._pairs = camera.pairs
    camera.run()
    assert camera.graph.num_loops > 5 and camera.graph.num_corrections == 0
    assert (camera.graph.nodes.T_world_cam == np.array(camera.published)).all()


@pytest.mark.parametrize(('share', 'is_drift'), [(0.8, False), (0.9, True)])
@pytest.mark.parametrize('twist', [(0.04, 0, 0, 0, 0, 0), (0, 0, 0, 0, 0.02, 0)])
def test_poses_follow_loops_only_where_these_agree(share: float, is_drift: bool, twist: tuple[float, ...]) -> None:
    """What is left of the disagreement after optimisation is what loops err by: 80 % are taken away where poses are as good."""
    off, T = np.array(twist), there_and_back(10)
    graph = KeyframeGraph(CONFIG, TorchAligner())
    for number in range(10):
        graph.nodes = graph.nodes.added(number, number, T[number])
    measured = [motions.between(T[0], T[node]) @ se3.exp(-off) for node in range(5, 10)]
    graph._links = [Link.measured(0, 5 + k, motion, Kind.LOOP, 1e-6 * np.eye(6)) for k, motion in enumerate(measured)]
    solution = T.copy()
    solution[5:] = [pose @ se3.exp(-(1 - np.sqrt(1 - share)) * off) for pose in T[5:]]
    assert graph._is_drift(range(10), solution) == is_drift
    graph._links = [Link.measured(k, 9, motions.between(T[k], T[9]) @ se3.exp(-off), Kind.LOOP, 1e-6 * np.eye(6)) for k in range(5)]
    assert not graph._is_drift(range(10), solution), 'what loops of one keyframe say, some correction always explains'


def test_dropped_keyframes_leave_the_graph_small() -> None:
    """An hour of new space with a budget: edges stay few, every keyframe keeps its pose, and loops still correct."""
    camera = Drifting(there_and_back(200), budget=30).run()
    assert len(camera.graph.nodes) >= 200  # and the frames at which something was corrected
    assert len(camera.graph._active) <= 32
    assert len(camera.graph._links) < 20 * 32
    assert camera.errors_m()[-1] < 0.08 < 200 * np.linalg.norm(DRIFT[:3])


@pytest.mark.parametrize('budget', [4, 12])
def test_a_place_that_is_seen_for_hours_keeps_the_graph_small(budget: int) -> None:
    """Keyframes that are dropped hand their loops over, again and again to the same few."""
    way = 0.02 * np.abs(np.arange(150) % 10 - 5)
    camera = Drifting(motions.exp(way[:, None] * np.array([1, 0, 0, 0, 0.1, 0.0])), budget=budget).run()
    assert camera.graph.num_loops > budget
    assert len(camera.graph._links) < 15 * (budget + 2)  # odometry and pairs, and the two loops of each new keyframe
    assert camera.errors_m().max() < 0.2 < 150 * np.linalg.norm(DRIFT[:3])


def test_a_keyframe_takes_at_most_60_kb_beside_its_images() -> None:
    """Features and edges, with as many loops as are looked for; objects of Python take as much again as the numbers in them."""
    graph = Drifting(there_and_back(100)).run().graph
    assert graph.num_loops > 50
    of_graph = sum(array.nbytes for array in graph.arrays().values()) / len(graph.nodes)
    of_features = NUM_FEATURES * (32 + 3 * 4 + 4 * 4)  # descriptor, point, keys
    assert of_features + 2 * of_graph < 60_000


def test_a_state_continues_bit_for_bit() -> None:
    truth = there_and_back(50)
    half = Drifting(truth).run(end=40)
    other = Drifting(truth)
    other.graph.restore(half.graph.arrays())
    other.pairs.numbers, other.pairs.rng = dict(half.pairs.numbers), half.pairs.rng
    other.keyframes, other.published, other.where = list(half.keyframes), list(half.published), half.where
    rng = half.pairs.rng.bit_generator.state
    half.run(begin=40)
    other.pairs.rng.bit_generator.state = rng
    other.run(begin=40)
    first, second = half.graph.arrays(), other.graph.arrays()
    assert first.keys() == second.keys()
    assert all(np.array_equal(first[name], second[name]) for name in first)


def test_a_state_that_is_none_is_refused() -> None:
    arrays = Drifting(there_and_back(10)).run().graph.arrays()
    faults = {
        'pairs': None, 'T_first_second': np.full_like(arrays['T_first_second'], np.nan), 'placed': arrays['placed'][1:],
        'active': arrays['active'] + 1, 'task_motions': np.zeros((1, 4, 4)), 'T_world_odom': np.eye(3),
    }  # fmt: skip
    for name, value in faults.items():
        broken = {key: array for key, array in {**arrays, name: value}.items() if array is not None}
        with pytest.raises(ValueError, match=f'graph: .*{name}'):
            KeyframeGraph(CONFIG, None).restore(broken)


def test_what_is_taken_back_leaves_the_graph() -> None:
    camera = Drifting(there_and_back(30)).run()
    camera.graph.drop_from(EVERY * 20)
    assert camera.graph.nodes.frames[-1] < EVERY * 20 and camera.graph.pairs(loops=False).max() == len(camera.graph.nodes) - 1
    assert max(camera.graph._active) == len(camera.graph.nodes) - 1


def test_what_is_taken_back_leaves_no_frame_without_a_place() -> None:
    """A frame at which the map was corrected leaves the graph with a later keyframe, which may itself be taken back."""
    camera = Drifting(there_and_back(60)).run(end=59)
    graph = camera.graph
    graph.settle(replace(FRAME, index=EVERY * 58 + 4, stamp_ns=584, T_world_cam=camera.where))
    camera.run(begin=59)
    node = max(set(range(len(graph.nodes))) - set(graph._active))
    graph.drop_from(int(graph.nodes.frames[node + 1]))
    graph._add(replace(FRAME, index=1000, stamp_ns=1000, T_world_cam=graph.nodes.T_world_cam[-1]))
    assert {number for link in graph._links for number in (link.first, link.second)} <= set(graph._active)
    assert graph._active[-2:] == [node, node + 1]


def drifted() -> Drifting:
    """A camera that came back with loops, all of them to be used at the end."""
    camera = Drifting(there_and_back(60))
    camera.graph.configure(replace(CONFIG, graph=replace(CONFIG.graph, min_correction_m=1.0)))
    camera.graph._pairs = camera.pairs
    return camera.run()


def test_odometry_that_drifts_gives_way_to_pairs() -> None:
    """Its errors are alike from one keyframe to the next, and those of pairs are not: 5 mm are left of more than 8 cm."""
    camera = drifted()
    camera.graph.settle(None)
    assert camera.errors_m().max() < 0.005


def test_frames_after_the_last_keyframe_move_with_it() -> None:
    """They were tracked in the map before the correction, and end in the map after it."""
    camera = drifted()
    newest = replace(FRAME, index=EVERY * 59 + 4, stamp_ns=594, T_world_cam=camera.where)
    corrections = camera.graph.settle(newest)
    assert corrections is not None
    stamps_ns = np.arange(590, 595)
    final = camera.graph.corrected(stamps_ns, np.repeat(camera.where[None], 5, axis=0))
    assert np.linalg.norm(final[0, :3, 3] - camera.where[:3, 3]) > 0.05
    np.testing.assert_allclose(final, np.repeat((corrections.motions[-1] @ camera.where)[None], 5, axis=0), atol=1e-3)
    later = corrections.motions[-1] @ camera.where  # tracked in the map after it
    np.testing.assert_allclose(camera.graph.corrected(np.array([600]), later[None])[0], later, atol=1e-12)


def test_a_pause_keeps_what_was_corrected() -> None:
    camera = Drifting(there_and_back(60)).run()
    stamps_ns, published = 10 * np.arange(60), np.array(camera.published)
    final = camera.graph.corrected(stamps_ns, published)
    camera.graph.interrupt(replace(FRAME, index=298, stamp_ns=598, T_world_cam=camera.where))
    camera.graph.follow(replace(FRAME, index=299, stamp_ns=10_000, T_world_cam=camera.where), camera.keyframes)
    np.testing.assert_array_equal(camera.graph.corrected(stamps_ns, published), final)
    assert camera.graph.num_loops > 5 and camera.graph.nodes.frames[-2:].tolist() == [298, 299]
    way, before = [link for link in camera.graph._links if link.kind is Kind.ODOMETRY][:-3:-1]
    assert way.information[0, 0] < 0.1 * before.information[0, 0]  # nobody saw the way
    camera.graph.follow(replace(FRAME, index=300, stamp_ns=1, T_world_cam=camera.where, found_at=-1), camera.keyframes)
    assert camera.graph.nodes.frames.tolist() == [300]  # time went back


def test_loops_to_a_map_that_was_loaded_correct_what_comes() -> None:
    """The loaded keyframes stay where they are, and so does the first frame, with which their Gaussians move."""
    truth = there_and_back(60)
    camera = Drifting(truth)
    loaded = [View(CAMERA, torch.zeros(24, 32, 3, dtype=torch.uint8), torch.full((24, 32), 2.0)) for _ in range(30)]
    for number, view in enumerate(loaded):
        camera.pairs.numbers[view] = number
    camera.keyframes = [PosedView.at(view, se3.inverse(truth[number]), number - 30) for number, view in enumerate(loaded)]
    camera.graph.load(camera.keyframes)
    camera.run()
    graph = camera.graph
    assert graph.num_corrections >= 1 and (graph.nodes.frames[:31] == np.arange(-30, 1)).all()
    np.testing.assert_allclose(graph.nodes.T_world_cam[:30], truth[:30], atol=1e-6)  # float32
    assert (graph.nodes.T_world_cam[30] == truth[0]).all()
    graph.settle(None)
    assert camera.errors_m().max() < 0.05 < 0.1 < 60 * np.linalg.norm(DRIFT[:3])  # the last keyframes were not looked for


class TruePlaces:
    """Recognises every place that was seen from within a keyframe's step."""

    def __init__(self, camera: Drifting) -> None:
        self.camera = camera

    def __contains__(self, frame: int) -> bool:
        return True

    def alike(self, keyframe: int, among: list[int], limit: int) -> list[int]:
        place = self.camera.truth[keyframe // EVERY]
        return [frame for frame in among if np.linalg.norm((self.camera.truth[frame // EVERY] - place)[:3, 3]) < 0.06][:limit]

    def compare_keyframes(self, keyframe: int, other: int, camera: PinholeCamera) -> Place:
        T = motions.between(self.camera.truth[other // EVERY], self.camera.truth[keyframe // EVERY])
        return Place(keyframe, T, T, 100, 100)


def test_a_new_map_joins_the_old_one_where_loops_say() -> None:
    """It lies far from the old one, and turned, until then; keyframes that are dropped meanwhile keep both apart."""
    truth = there_and_back(60)
    camera = Drifting(truth, budget=40).run(end=25)
    camera.places, camera.begins = TruePlaces(camera), 32
    camera.graph.interrupt(replace(FRAME, index=EVERY * 24 + 4, stamp_ns=245, T_world_cam=camera.where))
    camera.where = se3.exp(np.array([30, 0, 0, 0, 0.5, 0])) @ truth[31]
    camera.run(begin=32, end=36)
    assert camera.graph.num_corrections == 0 and camera.graph.nodes.T_world_cam[-1, 0, 3] > 20
    camera.run(begin=36)
    assert camera.graph.num_corrections >= 1
    camera.graph.settle(None)
    nodes = camera.graph.nodes
    off = np.linalg.norm((nodes.T_world_cam - truth[nodes.frames // EVERY])[:, :3, 3], axis=1)
    assert off.max() < 0.1


def test_a_new_map_joins_while_it_is_seen_again_itself() -> None:
    """Places of its own are near the camera at every keyframe by then; those of the old map are looked for nevertheless."""
    way = 0.05 * np.concatenate([np.arange(25), np.full(35, 29), 29 - np.arange(20)])
    camera = Drifting(motions.exp(way[:, None] * np.array([1, 0, 0, 0, 0.1, 0.0]))).run(end=25)
    camera.places, camera.begins = TruePlaces(camera), 32
    camera.graph.interrupt(replace(FRAME, index=EVERY * 24 + 4, stamp_ns=245, T_world_cam=camera.where))
    camera.where = se3.exp(np.array([30, 0, 0, 0, 0.5, 0])) @ camera.truth[31]
    camera.run(begin=32, end=60)
    assert camera.graph.num_loops > 0 and camera.graph.nodes.T_world_cam[-1, 0, 3] > 20
    camera.run(begin=60)
    nodes = camera.graph.nodes
    off = np.linalg.norm((nodes.T_world_cam - camera.truth[nodes.frames // EVERY])[:, :3, 3], axis=1)
    assert off.max() < 0.1


def test_what_was_tracked_before_and_after_a_loss_moves_with_its_own_map() -> None:
    """The camera is found in the old map, between two keyframes, while it was in a new one."""
    graph, apart = KeyframeGraph(CONFIG, TorchAligner()), se3.exp(np.array([30.0, 0, 0, 0, 0, 0]))
    old, new = np.repeat(np.eye(4)[None], 9, axis=0), np.repeat(apart[None], 9, axis=0)
    view = View(CAMERA, torch.zeros(24, 32, 3, dtype=torch.uint8), torch.full((24, 32), 2.0))
    graph._pairs, kept = TruePairs(old), []
    graph._pairs.numbers[view] = 0
    way = [(0, old, {}), (5, old, {}), (8, old, None), (9, new, {'begins': True}), (15, new, {}), (21, new, None),
           (22, old, {'found_at': 5}), (25, old, {}), (30, old, {})]  # fmt: skip
    for index, T, options in way:
        frame = replace(FRAME, index=index, stamp_ns=index, T_world_cam=T[0])
        if options is None:
            graph.interrupt(frame)
            continue
        if 'found_at' not in options:
            kept.append(PosedView.at(view, se3.inverse(T[0]), index))
        graph.follow(replace(frame, **options), kept)
    assert graph.nodes.frames[graph._active].tolist() == [0, 5, 8, 9, 15, 21, 22, 25, 30]
    solution = np.repeat(np.eye(4)[None], len(graph._active), axis=0)
    graph._corrections(solution, graph._active)
    stamps_ns, published = np.arange(0, 31), np.array([(new if 9 <= stamp < 22 else old)[0] for stamp in range(31)])
    np.testing.assert_allclose(graph.corrected(stamps_ns, published), np.repeat(np.eye(4)[None], 31, axis=0), atol=1e-9)
