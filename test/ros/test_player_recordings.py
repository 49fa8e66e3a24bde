"""Recordings as people bring them, played by the player as a separate process."""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from geometry_msgs.msg import PoseStamped
from graph import Graph
from rclpy.serialization import deserialize_message
from rosbags import rosbag1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import CameraInfo, Image
from test_player import DEPTH, INFO, RGB, STREAMS, finish, padded, pose, recorded, stamp_ns, subscribe

STORE = get_typestore(Stores.ROS2_JAZZY)
SECOND = 10**9
Edit = Callable[[str, int, int, bytes], tuple[int, bytes] | None]
"""Gets topic, number within it, time of recording and bytes of a message; gives time and bytes, or None to leave it out."""


def rewritten(bag: Path, path: Path, edit: Edit, compress: bool = False) -> Path:
    """A copy of a recording with other messages."""
    writer = Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3)
    if compress:
        writer.set_compression(CompressionMode.FILE, CompressionFormat.ZSTD)
    with Reader(bag) as reader, writer:
        added = {c.topic: writer.add_connection(c.topic, c.msgtype, typestore=STORE) for c in reader.connections}
        counts = dict.fromkeys(added, 0)
        for connection, time_ns, data in reader.messages():
            edited = edit(connection.topic, counts[connection.topic], time_ns, bytes(data))
            counts[connection.topic] += 1
            if edited is not None:
                writer.write(added[connection.topic], *edited)
    return path


def with_stamp(data: bytes, stamp: int) -> bytes:
    return data[:4] + struct.pack('<iI', *divmod(stamp, SECOND)) + data[12:]


def test_the_last_camera_info_before_the_start_is_sent(graph: Graph, bag: Path, tmp_path: Path) -> None:
    """Some recorders write it once, at the beginning."""
    once = rewritten(bag, tmp_path / 'once', lambda topic, number, ns, data: None if topic == INFO and number else (ns, data))
    received = subscribe(graph)
    finish(graph, player := graph.play(str(once), '--start-offset', '0.2', '--rate', 'max'))
    assert padded(received[INFO]) == padded(recorded(bag, INFO)[:1])
    assert 0 < len(received[RGB]) < 7, player.text


def test_it_is_the_last_one_and_no_earlier(graph: Graph, bag: Path) -> None:
    received = subscribe(graph)
    finish(graph, graph.play(str(bag), '--start-offset', '0.2', '--rate', 'max'))  # frame 6 begins at 0.2 s
    infos = [stamp_ns(data) for data in received[INFO]]
    assert infos == [stamp_ns(data) for data in recorded(bag, INFO)][5:]


def test_frames_whose_depth_is_late_are_waited_for(graph: Graph, bag: Path, tmp_path: Path) -> None:
    """15 Hz, depth 30 ms late: the node pairs them, so the player must count them, and stay at most two ahead."""

    def late(topic: str, number: int, ns: int, data: bytes) -> tuple[int, bytes]:
        stamp = SECOND + number * 66_000_000 + (30_000_000 if topic == DEPTH else 0)
        return stamp, with_stamp(data, stamp)

    received = subscribe(graph)
    publisher = graph.publisher(PoseStamped, '/splatam/pose')
    path = rewritten(bag, tmp_path / 'late', late)
    player = graph.play(str(path), '--rate', 'max', '--wait-for', '--max-ahead', '2')

    def answer(number: int) -> None:
        graph.spin_until(lambda: len(received[DEPTH]) > number, explain=lambda: player.text)
        graph.spin_for(0.05)
        assert len(received[DEPTH]) <= number + 3
        publisher.publish(pose(stamp_ns(received[RGB][number])))

    for number in range(12):
        answer(number)
    finish(graph, player)
    assert 'no depth image' not in player.text


def test_an_interval_can_be_stated(graph: Graph, bag: Path, tmp_path: Path) -> None:
    def late(topic: str, number: int, ns: int, data: bytes) -> tuple[int, bytes]:
        stamp = SECOND + number * 66_000_000 + (30_000_000 if topic == DEPTH else 0)
        return stamp, with_stamp(data, stamp)

    received = subscribe(graph)
    publisher = graph.publisher(PoseStamped, '/splatam/pose')
    path = rewritten(bag, tmp_path / 'late', late)
    player = graph.play(str(path), '--rate', 'max', '--wait-for', '--max-interval', '0.01')

    def answer_last() -> bool:
        if received[DEPTH]:
            publisher.publish(pose(stamp_ns(received[RGB][-1]) + 1))
        return not player.is_running

    graph.spin_until(answer_last, explain=lambda: player.text)
    assert player.wait() == 0, player.text
    assert player.says('12 of those have no depth image')


@pytest.mark.parametrize('profiles', ['', 'no yaml: ['])
def test_a_recording_without_quality_of_service_is_played(graph: Graph, bag: Path, tmp_path: Path, profiles: str) -> None:
    path = rewritten(bag, tmp_path / 'qos', lambda topic, number, ns, data: (ns, data), compress=True)
    content = yaml.safe_load((path / 'metadata.yaml').read_text())
    for topic in content['rosbag2_bagfile_information']['topics_with_message_count']:
        topic['topic_metadata']['offered_qos_profiles'] = profiles
    (path / 'metadata.yaml').write_text(yaml.safe_dump(content))
    received = subscribe(graph)
    finish(graph, player := graph.play(str(path), '--rate', 'max'))
    for _, topic in STREAMS:
        assert padded(received[topic]) == padded(recorded(bag, topic)), player.text


def test_a_cut_recording_is_played_as_far_as_it_is_whole(graph: Graph, bag: Path, tmp_path: Path) -> None:
    path = rewritten(bag, tmp_path / 'cut', lambda topic, number, ns, data: (ns, data))
    (file,) = path.glob('*.db3')
    os.truncate(file, int(0.93 * file.stat().st_size))
    received = subscribe(graph)
    finish(graph, player := graph.play(str(path), '--rate', 'max'))
    assert padded(received[RGB]) == padded(recorded(bag, RGB))[: len(received[RGB])]
    assert len(received[RGB]) >= 6 and player.says('cut.db3 is cut or damaged')


def test_a_message_with_a_damaged_stamp_does_not_end_playback(graph: Graph, bag: Path, tmp_path: Path) -> None:
    def damaged(topic: str, number: int, ns: int, data: bytes) -> tuple[int, bytes]:
        if topic == RGB and number == 3:
            data = data[:8] + b'\xff' * 4 + data[12:]
        return ns, data[:2] if topic == DEPTH and number == 5 else data

    received = subscribe(graph)
    finish(graph, player := graph.play(str(rewritten(bag, tmp_path / 'bad', damaged)), '--rate', 'max'))
    assert (len(received[RGB]), len(received[DEPTH])) == (12, 11)
    assert player.says('2 messages are damaged')


def write_viewer_bag(path: Path) -> None:
    """As RealSense Viewer writes it: camera infos at time 0, images at the time of day, with four bytes more."""
    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types

    def header(ns: int) -> object:
        return types['std_msgs/msg/Header'](0, types['builtin_interfaces/msg/Time'](ns // SECOND, ns % SECOND), '1')

    k = np.array([30.0, 0, 15.5, 0, 30.0, 11.5, 0, 0, 1])
    region = types['sensor_msgs/msg/RegionOfInterest'](0, 0, 0, 0, False)
    info = types['sensor_msgs/msg/CameraInfo'](
        header=header(0), height=24, width=32, distortion_model='None', D=np.zeros(5), K=k, R=np.zeros(9), P=np.zeros(12),
        binning_x=0, binning_y=0, roi=region,
    )  # fmt: skip
    with rosbag1.Writer(path) as writer:
        added = writer.add_connection('/device_0/sensor_1/Color_0/info/camera_info', 'sensor_msgs/msg/CameraInfo', typestore=store)
        writer.write(added, 1, store.serialize_ros1(info, 'sensor_msgs/msg/CameraInfo'))
        for topic, encoding, size in (('sensor_1/Color_0', 'rgb8', 3), ('sensor_0/Depth_0', 'mono16', 2)):
            added = writer.add_connection(f'/device_0/{topic}/image/data', 'sensor_msgs/msg/Image', typestore=store)
            for i in range(5):
                stamp = 10**18 + i * SECOND // 30
                data = np.full(24 * 32 * size, i, np.uint8)
                image = types['sensor_msgs/msg/Image'](
                    header=header(stamp), height=24, width=32, encoding=encoding, is_bigendian=0, step=32 * size, data=data
                )
                writer.write(added, stamp, bytes(store.serialize_ros1(image, 'sensor_msgs/msg/Image')) + b'\x6f\x12\x83\x3a')


def test_a_recording_of_realsense_viewer_begins_with_its_images(graph: Graph, tmp_path: Path) -> None:
    write_viewer_bag(tmp_path / 'viewer.bag')
    color = '/device_0/sensor_1/Color_0'
    images = graph.collect(Image, f'{color}/image/data', raw=True)
    infos = graph.collect(CameraInfo, f'{color}/info/camera_info', raw=True)
    topics = '--topics', f'{color}/image/data', f'{color}/info/camera_info'
    finish(graph, player := graph.play(str(tmp_path / 'viewer.bag'), '--start-offset', '0.03', *topics))
    assert len(infos) == 1 and deserialize_message(infos[0], CameraInfo).k[0] == 30.0, player.text
    assert [deserialize_message(data, Image).data[0] for data in images] == [1, 2, 3, 4]
