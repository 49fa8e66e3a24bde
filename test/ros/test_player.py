"""The player as a separate process, over DDS, with subscribers in the test."""

from __future__ import annotations

import os
import pty
import shutil
import signal
import struct
from collections.abc import Sequence
from pathlib import Path

import pytest
from geometry_msgs.msg import PoseStamped
from graph import FRAMES, Graph
from nav_msgs.msg import Path as PathMessage
from processes import TIMEOUT_S, Process
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, Imu
from std_msgs.msg import String

RGB, DEPTH, INFO = '/rgb/image', '/depth/image', '/rgb/camera_info'
STREAMS = ((Image, RGB), (Image, DEPTH), (CameraInfo, INFO))
UNHEARD = 'nowhere_msgs/msg/Unheard'
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def stamp_ns(data: bytes) -> int:
    seconds, nanoseconds = struct.unpack_from('<iI', data, 4)
    return seconds * 10**9 + nanoseconds


def padded(messages: list[bytes]) -> list[bytes]:
    """Messages as the transport delivers them: zeros up to a multiple of four bytes."""
    return [data + b'\0' * (-len(data) % 4) for data in messages]


def recorded(bag: Path, topic: str) -> list[bytes]:
    with Reader(bag) as reader:
        connections = [connection for connection in reader.connections if connection.topic == topic]
        return [bytes(data) for _, _, data in reader.messages(connections)]


def last_ns(bag: Path) -> int:
    with Reader(bag) as reader:
        return max(time_ns for _, time_ns, _ in reader.messages())


def subscribe(graph: Graph) -> dict[str, list[bytes]]:
    return {topic: graph.collect(message_class, topic, raw=True) for message_class, topic in STREAMS}


def finish(graph: Graph, player: Process) -> None:
    """Spin until the player has ended successfully and its last messages have been received."""
    graph.spin_until(lambda: not player.is_running, explain=lambda: player.text)
    assert player.wait() == 0, player.text
    graph.spin_for(0.2)  # it waited for the transport's acknowledgement; taking is all that is left


def pose(stamp: int) -> PoseStamped:
    message = PoseStamped()
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
    return message


class Answering:
    """A node that answers colour images on request, as splatam_node does when it has processed them."""

    def __init__(self, graph: Graph, topic: str = '/splatam/pose') -> None:
        self.received = subscribe(graph)
        self._publisher = graph.publisher(PoseStamped, topic)
        self._num_answered = 0

    @property
    def num_colors(self) -> int:
        return len(self.received[RGB])

    @property
    def num_ahead(self) -> int:
        return self.num_colors - self._num_answered

    def answer(self, count: int = 1) -> None:
        for data in self.received[RGB][self._num_answered :][:count]:
            self._publisher.publish(pose(stamp_ns(data)))
            self._num_answered += 1


# --- what arrives ---


@pytest.mark.parametrize('storage', [StoragePlugin.SQLITE3, StoragePlugin.MCAP])
def test_every_byte_arrives_in_order(graph: Graph, bag: Path, tmp_path: Path, storage: StoragePlugin) -> None:
    copy = tmp_path / 'copy'
    with Reader(bag) as reader, Writer(copy, version=9, storage_plugin=storage) as writer:
        store = get_typestore(Stores.ROS2_JAZZY)
        by_topic = {c.topic: writer.add_connection(c.topic, c.msgtype, typestore=store) for c in reader.connections}
        for connection, time_ns, data in reader.messages():
            writer.write(by_topic[connection.topic], time_ns, data)
    received = subscribe(graph)
    finish(graph, player := graph.play(str(copy), '--rate', 'max'))
    for topic, messages in received.items():
        assert padded(messages) == padded(recorded(bag, topic)), topic
    assert player.says('played 48 messages', '12 of them colour images')


def test_topics_are_chosen_left_out_and_renamed_and_time_is_cut(graph: Graph, bag: Path) -> None:
    color = graph.collect(Image, '/camera/color', raw=True)
    depth = graph.collect(Image, DEPTH, raw=True)
    poses = graph.collect(PoseStamped, '/ground_truth/pose', raw=True)
    # Frames are 1/30 s apart from 1 s on: these are frames 3 to 8.
    player = graph.play(
        str(bag), '--topics', RGB, DEPTH, '/ground_truth/pose', '--exclude', '/ground_truth/pose',
        '--remap', f'{RGB}:=/camera/color', '--start-offset', '0.09', '--duration', '0.19',
    )  # fmt: skip
    finish(graph, player)
    assert color == recorded(bag, RGB)[3:9]
    assert depth == recorded(bag, DEPTH)[3:9]
    assert poses == []


def clock_ns(clock: Sequence[Clock]) -> list[int]:
    return [message.clock.sec * 10**9 + message.clock.nanosec for message in clock]


def test_clock_runs_between_the_messages(graph: Graph, bag: Path) -> None:
    received = subscribe(graph)
    clock = graph.collect(Clock, '/clock')
    player = graph.play(str(bag), '--rate', '0.05', '--clock', '100')  # 67 in the time of a frame
    graph.spin_until(lambda: received[RGB] and len(set(clock_ns(clock))) > 2 * FRAMES, explain=lambda: player.text)
    assert clock_ns(clock) == sorted(clock_ns(clock))
    assert clock_ns(clock)[0] >= 10**9


def test_clock_does_not_pass_the_end_where_the_last_messages_are_late(graph: Graph, bag: Path) -> None:
    received = subscribe(graph)
    clock = graph.collect(Clock, '/clock')
    player = graph.play(str(bag), '--rate', '0.5', '--clock', '100')
    graph.spin_until(lambda: received[RGB] and clock, explain=lambda: player.text)
    player.send(signal.SIGSTOP)
    graph.spin_for(1.0)
    player.send(signal.SIGCONT)
    finish(graph, player)
    assert len(received[RGB]) == FRAMES
    assert clock_ns(clock)[-1] <= last_ns(bag)


def test_loop_starts_over_until_stopped(graph: Graph, bag: Path) -> None:
    received = subscribe(graph)
    player = graph.play(str(bag), '--rate', 'max', '--loop')
    graph.spin_until(lambda: len(received[RGB]) > 30, explain=lambda: player.text)
    player.send(signal.SIGINT)
    graph.spin_until(lambda: not player.is_running)
    assert player.wait() == 128 + signal.SIGINT
    assert player.says('stopped by SIGINT', 'colour images handed out')
    assert received[RGB][:30] == (recorded(bag, RGB) * 3)[:30]


def make_mixed_bag(path: Path) -> None:
    """A latched text at the start, a type that is not installed, and IMU messages; no image."""
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg('int32 value', UNHEARD))
    zero = QosTime(0, 0)
    latched = Qos(QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, zero, zero,
                  QosLiveliness.AUTOMATIC, zero, False)  # fmt: skip
    with Writer(path, version=9) as writer:
        text = writer.add_connection('/note', 'std_msgs/msg/String', typestore=store, offered_qos_profiles=[latched])
        unheard = writer.add_connection('/unheard', UNHEARD, typestore=store)
        imu = writer.add_connection('/imu', 'sensor_msgs/msg/Imu', typestore=store)
        writer.write(text, 10**9, serialize_message(String(data='true from the start')))
        for i in range(20):
            writer.write(unheard, 10**9 + i, store.serialize_cdr(store.types[UNHEARD](i), UNHEARD))
            writer.write(imu, 10**9 + i * 50_000_000, serialize_message(Imu()))


def test_latched_messages_precede_the_start_and_unknown_types_are_left_out(graph: Graph, tmp_path: Path) -> None:
    make_mixed_bag(tmp_path / 'mixed')
    notes = graph.collect(String, '/note', LATCHED)
    # Slow: without images the player waits for nobody, and must still be there when we are discovered.
    player = graph.play(str(tmp_path / 'mixed'), '--start-offset', '0.5', '--rate', '0.01')
    graph.spin_until(lambda: notes, explain=lambda: player.text)
    assert notes[0].data == 'true from the start'
    player.send(signal.SIGTERM)
    assert player.wait() == 128 + signal.SIGTERM
    warnings = [line for line in player.lines if UNHEARD in line]
    assert len(warnings) == 1 and '/unheard is left out' in warnings[0]


# --- back-pressure ---


def test_never_more_than_n_frames_ahead_of_the_answers(graph: Graph, bag: Path) -> None:
    node = Answering(graph)
    player = graph.play(str(bag), '--rate', 'max', '--wait-for', '--max-ahead', '3')
    for answered in range(9):
        graph.spin_until(lambda: node.num_ahead == 3, explain=lambda: player.text)
        graph.spin_for(0.1)
        assert node.num_colors == answered + 3
        node.answer()
    graph.spin_until(lambda: node.num_colors == 12)
    assert player.is_running  # the last frames are waited for too
    node.answer(3)
    finish(graph, player)
    assert node.received[RGB] == recorded(bag, RGB)


def test_a_frame_that_nobody_answers_is_named(graph: Graph, bag: Path) -> None:
    node = Answering(graph)
    player = graph.play(str(bag), '--rate', 'max', '--wait-for', '--max-ahead', '4', '--wait-timeout', '5')
    graph.spin_until(lambda: node.num_ahead == 4, explain=lambda: player.text)
    node.answer(2)
    graph.spin_until(lambda: not player.is_running)
    assert player.wait() == 1
    # Two were answered, so four more than that were handed out.
    missing = 'first frame not answered: 1.066666666 (image 3)'
    assert player.says('error: no answer on /splatam/pose for', '6 colour images', missing)


def test_any_topic_with_a_header_can_answer(graph: Graph, bag: Path) -> None:
    received = subscribe(graph)
    publisher = graph.publisher(PathMessage, '/other/path')
    player = graph.play(str(bag), '--rate', 'max', '--wait-for', '/other/path', '--max-ahead', '1')

    def answer() -> bool:
        for data in received[RGB]:
            publisher.publish(PathMessage(header=pose(stamp_ns(data)).header))
        return not player.is_running

    graph.spin_until(answer, explain=lambda: player.text)
    assert player.wait() == 0, player.text


def test_colour_without_depth_is_no_frame_to_wait_for(graph: Graph, bag: Path, tmp_path: Path) -> None:
    depths = recorded(bag, DEPTH)
    missing = {stamp_ns(data) for data in [*depths[4:8], depths[-1]]}
    copy = tmp_path / 'gaps'
    with Reader(bag) as reader, Writer(copy, version=9) as writer:
        store = get_typestore(Stores.ROS2_JAZZY)
        by_topic = {c.topic: writer.add_connection(c.topic, c.msgtype, typestore=store) for c in reader.connections}
        for connection, time_ns, data in reader.messages():
            if connection.topic != DEPTH or stamp_ns(data) not in missing:
                writer.write(by_topic[connection.topic], time_ns, data)
    received = subscribe(graph)
    publisher = graph.publisher(PoseStamped, '/splatam/pose')
    player = graph.play(str(copy), '--rate', 'max', '--wait-for', '--max-ahead', '2')

    def answer_depths() -> bool:
        """Like a node that answers only the frames it could pair."""
        for data in received[DEPTH]:
            publisher.publish(pose(stamp_ns(data)))
        return not player.is_running

    graph.spin_until(answer_depths, explain=lambda: player.text)
    assert player.wait() == 0, player.text
    assert len(received[RGB]) == 12 and len(received[DEPTH]) == 7
    assert player.says('5 of those have no depth image')


def test_a_listener_that_leaves_is_reported_with_the_frame_it_missed(graph: Graph, bag: Path) -> None:
    node = Answering(graph)
    player = graph.play(str(bag), '--wait-for')
    graph.spin_until(lambda: node.num_colors == 2, explain=lambda: player.text)
    node.answer()
    graph.spin_until(lambda: node.num_colors == 3, explain=lambda: player.text)
    for subscription in list(graph.node.subscriptions):
        graph.node.destroy_subscription(subscription)
    graph.spin_until(lambda: not player.is_running)
    assert player.wait() == 1
    assert player.says(f'{RGB} left in mid-playback', 'first frame not answered: 1.033333333 (image 2)')


def test_a_stalled_subscriber_holds_the_player_up_even_without_wait_for(graph: Graph, bag: Path) -> None:
    listener = graph.start('-c', LISTENER, RGB, DEPTH, INFO)
    player = graph.play(str(bag), '--rate', '0.2')
    listener.wait_says('3 messages')
    listener.send(signal.SIGSTOP)
    player.wait_says('no answer from its subscribers', 'still waiting')
    listener.send(signal.SIGCONT)
    assert player.wait() == 0, player.text
    listener.wait_says('36 messages')


LISTENER = """
import sys
import rclpy
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Image
count = 0
def receive(message):
    global count
    count += 1
    print(count, 'messages')
rclpy.init()
node = rclpy.create_node('listener')
for topic in sys.argv[1:]:
    node.create_subscription(CameraInfo if 'info' in topic else Image, topic, receive, QoSProfile(depth=100))
rclpy.spin(node)
"""


def test_space_pauses_and_goes_on(graph: Graph, bag: Path) -> None:
    received = subscribe(graph)
    terminal, stdin = pty.openpty()
    try:
        player = graph.play(str(bag), '--rate', '0.1', stdin=stdin)
        graph.spin_until(lambda: len(received[RGB]) >= 2, explain=lambda: player.text)
        os.write(terminal, b' ')
        graph.spin_until(lambda: player.says('paused'), explain=lambda: player.text)
        paused_at = graph.settled(lambda: len(received[RGB]))
        graph.spin_for(3 / 30 / 0.1)  # the time of three frames
        assert len(received[RGB]) == paused_at < 12
        os.write(terminal, b' ')
        finish(graph, player)
    finally:
        os.close(terminal)
        os.close(stdin)
    assert received[RGB] == recorded(bag, RGB)


# --- what cannot be played ---


def complaint(player: Process, timeout_s: float = TIMEOUT_S) -> str:
    """Returns the error line of a player that could not start."""
    assert player.wait(timeout_s) == 2, player.text
    errors = [line for line in player.lines if 'error:' in line]
    assert len(errors) == 1 and 'Traceback' not in player.text, player.text
    return errors[0]


def assert_complaints(players: Sequence[Process], expected: Sequence[str]) -> None:
    """Check the errors of players that were started together, because starting takes longest."""
    for player, message in zip(players, expected, strict=True):
        assert message in complaint(player, len(players) * TIMEOUT_S)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:5000])  # no message is whole


def damaged_database(bag: Path, path: Path) -> None:
    shutil.copytree(bag, path)
    truncate(next(path.glob('*.db3')))


def no_database(bag: Path, path: Path) -> None:
    path.mkdir()
    (path / 'metadata.yaml').write_text('rosbag2_bagfile_information: {version: 9}')


def damaged_mcap(bag: Path, path: Path) -> None:
    with Reader(bag) as reader, Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        store = get_typestore(Stores.ROS2_JAZZY)
        for connection in reader.connections:
            added = writer.add_connection(connection.topic, connection.msgtype, typestore=store)
            for _, time_ns, data in reader.messages([connection]):
                writer.write(added, time_ns, data)
    truncate(next(path.glob('*.mcap')))


def empty_bag(bag: Path, path: Path) -> None:
    with Writer(path, version=9) as writer:
        writer.add_connection('/imu', 'sensor_msgs/msg/Imu', typestore=get_typestore(Stores.ROS2_JAZZY))


def test_unusable_recordings_are_one_line(graph: Graph, bag: Path, tmp_path: Path) -> None:
    paths = []
    for make in (damaged_database, no_database, damaged_mcap, empty_bag):
        paths.append(tmp_path / make.__name__)
        make(bag, paths[-1])
    assert_complaints([graph.play(str(path), '--no-wait-for-subscribers') for path in paths], list(map(str, paths)))


UNUSABLE_ARGUMENTS = {
    '/nowhere/bag': '/nowhere/bag',
    '/nowhere/some.bag': '/nowhere/some.bag',
    'BAG --topics /rgb/imag': '/rgb/imag is not in',
    'BAG --start-offset 5': 'lasts 0.4 s',
    'BAG --rate -1': 'expected a number above 0',
    'BAG --remap /a': 'expected /recorded:=/published',
    'BAG --discovery-timeout 0.5': 'nobody subscribes to /depth/image or /rgb/image',
    'BAG --no-wait-for-subscribers --wait-for --discovery-timeout 0.5': 'nobody publishes /splatam/pose',
    'BAG --topics /ground_truth/pose --rate max': 'count colour images',
    'BAG --ros-args -r nonsense': 'ROS arguments',
}


def test_unusable_arguments_are_one_line(graph: Graph, bag: Path) -> None:
    commands = [[str(bag) if word == 'BAG' else word for word in line.split()] for line in UNUSABLE_ARGUMENTS]
    assert_complaints([graph.play(*words) for words in commands], list(UNUSABLE_ARGUMENTS.values()))


def test_an_answering_topic_without_header_is_refused(graph: Graph, bag: Path) -> None:
    subscribe(graph)
    graph.publisher(String, '/talk')
    player = graph.play(str(bag), '--wait-for', '/talk')
    graph.spin_until(lambda: not player.is_running)
    assert '/talk: its type std_msgs/msg/String has no header' in complaint(player)


def test_topics_wanted_on_the_graph_are_suggested(graph: Graph, bag: Path) -> None:
    graph.collect(Image, '/camera/color')
    player = graph.play(str(bag), '--discovery-timeout', '5')
    graph.spin_until(lambda: not player.is_running)
    assert '--remap to what is wanted here: /camera/color' in complaint(player)
