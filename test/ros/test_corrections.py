"""A correction of the map by a loop, as robots see it: map to odom jumps, odom to base never does, and the path follows."""

from __future__ import annotations

import signal
from dataclasses import replace
from itertools import chain, pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from camera import CAMERA_FRAME, Live, stamps_of
from control import Control
from graph import Graph

from msg_adapters import markers, poses, stamps
from msg_adapters.factory import RclpyMessages
from splatam_core.datasets.registry import open_sequence
from splatam_core.geometry import motions, se3
from splatam_core.graph.nodes import Nodes
from splatam_core.maps.ply import read_ply
from splatam_core.runs.map_keyframes import read_map_keyframes
from splatam_core.types import FrameResult, StageTimings, Status
from splatam_ros.frames.buffer import TransformBuffer
from splatam_ros.frames.covariance import MotionEstimator
from splatam_ros.frames.rep105 import CoordinateFrames, Located
from splatam_ros.node.outputs import PathHistory
from splatam_ros.node.parameters import node_options

JUMP = se3.exp(np.array([0.2, 0, 0.1, 0, 0.1, 0]))
STEP = se3.exp(np.array([0.01, 0, 0, 0, 0.02, 0]))
SECOND_NS = 10**9


class NoWarnings:
    """Fails the test where something warns."""

    def warn(self, kind: str, text: str) -> None:
        raise AssertionError(text)


def located(number: int, *, is_corrected: bool) -> Located:
    """The camera after some steps; corrected, its pose in the world has jumped."""
    frames = CoordinateFrames(node_options({}).frames, TransformBuffer(), NoWarnings())  # type: ignore[arg-type]
    T_world_odom = JUMP if is_corrected else np.eye(4)
    T = T_world_odom @ np.linalg.matrix_power(STEP, number)
    found = frames.locate(number * SECOND_NS, 'camera', T, np.eye(4), T_world_odom)
    assert found is not None
    return found


def test_odometry_stays_continuous() -> None:
    frames = CoordinateFrames(node_options({}).frames, TransformBuffer(), NoWarnings())  # type: ignore[arg-type]
    before, after = (frames.moving(located(number, is_corrected=number > 3)) for number in (3, 4))
    assert (before['map', 'odom'] == np.eye(4)).all()
    np.testing.assert_allclose(after['map', 'odom'], JUMP, atol=1e-12)
    for moving, number in ((before, 3), (after, 4)):
        np.testing.assert_allclose(moving['odom', 'camera'], np.linalg.matrix_power(STEP, number), atol=1e-12)


@pytest.mark.parametrize('source', ['none', 'topic'])
def test_a_lost_robot_goes_on_in_the_corrected_map(source: str) -> None:
    """Map to odom of the last tracked frame moves with the map that was corrected after it."""
    parameters = {'odom.source': source, 'base_frame': 'base', 'camera_in_base': '0 0 1 0 0 0', 'world_up': 'z_up'}
    buffer = TransformBuffer()
    for stamp_ns in (9 * 10**8, 11 * 10**8):
        buffer.add('odom', 'base', stamp_ns, np.eye(4))
    frames = CoordinateFrames(node_options(parameters).frames, buffer, NoWarnings())  # type: ignore[arg-type]
    before = frames.locate(SECOND_NS, 'camera', STEP, None, np.eye(4))
    assert before is not None
    after = frames.locate(SECOND_NS, 'camera', JUMP @ STEP, before.T_map_world, JUMP)
    assert after is not None
    lasting, expected = (frames.lasting(frames.moving(each)) for each in (before, after))
    held = frames.corrected(lasting, before, JUMP)
    np.testing.assert_allclose(held['map', 'odom'], expected['map', 'odom'], atol=1e-12)
    assert frames.corrected(lasting, before, np.eye(4)) == lasting
    assert np.linalg.norm(held['map', 'odom'][:3, 3]) > 0.1


def test_velocity_is_without_the_jump() -> None:
    estimator, twists = MotionEstimator(0.01, 0.01), []
    for number in range(2, 6):
        result = FrameResult(number, number * SECOND_NS, Status.TRACKED, np.eye(4), False, 9, 1.0, 1.0, '', StageTimings())
        twists.append(estimator.observe(located(number, is_corrected=number > 3), result).twist)
    for twist in twists[1:]:
        np.testing.assert_allclose(twist, se3.log(STEP), atol=1e-9)


def corrected_graph() -> SimpleNamespace:
    """Two keyframes, of which the second was corrected when it was added."""
    nodes = Nodes().added(0, 0, np.eye(4)).added(2, 2 * SECOND_NS, np.linalg.matrix_power(STEP, 2))
    nodes = nodes.moved(np.array([np.eye(4), JUMP @ nodes.T_world_cam[1]]))
    return SimpleNamespace(num_corrections=1, corrected=nodes.corrected)


@pytest.mark.parametrize('is_corrected', [False, True])
def test_the_path_follows(is_corrected: bool) -> None:
    factory, path = RclpyMessages(), PathHistory(100)
    for number in range(3):
        T = np.linalg.matrix_power(STEP, number)
        path.append(number * SECOND_NS, T, poses.pose_stamped(factory, T, number * SECOND_NS, 'map'))
    graph = corrected_graph() if is_corrected else SimpleNamespace(num_corrections=0)
    context: Any = SimpleNamespace(
        slam=SimpleNamespace(graph=graph), located=located(2, is_corrected=False), factory=factory, map_frame='map'
    )
    shown = [poses.pose_matrix(message.pose) for message in path.poses(context)]
    last = JUMP @ np.linalg.matrix_power(STEP, 2) if is_corrected else np.linalg.matrix_power(STEP, 2)
    np.testing.assert_allclose(shown[2], last, atol=1e-9)
    np.testing.assert_allclose(shown[0], np.eye(4), atol=1e-9)


def test_the_path_before_a_jump_in_time_stays() -> None:
    """Its stamps are those of other frames then, and its keyframes are no longer in the graph."""
    factory, path = RclpyMessages(), PathHistory(100)

    def walk() -> None:
        for number in range(3):
            T = np.linalg.matrix_power(STEP, number)
            path.append(number * SECOND_NS, T, poses.pose_stamped(factory, T, number * SECOND_NS, 'map'))

    walk()
    before = corrected_graph()
    path.end_time(before)  # type: ignore[arg-type]
    walk()
    after = SimpleNamespace(num_corrections=2, corrected=lambda stamps_ns, T: np.linalg.matrix_power(JUMP, 3) @ T)
    context: Any = SimpleNamespace(
        slam=SimpleNamespace(graph=after), located=located(2, is_corrected=False), factory=factory, map_frame='map'
    )
    shown = [poses.pose_matrix(message.pose) for message in path.poses(context)]
    np.testing.assert_allclose(shown[2], JUMP @ np.linalg.matrix_power(STEP, 2), atol=1e-9)
    np.testing.assert_allclose(shown[3], np.linalg.matrix_power(JUMP, 3), atol=1e-9)


def test_a_graph_is_three_markers() -> None:
    centres = motions.exp(np.arange(3)[:, None] * np.array([1.0, 0, 0, 0, 0, 0]))[:, :3, 3]
    edges, loops = np.array([(0, 1), (1, 2)]), np.array([(0, 2)])
    message = markers.graph(RclpyMessages(), centres, edges, loops, stamp_ns=5, frame_id='map')
    assert [marker.ns for marker in message.markers] == ['keyframes', 'edges', 'loops']
    assert [len(marker.points) for marker in message.markers] == [3, 4, 2]
    assert [point.x for point in message.markers[2].points] == [0.0, 2.0]
    assert {marker.header.frame_id for marker in message.markers} == {'map'}
    alone = markers.graph(RclpyMessages(), centres[:1], edges[:0], loops[:0], stamp_ns=5, frame_id='map')
    assert [marker.action for marker in alone.markers] == [0, 2, 2]  # what is empty is deleted


CLOSING_LOOPS = {
    'preset': 'realtime', 'slam__graph__enabled': True, 'slam__graph__loop_after': 8, 'slam__graph__min_correction_m': 0.0,
    'slam__keyframes__every': 2, 'slam__tracking__min_inlier_fraction': 0.5, 'queue_policy': 'all',
}  # fmt: skip


@pytest.mark.slow
def test_a_running_node_corrects_map_to_odom_only(graph: Graph, tf_message: type) -> None:
    """There and back, with loops: odometry never jumps, and the links of /tf make up the pose that is published."""
    moving = graph.collect(tf_message, '/tf')
    live = Live(graph, **CLOSING_LOOPS)
    live.wait(lambda: graph.node.count_publishers('/tf'))
    sequence = open_sequence('synthetic', width=96)
    numbers = [*range(11), *range(9, -1, -1)]
    shown = [live.show(replace(sequence[index], stamp_ns=10**9 + k * 33_333_333)) for k, index in enumerate(numbers)]
    live.wait(lambda: stamps_of([message.transforms[0] for message in moving])[-1:] == stamps_of(shown[-1:]))
    links: dict[str, dict[int, np.ndarray]] = {'odom': {}, CAMERA_FRAME: {}}
    for transform in chain.from_iterable(message.transforms for message in moving):
        stamp_ns = stamps.message_stamp_ns(transform)
        links[transform.child_frame_id][stamp_ns] = poses.transform_matrix(transform.transform)
    corrections, odometry = links['odom'], links[CAMERA_FRAME]
    steps_m = [np.linalg.norm((se3.inverse(a) @ b)[:3, 3]) for a, b in pairwise(odometry.values())]
    assert max(steps_m) < 0.05  # the camera moves by less than 2 cm a frame
    assert len({T.tobytes() for T in corrections.values()}) > 1
    for pose in shown:
        stamp_ns = stamps.message_stamp_ns(pose)
        if stamp_ns in odometry:  # the subscription may be discovered after the first frames
            np.testing.assert_allclose(corrections[stamp_ns] @ odometry[stamp_ns], poses.pose_matrix(pose.pose), atol=1e-9)


@pytest.mark.slow
def test_yesterdays_map_goes_on(graph: Graph) -> None:
    """Two days: the second one finds itself in the map of the first, maps on, corrects on demand, and saves both."""
    sequence, folders = open_sequence('synthetic', width=160), [graph.folder / day for day in ('first', 'second')]
    settings = {**CLOSING_LOOPS, 'slam__mapping__iterations': 3}

    def walk(live: Live, numbers: range, since_ns: int) -> list[Any]:
        return [live.show(replace(sequence[index], stamp_ns=since_ns + k * 33_333_333)) for k, index in enumerate(numbers)]

    def end(live: Live) -> None:
        live.node.send(signal.SIGINT)
        assert live.node.wait() == 0

    first = Live(graph, **settings, save_path=folders[0])
    assert walk(first, range(0, 48, 3), 10**9)[-1] is not None
    end(first)
    second = Live(graph, **settings, load_path=folders[0], save_path=folders[1])
    assert second.node.says('keyframes', 'is looked for by them')
    shown = walk(second, range(1, 40, 3), 10**10)
    assert shown[0] is None and shown[-1] is not None and second.node.says('relocalised by keyframe')
    Control(graph).succeed('optimize')
    end(second)
    sizes = [(len(read_ply(folder / 'map.ply')), len(read_map_keyframes(folder / 'map.keyframes').keyframes)) for folder in folders]
    assert all(after > before for before, after in zip(*sizes, strict=True))
