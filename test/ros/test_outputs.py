"""Outputs over DDS: nothing while lost, diagnostics, latched topics for late subscribers, and configurations of viewers."""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from camera import CAMERA_FRAME, LATCHED, QUICK, Camera, Live, run_node, still
from control import Control
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from graph import Graph
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import Reader, Writer
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import Image, PointCloud2, PointField
from std_msgs.msg import Header

from msg_adapters import stamps
from msg_adapters.factory import message_class
from splatam_core.config import load_config
from splatam_core.datasets.synthetic import SyntheticSequence
from splatam_core.resources import config_dir
from splatam_core.slam import Slam
from splatam_core.types import FrameResult, MapSnapshot, RenderedView, RgbdFrame, StageTimings, Status
from splatam_ros import interface
from splatam_ros.frames.robot_frames import RobotFrames
from splatam_ros.node.diagnostics import PERIOD_S, FrameCounters, InputSample, Sample, reports
from splatam_ros.node.outputs import OUTPUTS, Outputs
from splatam_ros.node.parameters import NODE_SETTINGS, node_options
from splatam_ros.throttled_warnings import ThrottledWarnings

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


def covered(frame: RgbdFrame) -> RgbdFrame:
    """Returns what a covered camera sees: no depth in its range."""
    return replace(frame, depth_m=np.full_like(frame.depth_m, 0.05))


def newest_stamp(messages: list[Any]) -> int | None:
    return stamps.message_stamp_ns(messages[-1]) if messages else None


class Diagnostics:
    """The newest statuses by name."""

    def __init__(self, graph: Graph) -> None:
        self.arrays = graph.collect(DiagnosticArray, '/diagnostics')

    def __getitem__(self, name: str) -> DiagnosticStatus:
        return next(status for status in self.arrays[-1].status if status.name == f'splatam: {name}')

    def level(self, name: str) -> bytes | None:
        return self[name].level if self.arrays else None

    def values(self, name: str) -> dict[str, str]:
        return {item.key: item.value for item in self[name].values}


def test_a_covered_camera_is_lost_in_silence_and_found_again(graph: Graph, tf_message: type, frames: SyntheticSequence) -> None:
    camera, diagnostics = Camera(graph), Diagnostics(graph)
    done = graph.collect(Header, '/splatam/processed')
    heard = {
        'pose': graph.collect(PoseStamped, '/splatam/pose'), 'odometry': graph.collect(Odometry, '/splatam/odometry'),
        'path': graph.collect(PathMessage, '/splatam/path', LATCHED),
        'pose_with_covariance': graph.collect(PoseWithCovarianceStamped, '/splatam/pose_with_covariance'),
        'map/points': graph.collect(PointCloud2, '/splatam/map/points', LATCHED),
    }  # fmt: skip
    moving = graph.collect(tf_message, '/tf')
    node = run_node(graph, queue_policy='all', publish_rate__path=0.0, publish_rate__cloud=0.0)
    camera.wait_matched()
    graph.spin_until(lambda: diagnostics.level('tracking') == WARN, explain=lambda: node.text)
    assert diagnostics['tracking'].message == 'no frame yet'

    def send(frame: RgbdFrame) -> None:
        camera.send(frame)
        graph.spin_until(lambda: done and stamps.to_ns(done[-1].stamp) == frame.stamp_ns, explain=lambda: node.text)

    for number in range(3):
        send(still(frames, number))
    graph.spin_until(lambda: diagnostics.values('tracking')['frames tracked'] == '2', explain=lambda: node.text)
    assert diagnostics.level('tracking') == OK and diagnostics.values('tracking')['status'] == 'tracked'
    graph.spin_until(lambda: len(heard['pose']) == len(heard['odometry']) == 3 == len(moving), explain=lambda: node.text)
    for latched in ('path', 'map/points'):  # a late subscriber gets the newest message
        graph.spin_until(lambda: newest_stamp(heard[latched]) == still(frames, 2).stamp_ns)  # noqa: B023
    assert float(diagnostics.values('tracking')['inlier fraction']) > 0.5
    gaussians = diagnostics.values('map')['Gaussians']
    before = {name: len(messages) for name, messages in heard.items()}

    for number in range(3, 6):
        send(covered(still(frames, number)))
    graph.spin_until(lambda: diagnostics.level('tracking') == ERROR, explain=lambda: node.text)
    assert diagnostics['tracking'].message == 'lost: no pixel has a usable depth reading'
    assert diagnostics.values('map')['Gaussians'] == gaussians
    graph.spin_for(0.5)
    assert {name: len(messages) for name, messages in heard.items()} == before
    links = [[(transform.header.frame_id, transform.child_frame_id) for transform in message.transforms] for message in moving]
    assert links[2:] == [[('map', 'odom'), ('odom', CAMERA_FRAME)], *[[('map', 'odom')]] * 3]  # where the camera is, nobody knows

    send(still(frames, 6))
    graph.spin_until(lambda: diagnostics.level('tracking') == OK, explain=lambda: node.text)
    graph.spin_until(lambda: newest_stamp(heard['odometry']) == still(frames, 6).stamp_ns)
    found = heard['odometry'][-1]
    assert found.twist.covariance[0] == 1e6  # the motion while lost is not known
    assert heard['odometry'][2].twist.covariance[0] < 1  # before the loss it was known


def test_an_uncertain_frame_is_published_with_its_covariance_only(
    graph: Graph, tf_message: type, frames: SyntheticSequence
) -> None:
    live, diagnostics, control = Live(graph, queue_policy='all'), Diagnostics(graph), Control(graph)
    odometry = graph.collect(Odometry, '/splatam/odometry')
    poses = graph.collect(PoseWithCovarianceStamped, '/splatam/pose_with_covariance')
    moving = graph.collect(tf_message, '/tf')
    live.wait(lambda: all(map(graph.node.count_publishers, ('/splatam/odometry', '/splatam/pose_with_covariance', '/tf'))))
    assert live.show(still(frames, 0)) and live.show(still(frames, 1))
    control.change(slam__tracking__max_error_m=1e-4)  # nothing is as sure as that
    assert live.show(still(frames, 2)) is None
    live.wait(lambda: diagnostics.level('tracking') == WARN and diagnostics['tracking'].message.startswith('uncertain: its pose'))
    live.wait_says('WARN', 'uncertain at', 'its pose may be off by')
    control.change(slam__tracking__max_error_m=1.0)
    assert live.show(still(frames, 3))
    sent = [still(frames, number).stamp_ns for number in range(4)]
    live.wait(lambda: len(odometry) == len(poses) == len(moving) == 4)
    assert [stamps.message_stamp_ns(message) for message in poses] == sent == [stamps.message_stamp_ns(m) for m in odometry]
    assert [len(message.transforms) for message in moving] == [2, 2, 1, 2]
    covariances = [np.array(message.pose.covariance).reshape(6, 6) for message in poses]
    for covariance, message in zip(covariances, odometry):
        assert (np.linalg.eigvalsh(covariance) > 0).all() and np.allclose(covariance, covariance.T)
        np.testing.assert_allclose(message.pose.covariance, covariance.ravel(), rtol=1e-9)  # without a base, the camera's
    assert np.sqrt(covariances[1][0, 0]) < 0.1
    counts = diagnostics.values('tracking')
    live.wait(lambda: diagnostics.values('tracking')['frames uncertain'] == '1')
    assert set(counts) >= {'frames uncertain', 'position standard deviation (m)', 'directions held by the prediction'}


def test_diagnostics_say_what_comes_and_goes(graph: Graph, frames: SyntheticSequence) -> None:
    """Checks contents and order. The time between two reports depends on the machine, but on average is at least a period."""
    started_s = time.monotonic()
    camera, diagnostics = Camera(graph), Diagnostics(graph)
    done = graph.collect(Header, '/splatam/processed')
    node = run_node(graph, queue_policy='all')
    camera.wait_matched()
    topics = '/rgb/image', '/depth/image', '/rgb/camera_info'
    numbers = itertools.count()

    def values(name: str, key: str) -> str:
        return diagnostics.values(name)[key]

    def rates() -> list[float]:
        inputs = [float(values('input', f'{topic} rate (Hz)')) for topic in topics]
        return [*inputs, float(values('processing', 'frame rate (Hz)')), float(values('processing', 'pose rate (Hz)'))]

    def explain() -> str:
        return f'{diagnostics.arrays[-1:]} {node.text}'

    def is_busy() -> bool:
        """Send a frame whose stamp is half a second old, and wait for it."""
        stamp_ns = graph.node.get_clock().now().nanoseconds - 500_000_000
        camera.send(replace(still(frames, next(numbers)), stamp_ns=stamp_ns))
        graph.spin_until(lambda: done and stamps.to_ns(done[-1].stamp) == stamp_ns, explain=explain)
        if not diagnostics.arrays or diagnostics.level('processing') != OK or min(rates()) == 0:
            return False
        return float(values('processing', 'track (ms)')) > 0  # the first frame is not tracked

    graph.spin_until(is_busy, explain=explain)
    assert [status.name for status in diagnostics.arrays[-1].status] == [
        'splatam: input', 'splatam: tracking', 'splatam: processing', 'splatam: map'
    ]  # fmt: skip
    assert {status.hardware_id for status in diagnostics.arrays[-1].status} == {CAMERA_FRAME}
    for topic in topics:  # the age of the stamp, and more on a busy machine
        assert 0.5 <= float(values('input', f'{topic} delay (s)')) < time.monotonic() - started_s + 0.5
        assert values('input', f'{topic} publishers') == '1'
    assert 0.5 < float(values('processing', 'pose delay (s)')) < time.monotonic() - started_s + 0.5
    assert 0 < float(values('processing', 'track (ms)')) < float(values('processing', 'total (ms)'))
    assert {'frames waiting', 'frames dropped', 'frames refused', 'frames that shortened mapping', 'map (ms)'} <= (
        diagnostics.values('processing').keys()
    )
    assert int(values('map', 'Gaussians')) > 1000
    assert 50 < float(values('map', 'memory (MB)')) < 4000  # torch alone is above the lower limit

    graph.spin_until(lambda: max(rates()) == 0, explain=explain)  # no more images are sent
    counts = [int(values('tracking', f'frames {status.value}')) for status in Status]
    assert sum(counts) == len(done) == next(numbers)
    reported_ns = [stamps.message_stamp_ns(array) for array in diagnostics.arrays]
    assert reported_ns == sorted(reported_ns) and reported_ns[-1] <= graph.node.get_clock().now().nanoseconds
    assert len(reported_ns) <= (time.monotonic() - started_s) / PERIOD_S + 1


def sample(seconds: float, *, received: int = 0, problem: str = '', **changes: Any) -> Sample:
    counters = {
        'monotonic_s': seconds, 'inputs': [InputSample('/rgb/image', received, 1, 0.01)], 'unpaired': 0,
        'waiting_frames': 0, 'dropped_frames': 0, 'refused_frames': 0, 'frames': dict.fromkeys(Status, 0), 'poses': 0,
        'delay_s': None, 'result': None, 'rss_mb': None, 'problem': problem, 'camera_frame': '',
    }  # fmt: skip
    return Sample(**{**counters, **changes})


@pytest.mark.parametrize(
    ('changes', 'name', 'level', 'text'),
    [
        ({'problem': 'no publisher on /rgb/image'}, 'input', ERROR, 'no frames: no publisher on /rgb/image'),
        ({'unpaired': 3}, 'input', WARN, '3 images dropped without a partner'),
        ({}, 'input', OK, 'waiting for the first frame'),
        ({'dropped_frames': 2}, 'processing', WARN, 'SLAM is slower than the camera: 2 frames dropped'),
        ({'refused_frames': 1, 'dropped_frames': 2}, 'processing', WARN, '1 frames could not be used'),
        ({}, 'map', OK, '0 Gaussians'),
    ],
)
def test_levels(changes: dict[str, Any], name: str, level: bytes, text: str) -> None:
    found = {report.name: report for report in reports(sample(0), sample(2, **changes))}
    assert (found[name].level, found[name].text) == (level, text)


def test_rates_are_of_the_time_between_two_samples() -> None:
    frames = {**dict.fromkeys(Status, 0), Status.TRACKED: 7}
    found = reports(sample(10, received=100), sample(12, received=160, frames=frames, poses=6))
    values = {key: value for report in found for key, value in report.values.items()}
    assert values['/rgb/image rate (Hz)'] == '30.0'
    assert (values['frame rate (Hz)'], values['pose rate (Hz)']) == ('3.5', '3.0')


def test_frames_that_shorten_mapping_are_counted() -> None:
    counters = FrameCounters()
    for postponed in (0, 2, 0, 3):
        result = FrameResult(0, 1, Status.TRACKED, np.eye(4), False, 9, 1.0, 1.0, '', StageTimings(), postponed_steps=postponed)
        counters.add(result, 'camera')
    (report,) = [
        item
        for item in reports(sample(0), sample(2, frames=counters.by_status, shortened=counters.shortened))
        if item.name == 'processing'
    ]
    assert (report.level, report.values['frames that shortened mapping']) == (OK, '2')
    assert report.text == '2.0 frames per second, of 4 frames 2 fitted the map less because others waited'
    assert ' 2 fitted the map less' in counters.progress(result)


def test_the_map_is_there_for_whoever_comes_after_the_last_frame(graph: Graph, frames: SyntheticSequence) -> None:
    camera, done = Camera(graph), graph.collect(Header, '/splatam/processed')
    node = run_node(graph, queue_policy='all', max_cloud_points=100, max_path_poses=2)
    camera.wait_matched()
    for number in range(4):
        camera.send(still(frames, number))
    graph.spin_until(lambda: len(done) == 4, explain=lambda: node.text)
    clouds = graph.collect(PointCloud2, '/splatam/map/points', LATCHED)
    paths = graph.collect(PathMessage, '/splatam/path', LATCHED)
    graph.spin_until(lambda: clouds and paths, explain=lambda: node.text)

    (cloud,), (path,) = clouds, paths
    assert stamps.message_stamp_ns(cloud) == stamps.message_stamp_ns(path) == still(frames, 3).stamp_ns
    assert [stamps.message_stamp_ns(pose) for pose in path.poses] == [still(frames, n).stamp_ns for n in (0, 3)]
    check_cloud(cloud, 100)
    graph.spin_for(2.5)  # more than two periods of both
    assert len(clouds) == len(paths) == 1  # nothing new, so nothing is published


class Counted(Slam):
    """Counts the calls of the costly functions."""

    renders = snapshots = 0

    def render(self, T_world_cam: np.ndarray) -> RenderedView:
        self.renders += 1
        return super().render(T_world_cam)

    def snapshot(self) -> MapSnapshot:
        self.snapshots += 1
        return super().snapshot()


class ManualClock:
    """Stands in for the ``time`` module: time passes when the test says so."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s


def test_what_costs_is_made_for_listeners_only_and_at_its_rate(
    graph: Graph, frames: SyntheticSequence, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = ManualClock()
    monkeypatch.setattr('splatam_ros.node.outputs.time', clock)
    for nobody_listens in ('odometry', 'pose_with_covariance'):
        monkeypatch.delattr(f'splatam_ros.node.outputs.poses.{nobody_listens}')
    options = node_options({'publish_tf': False, 'publish_rate.render': 4.0, 'publish_rate.cloud': 2.0})
    warnings = ThrottledWarnings(graph.node.get_logger())
    robot_frames = RobotFrames(graph.node, options.frames, warnings, reliability='auto', keep_all=False)
    outputs = Outputs(graph.node, options, robot_frames)
    slam = Counted(load_config('quick', QUICK))
    result = slam.process(frames[0])
    heard: dict[str, list[Any]] = {}
    numbers = itertools.count()

    def publish() -> None:
        """Publish a frame, 20 ms after the last, and wait for its messages."""
        clock.now_s += 0.02
        stamp_ns = result.stamp_ns + 20_000_000 * next(numbers)
        frame = replace(frames[0], stamp_ns=stamp_ns, frame_id=CAMERA_FRAME)
        assert result.T_world_cam is not None
        located = robot_frames.locate(frame, result.T_world_cam, None)
        outputs.publish(frame, replace(result, stamp_ns=stamp_ns), located, slam)
        made = {'render': slam.renders, 'map': slam.snapshots}
        graph.spin_until(lambda: all(len(heard[topic]) == made.get(topic.split('/')[0], len(heard[topic])) for topic in heard))

    def publish_for(seconds: float) -> None:
        for _ in range(round(seconds * 50)):
            publish()

    def listen(topics: dict[str, type]) -> None:
        for topic, kind in topics.items():
            heard[topic] = graph.collect(kind, f'/test/{topic}')
        publishers = [publisher for output, publisher in outputs._publishers if output.topic in topics]
        graph.spin_until(lambda: all(publisher.get_subscription_count() for publisher in publishers))

    poses = graph.collect(PoseStamped, '/test/pose')
    graph.spin_until(lambda: publish() or len(poses) > 5)
    assert slam.renders == slam.snapshots == 0

    listen({'render/rgb': Image, 'render/depth': Image, 'render/silhouette': Image, 'path': PathMessage})
    publish_for(2.0)
    assert slam.snapshots == 0
    # The first frame at or after each multiple of the period: every 0.26 s at 4 Hz and 50 frames a second.
    assert slam.renders == 8  # one render serves all three images
    graph.spin_until(lambda: len(heard['path']) == 2)  # at the start, and a second later
    listen({'map/points': PointCloud2})
    publish_for(2.0)
    assert len(heard['map/points']) == slam.snapshots == 4
    outputs.use(replace(options, publish_rate_cloud=0.0))
    clock.now_s += 1.0
    publish_for(0.5)
    assert slam.snapshots == 4 + 25  # with every pose
    outputs.serve_late_subscribers(slam)
    assert slam.snapshots == 4 + 25
    outputs.refresh()  # the map has changed without a frame
    assert outputs.has_late_subscriber
    outputs.serve_late_subscribers(slam)
    assert slam.snapshots == 4 + 25 + 1
    assert heard['path'][-1].poses
    outputs.begin_map()
    graph.spin_until(lambda: not heard['path'][-1].poses)  # that of the old map is taken back


def check_cloud(cloud: PointCloud2, count: int) -> None:
    """Checks the layout: first the fields for RViz's RGB8 transformer and Foxglove's ``rgb`` colour mode, then ours."""
    assert [(field.name, field.offset, field.datatype, field.count) for field in cloud.fields] == [
        (name, 4 * i, PointField.FLOAT32, 1) for i, name in enumerate(('x', 'y', 'z', 'rgb', 'opacity', 'radius'))
    ]
    assert (cloud.height, cloud.width, cloud.point_step, cloud.row_step) == (1, count, 24, 24 * count)
    assert cloud.header.frame_id == 'map' and cloud.is_dense and not cloud.is_bigendian
    opacity, radius = np.frombuffer(bytes(cloud.data), '<f4').reshape(count, 6)[:, 4:].T
    assert ((opacity > 0) & (opacity < 1)).all()
    assert ((radius > 1e-4) & (radius < 0.5)).all()  # metres; Gaussians of a room seen by 64x48 pixels


# --- recording: the standard recorder is not available, so the test records in the same way ---


def recorder_qos(offered: QoSProfile) -> QoSProfile:
    """Returns the QoS with which rosbag2 subscribes: exactly what is offered."""
    return QoSProfile(depth=100, reliability=offered.reliability, durability=offered.durability)


def recorded_qos(offered: QoSProfile) -> Qos:
    latched = offered.durability == DurabilityPolicy.TRANSIENT_LOCAL
    durability = QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE
    none = QosTime(0, 0)
    return Qos(QosHistory.KEEP_LAST, offered.depth or 1, QosReliability.RELIABLE, durability, none, none,
               QosLiveliness.AUTOMATIC, none, False)  # fmt: skip


def test_what_was_recorded_of_the_node_plays_back(graph: Graph, tf_message: type, bag: Path, frames: SyntheticSequence) -> None:
    """Records every output raw, with types and QoS from the graph; reads the bag with another library and plays it."""
    node = run_node(graph, queue_policy='all', exit_on_publisher_end=True, publish_rate__path=0.0,
                    publish_rate__cloud=0.0)  # fmt: skip
    topics = [*TOPICS, '/splatam/processed', '/tf', '/diagnostics']
    graph.spin_until(lambda: all(map(graph.node.count_publishers, topics)), explain=lambda: node.text)
    infos = {topic: graph.node.get_publishers_info_by_topic(topic)[0] for topic in topics}
    heard = {
        topic: graph.collect(message_class(info.topic_type), topic, recorder_qos(info.qos_profile), raw=True)
        for topic, info in infos.items()
    }
    player = graph.play_in_step(str(bag))
    graph.spin_until(lambda: not node.is_running, explain=lambda: player.text + node.text)
    assert (player.wait(), node.wait()) == (0, 0), player.text + node.text
    graph.spin_until(lambda: len(heard['/splatam/pose']) == len(heard['/tf']) == len(frames) and all(heard.values()))

    store = get_typestore(Stores.ROS2_JAZZY)
    copy = graph.folder / 'outputs'
    with Writer(copy, version=9) as writer:
        for topic, messages in heard.items():
            offered = recorded_qos(infos[topic].qos_profile)
            type_name = infos[topic].topic_type
            added = writer.add_connection(topic, type_name, typestore=store, offered_qos_profiles=[offered])
            for number, data in enumerate(messages):
                writer.write(added, 10**9 + number * 10**8, data)
    with Reader(copy) as reader:
        for connection, _, data in reader.messages():
            assert store.deserialize_cdr(data, connection.msgtype) is not None
    again = {
        topic: graph.collect(message_class(infos[topic].topic_type), f'/again{topic}', LATCHED, raw=True)
        for topic in ('/splatam/path', '/splatam/map/points')
    }
    replay = graph.play(
        str(copy), '--rate', 'max', '--no-wait-for-subscribers', '--loop', '--delay', '0.5', '--remap',
        *(f'{topic}:=/again{topic}' for topic in topics),
    )  # fmt: skip
    graph.spin_until(lambda: all(again.values()), explain=lambda: replay.text)
    assert not replay.says('left out')
    for topic, messages in again.items():  # latched as recorded, so a late subscriber gets them
        assert messages[0] in heard[topic]


# --- viewers: they cannot run in a test, but their configurations can be checked ---

SHOWS = {
    'rviz_default_plugins/PointCloud2': 'sensor_msgs/msg/PointCloud2',
    'rviz_default_plugins/Map': 'nav_msgs/msg/OccupancyGrid',
    'rviz_default_plugins/Path': 'nav_msgs/msg/Path',
    'rviz_default_plugins/MarkerArray': 'visualization_msgs/msg/MarkerArray',
    'rviz_default_plugins/Pose': 'geometry_msgs/msg/PoseStamped',
    'rviz_default_plugins/Odometry': 'nav_msgs/msg/Odometry',
    'rviz_default_plugins/Image': 'sensor_msgs/msg/Image',
}
TOPICS = {f'/splatam/{output.topic}': output for output in OUTPUTS}
MAP_FRAME = next(setting.default for setting in NODE_SETTINGS if setting.name == 'map_frame')


def test_rviz_subscribes_to_what_the_node_publishes() -> None:
    manager = yaml.safe_load((config_dir() / 'rviz' / 'splatam.rviz').read_text())['Visualization Manager']
    displays = [display for display in manager['Displays'] if 'Topic' in display]
    assert {display['Class'] for display in displays} == SHOWS.keys()
    assert manager['Global Options']['Fixed Frame'] == MAP_FRAME
    for display in displays:
        topic = display['Topic']
        output = TOPICS[topic['Value']]
        assert output.type_name == SHOWS[display['Class']]
        latched = output.qos.durability == DurabilityPolicy.TRANSIENT_LOCAL
        assert topic['Durability Policy'] == ('Transient Local' if latched else 'Volatile')
        assert topic['Reliability Policy'] == 'Reliable' and output.qos.reliability == ReliabilityPolicy.RELIABLE
    (cloud,) = (display for display in displays if display['Class'].endswith('PointCloud2'))
    assert (cloud['Color Transformer'], cloud['Position Transformer']) == ('RGB8', 'XYZ')


def test_foxglove_shows_what_the_node_publishes() -> None:
    layout = json.loads((config_dir() / 'foxglove' / 'splatam.json').read_text())
    panels = layout['configById']
    assert set(leaves(layout['layout'])) == panels.keys()
    scene = panels['3D!map']
    named = {*scene['topics'], *(panel['imageMode']['imageTopic'] for panel in panels.values() if 'imageMode' in panel)}
    assert named <= TOPICS.keys() and scene['followTf'] == MAP_FRAME
    shown_in_space = {'PointCloud2', 'OccupancyGrid', 'Path', 'MarkerArray', 'PoseStamped'}
    assert {topic.type_name.rpartition('/')[2] for topic in map(TOPICS.get, scene['topics'])} == shown_in_space
    cloud = scene['topics']['/splatam/map/points']
    # Foxglove's own choice for a little-endian field called rgb.
    assert (cloud['colorMode'], cloud['colorField'], cloud['rgbByteOrder']) == ('rgb', 'rgb', 'abgr')
    for path in panels['Plot!speed']['paths']:
        topic, *fields = path['value'].split('.')
        value: Any = {'nav_msgs/msg/Odometry': Odometry}[TOPICS[topic].type_name]()
        for field in fields:
            value = getattr(value, field)
        assert isinstance(value, float)


def leaves(node: Any) -> list[str]:
    return [node] if isinstance(node, str) else [*leaves(node['first']), *leaves(node['second'])]


# --- the documentation's tables ---


def test_the_documented_topics_are_those_of_a_running_node(graph: Graph, tf_message: type) -> None:
    node = run_node(graph, odom__source='tf')
    node.wait_says('waiting for')
    relative = {topic.name: topic.type_name for topic in interface.INPUTS if 'replaces' not in topic.help}
    expected_in = {resolved(name): type_name for name, type_name in relative.items() if name not in ('odom', 'imu')}
    expected_out = {f'/splatam/{output.topic}': output.type_name for output in OUTPUTS}
    expected_out |= {resolved(topic.name): topic.type_name for topic in interface.SHARED_OUTPUTS}
    subscribed = on_graph(lambda: graph.node.get_subscriber_names_and_types_by_node('splatam', '/'))
    published = on_graph(lambda: graph.node.get_publisher_names_and_types_by_node('splatam', '/'))
    own = {'/rosout', '/parameter_events'}  # rclpy's
    graph.spin_until(lambda: subscribed().keys() - own == expected_in.keys(), explain=lambda: str(subscribed()))
    graph.spin_until(lambda: published().keys() - own == expected_out.keys(), explain=lambda: str(published()))
    assert subscribed().items() >= expected_in.items() and published().items() >= expected_out.items()


def resolved(name: str) -> str:
    return name.replace('~', '/splatam') if name.startswith('~') else name if name.startswith('/') else f'/{name}'


def on_graph(ask: Callable[[], list[tuple[str, list[str]]]]) -> Callable[[], dict[str, str]]:
    def answer() -> dict[str, str]:
        try:
            return {name: types[0] for name, types in ask()}
        except RuntimeError:  # rclpy: the node has not been discovered yet
            return {}

    return answer
