"""The switches of the standard player, one by one, with the player as a separate process."""

from __future__ import annotations

import os
import signal
import struct
import subprocess
import sys
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from graph import Graph
from processes import Process
from rclpy.qos import DurabilityPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message, serialize_message
from rosbags import rosbag1
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import Reader, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import String
from test_player import DEPTH, INFO, LATCHED, RGB, assert_complaints, clock_ns, complaint, finish, recorded, stamp_ns, subscribe

from splatam_core.resources import config_dir
from splatam_ros.player.main import _count, _positive, _rate, _seconds, make_parser

STEP_NS = 10**9 // 30
NO_TIME = QosTime(0, 0)
ALL_KEPT = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
BEST_EFFORT = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)


def stamps(messages: Sequence[bytes]) -> list[int]:
    return [stamp_ns(data) for data in messages]


def qos(
    reliability: QosReliability = QosReliability.RELIABLE,
    durability: QosDurability = QosDurability.VOLATILE,
    deadline: QosTime = NO_TIME,
    liveliness: QosLiveliness = QosLiveliness.AUTOMATIC,
) -> Qos:
    return Qos(QosHistory.KEEP_LAST, 5, reliability, durability, deadline, NO_TIME, liveliness, NO_TIME, False)


def write_texts(path: Path, topics: dict[str, list[Qos]], count: int = 1, step_ns: int = STEP_NS) -> None:
    """Texts '0', '1', ... on every topic, from 1 s on."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(path, version=9) as writer:
        for topic, profiles in topics.items():
            added = writer.add_connection(topic, 'std_msgs/msg/String', typestore=store, offered_qos_profiles=profiles)
            for i in range(count):
                writer.write(added, 10**9 + i * step_ns, serialize_message(String(data=str(i))))


# --- time ---


@pytest.fixture(scope='module')
def camera_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seconds of a 640x480 camera at 30 Hz: 1.5 MB a frame."""
    path = tmp_path_factory.mktemp('camera') / 'vga'
    store = get_typestore(Stores.ROS2_JAZZY)
    rng = np.random.default_rng(0)
    images = {}
    for topic, encoding, size in ((RGB, 'rgb8', 3), (DEPTH, '16UC1', 2)):
        pixels = rng.integers(0, 255, 640 * 480 * size, np.uint8).tobytes()
        message = Image(width=640, height=480, encoding=encoding, step=640 * size, data=pixels)
        images[topic] = bytearray(serialize_message(message))
    with Writer(path, version=9) as writer:
        added = {topic: writer.add_connection(topic, 'sensor_msgs/msg/Image', typestore=store) for topic in images}
        for i in range(60):
            time_ns = 10**9 + i * STEP_NS
            for topic, data in images.items():
                struct.pack_into('<iI', data, 4, *divmod(time_ns, 10**9))
                writer.write(added[topic], time_ns, bytes(data))
    return path


def drift_ms(sent_ns: list[int], due_ns: list[int], parts: int) -> float:
    """How much the smallest lateness differs between parts of a playback: a busy machine delays single messages."""
    late_ns = np.subtract(sent_ns, due_ns)
    return np.ptp([part.min() for part in np.array_split(late_ns, parts)]) / 1e6


def succeeds_once(attempt: Callable[[], bool]) -> bool:
    """Returns True if one of some playbacks keeps time: a busy machine puts the player aside for long in any of them."""
    return any(attempt() for _ in range(8))


def test_rate_one_keeps_time_and_loses_nothing(graph: Graph, camera_bag: Path) -> None:
    expected = [10**9 + i * STEP_NS for i in range(60)]
    sent_ns: dict[str, list[int]] = {RGB: [], DEPTH: []}
    received: dict[str, list[int]] = {RGB: [], DEPTH: []}

    def listen(topic: str) -> None:
        def receive(data: bytes, info: dict[str, int]) -> None:
            sent_ns[topic].append(info['source_timestamp'])  # when the player published it, by the wall clock
            received[topic].append(stamp_ns(data))

        graph.node.create_subscription(Image, topic, receive, ALL_KEPT, raw=True)

    for topic in received:
        listen(topic)

    def keeps_time() -> bool:
        for times_ns in (*sent_ns.values(), *received.values()):
            times_ns.clear()
        finish(graph, player := graph.play(str(camera_bag), '--rate', '1'))
        assert received == {RGB: expected, DEPTH: expected}
        offsets_ms = np.subtract(list(sent_ns.values()), expected) / 1e6
        measured_ms = np.percentile(offsets_ms - offsets_ms.min(), 95)
        late_ms = float(player.text.split('95 % of all at most ')[1].split()[0])
        assert late_ms > 0
        agrees = late_ms == pytest.approx(measured_ms, abs=20)  # as its subscriber measures it
        return agrees and all(drift_ms(published_ns, expected, parts=4) < 20 for published_ns in sent_ns.values())

    assert succeeds_once(keeps_time)


@pytest.mark.parametrize('rate', ['0.5', '2'])
def test_the_rate_scales_time(graph: Graph, bag: Path, rate: str) -> None:
    sent_ns: list[int] = []
    graph.node.create_subscription(Image, RGB, lambda data, info: sent_ns.append(info['source_timestamp']), ALL_KEPT, raw=True)
    due_ns = [round(time_ns / float(rate)) for time_ns in stamps(recorded(bag, RGB))]

    def keeps_time() -> bool:
        sent_ns.clear()
        finish(graph, graph.play(str(bag), '--topics', RGB, '--rate', rate))
        return drift_ms(sent_ns, due_ns, parts=2) < 50

    assert succeeds_once(keeps_time)


@pytest.mark.parametrize(
    ('arguments', 'frames'),
    [
        # Frames are 1/30 s apart from 1 s on.
        (['--playback-until-sec', '1.11'], range(0, 4)),
        (['--playback-until-nsec', '1110000000'], range(0, 4)),
        (['--start-offset', '0.09', '--playback-until-sec', '1.21'], range(3, 7)),
        (['--playback-duration', '0.11'], range(0, 4)),
    ],
)
def test_playback_ends_where_it_should(graph: Graph, bag: Path, arguments: list[str], frames: range) -> None:
    received = subscribe(graph)
    finish(graph, graph.play(str(bag), '--rate', '10', *arguments))
    assert received[RGB] == recorded(bag, RGB)[frames.start : frames.stop]


def test_a_delay_comes_before_each_loop(graph: Graph, tmp_path: Path) -> None:
    write_texts(tmp_path / 'texts', {'/text': []}, count=2)
    sent: list[tuple[str, int]] = []
    graph.node.create_subscription(String, '/text', lambda text, info: sent.append((text.data, info['source_timestamp'])), ALL_KEPT)
    player = graph.play(str(tmp_path / 'texts'), '--delay', '1', '--loop')
    graph.spin_until(lambda: len(sent) >= 6, explain=lambda: player.text)  # it may lack the first, discovered late
    player.send(signal.SIGINT)
    before_s: dict[str, list[float]] = {'0': [], '1': []}
    for (_, earlier_ns), (text, later_ns) in pairwise(sent):
        before_s[text].append((later_ns - earlier_ns) / 1e9)
    assert min(before_s['0']) >= 0.99  # a delay is never shorter
    assert min(before_s['1']) < 0.5  # 0.03 s between the two messages, on a free core


# --- topics ---


@pytest.mark.parametrize(
    ('arguments', 'played'),
    [
        (['--regex', '/a/'], {'/a/x', '/a/y'}),
        (['--regex', '^/b', '--topics', '/a/x'], {'/a/x', '/b/x'}),
        (['--exclude-regex', 'x$'], {'/a/y'}),
        (['-e', '/a/', '-x', 'y'], {'/a/x'}),
        (['--regex', '/a/', '--exclude-topics', '/a/x'], {'/a/y'}),
    ],
)
def test_topics_are_chosen_by_pattern(graph: Graph, tmp_path: Path, arguments: list[str], played: set[str]) -> None:
    topics = ['/a/x', '/a/y', '/b/x']
    write_texts(tmp_path / 'texts', {topic: [qos(durability=QosDurability.TRANSIENT_LOCAL)] for topic in topics})
    received = {topic: graph.collect(String, topic, LATCHED) for topic in topics}
    player = graph.play(str(tmp_path / 'texts'), '--loop', '--delay', '0.2', *arguments)
    graph.spin_until(lambda: all(received[topic] for topic in played), explain=lambda: player.text)
    assert {topic for topic in topics if graph.node.count_publishers(topic)} == played


def test_static_transforms_are_latched_whatever_was_recorded(graph: Graph, tmp_path: Path) -> None:
    """Recorders without QoS record none, but listeners expect earlier transforms."""
    write_texts(tmp_path / 'texts', {'/tf_static': [], '/text': []}, count=40)
    player = graph.play(str(tmp_path / 'texts'), '--start-offset', '1', '--rate', '0.01')
    transforms = graph.collect(String, '/tf_static', QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    graph.spin_until(lambda: len(transforms) >= 30, explain=lambda: player.text)
    assert [text.data for text in transforms[:30]] == [str(i) for i in range(30)]  # those of the second left out


# --- /clock ---


def test_the_clock_follows_chosen_topics(graph: Graph, bag: Path) -> None:
    subscribe(graph)
    clock = graph.collect(Clock, '/clock')
    finish(graph, graph.play(str(bag), '--rate', '4', '--clock-topics', DEPTH))
    assert clock_ns(clock) == stamps(recorded(bag, DEPTH))


def test_the_clock_follows_all_topics(graph: Graph, bag: Path) -> None:
    received = subscribe(graph)
    clock = graph.collect(Clock, '/clock')
    finish(graph, graph.play(str(bag), '--rate', '4', '--clock-topics-all', '--topics', RGB, DEPTH))
    times_ns = clock_ns(clock)
    assert len(times_ns) == len(received[RGB]) + len(received[DEPTH]) == 24
    assert times_ns == sorted([*stamps(received[RGB]), *stamps(received[DEPTH])])


def test_a_periodic_clock_and_one_before_messages_never_run_backwards(graph: Graph, bag: Path) -> None:
    subscribe(graph)
    clock = graph.collect(Clock, '/clock')
    finish(graph, graph.play(str(bag), '--clock', '200', '--clock-topics-all'))
    assert len(clock) > 48
    assert clock_ns(clock) == sorted(clock_ns(clock))


# --- QoS ---


def offered(graph: Graph, topic: str, player: Process) -> QoSProfile:
    graph.spin_until(lambda: graph.node.count_publishers(topic), explain=lambda: player.text)
    return graph.node.get_publishers_info_by_topic(topic)[0].qos_profile


def test_topics_are_offered_as_recorded_where_their_publishers_agreed(graph: Graph, tmp_path: Path) -> None:
    best_effort = qos(QosReliability.BEST_EFFORT, deadline=QosTime(2, 5))
    topics = {
        '/best_effort': [best_effort, best_effort],
        '/mixed': [best_effort, qos(durability=QosDurability.TRANSIENT_LOCAL)],
        '/latched': [qos(durability=QosDurability.TRANSIENT_LOCAL)],
        '/manual': [qos(liveliness=QosLiveliness.MANUAL_BY_TOPIC)],
        '/unrecorded': [],
    }
    write_texts(tmp_path / 'texts', topics)
    player = graph.play(str(tmp_path / 'texts'), '--start-paused')
    profiles = {topic: offered(graph, topic, player) for topic in topics}
    assert {topic: profile.reliability for topic, profile in profiles.items()} == {
        **dict.fromkeys(topics, ReliabilityPolicy.RELIABLE), '/best_effort': ReliabilityPolicy.BEST_EFFORT,
    }  # fmt: skip
    assert {topic: profile.durability for topic, profile in profiles.items()} == {
        **dict.fromkeys(topics, DurabilityPolicy.VOLATILE), '/latched': DurabilityPolicy.TRANSIENT_LOCAL,
    }  # fmt: skip
    assert profiles['/best_effort'].deadline.nanoseconds == 2_000_000_005
    assert profiles['/manual'].liveliness == LivelinessPolicy.MANUAL_BY_TOPIC


def test_best_effort_is_offered_reliably_where_nothing_may_be_lost(graph: Graph, bag: Path, tmp_path: Path) -> None:
    copy = tmp_path / 'sensor'
    profile = qos(QosReliability.BEST_EFFORT)
    with Reader(bag) as reader, Writer(copy, version=9) as writer:
        store = get_typestore(Stores.ROS2_JAZZY)
        by_topic = {
            c.topic: writer.add_connection(c.topic, c.msgtype, typestore=store, offered_qos_profiles=[profile])
            for c in reader.connections
        }
        for connection, time_ns, data in reader.messages():
            writer.write(by_topic[connection.topic], time_ns, data)
    received = subscribe(graph)  # reliable: it would hear nothing of best-effort publishers
    finish(graph, graph.play(str(copy), '--rate', 'max'))
    assert received[RGB] == recorded(bag, RGB)

    lenient = graph.collect(Image, DEPTH, BEST_EFFORT, raw=True)
    player = graph.play(str(copy), '--topics', DEPTH)
    assert offered(graph, DEPTH, player).reliability == ReliabilityPolicy.BEST_EFFORT
    finish(graph, player)
    assert lenient == recorded(bag, DEPTH)


def test_a_file_overrides_the_qos(graph: Graph, tmp_path: Path) -> None:
    write_texts(tmp_path / 'texts', {'/a': [qos(QosReliability.BEST_EFFORT)], '/b': []})
    file = tmp_path / 'qos.yaml'
    file.write_text(
        '/a: {durability: transient_local, reliability: reliable, history: keep_last, depth: 7}\n'
        '/b: {lifespan: {sec: 3, nsec: 0}, liveliness: manual_by_topic, reliability: best_effort}\n'
    )
    player = graph.play(str(tmp_path / 'texts'), '--start-paused', '--qos-profile-overrides-path', str(file))
    a, b = offered(graph, '/a', player), offered(graph, '/b', player)
    assert (a.durability, a.reliability) == (DurabilityPolicy.TRANSIENT_LOCAL, ReliabilityPolicy.RELIABLE)
    assert (b.lifespan.nanoseconds, b.reliability) == (3 * 10**9, ReliabilityPolicy.BEST_EFFORT)
    assert b.liveliness == LivelinessPolicy.MANUAL_BY_TOPIC


UNUSABLE_QOS = {
    '[]': 'expected topics with their policies',
    '/a: {reliability: best}': "/a: reliability = 'best': expected one of system_default, reliable, best_effort",
    '/a: {depth: many}': "/a: depth = 'many': expected a whole number",
    '/a: {deadline: 3}': '/a: deadline = 3: expected {sec: a whole number',
    '/a: {reliabilty: reliable}': '/a: reliabilty is no QoS policy: expected one of history, reliability',
    '/c: {depth: 3}': '/c is not in',
    '{': 'cannot be read',
}


def test_a_qos_file_that_cannot_be_used_is_one_line(graph: Graph, tmp_path: Path) -> None:
    write_texts(tmp_path / 'texts', {'/a': []})
    players = []
    for number, text in enumerate(UNUSABLE_QOS):
        file = tmp_path / f'{number}.yaml'
        file.write_text(text)
        players.append(graph.play(str(tmp_path / 'texts'), '--qos-profile-overrides-path', str(file)))
    assert_complaints(players, list(UNUSABLE_QOS.values()))


# --- reading and losing nothing ---


@pytest.mark.parametrize('size', ['1', '1000'])
def test_any_read_ahead_plays_everything(graph: Graph, bag: Path, size: str) -> None:
    received = subscribe(graph)
    finish(graph, graph.play(str(bag), '--rate', 'max', '--read-ahead-queue-size', size))
    assert received[RGB] == recorded(bag, RGB)


def test_the_end_waits_for_acknowledgements_and_says_who_keeps_it(graph: Graph, bag: Path) -> None:
    graph.collect(Image, RGB)  # for images the player waits until both are here
    listener = graph.start('-c', LISTENER)
    player = graph.play(str(bag), '--topics', RGB, INFO, '--rate', '0.1', '--wait-for-all-acked', '700')
    graph.spin_until(lambda: listener.says('3 messages'), explain=lambda: player.text + listener.text)
    listener.send(signal.SIGSTOP)
    graph.spin_until(lambda: not player.is_running, explain=lambda: player.text)
    assert player.wait() == 1
    assert player.says(f'a subscriber of {INFO} has not taken all messages within 0.7 s')


LISTENER = """
import rclpy
from sensor_msgs.msg import CameraInfo
count = 0
def receive(message):
    global count
    count += 1
    print(count, 'messages')
rclpy.init()
node = rclpy.create_node('listener')
node.create_subscription(CameraInfo, '/rgb/camera_info', receive, 100)
rclpy.spin(node)
"""


def test_the_node_gets_every_frame_of_a_camera_however_fast_they_are_read(graph: Graph, camera_bag: Path, tmp_path: Path) -> None:
    info = graph.publisher(CameraInfo, INFO, LATCHED)
    message = CameraInfo(width=640, height=480, distortion_model='plumb_bob')
    message.k[0] = message.k[4] = message.p[0] = message.p[5] = 500.0
    message.k[2], message.k[5], message.k[8] = 319.5, 239.5, 1.0
    message.p[2], message.p[6], message.p[10] = 319.5, 239.5, 1.0
    info.publish(message)
    out = tmp_path / 'out'
    node = graph.run_node(
        '-p', f'preset:={config_dir().parent}/benchmarks/null.yaml', save_path=out, queue_policy='all',
        exit_on_publisher_end=True,
    )  # fmt: skip
    node.wait_says('waiting for')
    info_sent = graph.node.create_timer(0.2, lambda: info.publish(message))
    player = graph.play(str(camera_bag), '--rate', 'max', '--wait-for')
    graph.spin_until(lambda: not (player.is_running or node.is_running), explain=lambda: player.text + node.text)
    info_sent.destroy()
    assert (player.wait(), node.wait()) == (0, 0), player.text + node.text
    poses = [line for line in (out / 'trajectory.txt').read_text().splitlines() if not line.startswith('#')]
    assert [round(float(line.split()[0]) * 1e9) for line in poses] == pytest.approx(
        [10**9 + i * STEP_NS for i in range(60)],
        abs=1000,  # what a float keeps of the stamp
    )


# --- ROS 1 ---


def write_ros1(bag: Path, path: Path, *, is_compressed: bool = True) -> None:
    """The same recording as ROS 1 would have written it, plus a type that is not installed."""
    ros1, ros2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_JAZZY)
    writer = rosbag1.Writer(path)
    if is_compressed:
        writer.set_compression(rosbag1.Writer.CompressionFormat.LZ4)
    with Reader(bag) as reader, writer:
        added = {c.topic: writer.add_connection(c.topic, c.msgtype, typestore=ros1) for c in reader.connections}
        note = writer.add_connection('/note', 'std_msgs/msg/String', typestore=ros1, latching=1)
        ros1.register(get_types_from_msg('int32 value', 'nowhere_msgs/msg/Unheard'))
        unheard = writer.add_connection('/unheard', 'nowhere_msgs/msg/Unheard', typestore=ros1)
        writer.write(unheard, 10**9, b'\0\0\0\0')
        text = ros1.types['std_msgs/msg/String']('true from the start')
        writer.write(note, 10**9, ros1.serialize_ros1(text, 'std_msgs/msg/String'))
        for connection, time_ns, data in reader.messages():
            writer.write(added[connection.topic], time_ns, ros2.cdr_to_ros1(data, connection.msgtype))


def test_a_ros1_bag_plays_like_the_rosbag2_it_could_have_been(graph: Graph, bag: Path, tmp_path: Path) -> None:
    write_ros1(bag, tmp_path / 'old.bag')
    received = subscribe(graph)
    notes = graph.collect(String, '/note', LATCHED)
    player = graph.play(str(tmp_path / 'old.bag'), '--rate', 'max', '--start-offset', '0.09')
    finish(graph, player)
    # Of the camera infos, the last one before the start is sent, too.
    for topic, message_class, first in ((RGB, Image, 3), (DEPTH, Image, 3), (INFO, CameraInfo, 2)):
        as_messages = [deserialize_message(data, message_class) for data in received[topic]]
        assert as_messages == [deserialize_message(data, message_class) for data in recorded(bag, topic)[first:]], topic
    assert [note.data for note in notes] == ['true from the start']  # latched, from before the start
    assert player.says('/unheard is left out', 'nowhere_msgs/msg/Unheard is not installed')


def test_ros1_messages_with_other_fields_are_carried_over(graph: Graph, tmp_path: Path) -> None:
    """ROS 1 types with other fields: fields of the same name and type are kept, others are omitted."""
    ros1 = get_typestore(Stores.EMPTY)
    ros1.register(get_types_from_msg('uint32 obsolete\nstring data', 'std_msgs/msg/String'))
    with rosbag1.Writer(tmp_path / 'old.bag') as writer:
        added = writer.add_connection('/note', 'std_msgs/msg/String', typestore=ros1, latching=1)
        message = ros1.types['std_msgs/msg/String'](7, 'kept')
        writer.write(added, 10**9, ros1.serialize_ros1(message, 'std_msgs/msg/String'))
    notes = graph.collect(String, '/note', LATCHED)
    player = graph.play(str(tmp_path / 'old.bag'), '--loop', '--delay', '0.5')
    graph.spin_until(lambda: notes, explain=lambda: player.text)
    assert notes[0].data == 'kept'


def test_a_broken_ros1_bag_is_one_line(graph: Graph, bag: Path, tmp_path: Path) -> None:
    path = tmp_path / 'old.bag'
    write_ros1(bag, path)
    path.write_bytes(path.read_bytes()[:5000])
    assert 'old.bag: cannot be read as a ROS 1 bag' in complaint(graph.play(str(path)))


def test_a_cut_ros1_bag_is_played_as_far_as_it_is_whole(graph: Graph, bag: Path, tmp_path: Path) -> None:
    path = tmp_path / 'old.bag'
    write_ros1(bag, path, is_compressed=False)  # it has one chunk
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    received = subscribe(graph)
    player = graph.play(str(path), '--rate', 'max')
    finish(graph, player)
    assert 0 < len(received[RGB]) < len(recorded(bag, RGB)) and player.says('old.bag is cut or damaged')


# --- what cannot be played ---


UNUSABLE_SWITCHES = {
    '--regex (': 'no regular expression',
    '--regex ^/nothing': 'no topic is left to play of',
    '--playback-until-sec 0.5': 'playback starts at 1.000000000 s',
    '--playback-until-sec soon': "'soon' is not a number of seconds",
    '--duration 1 --playback-until-sec 2': 'not allowed with argument',
    '--clock-topics /nothing': '/nothing is not in',
    '--read-ahead-queue-size 0': 'expected 1 or more',
    '--delay -1': 'expected 0 or more',
}


def test_messages_that_nobody_reads_cost_nothing_of_playing(graph: Graph, bag: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, '-m', 'splatam_ros.player.main', bag, '--no-wait-for-subscribers', '--rate', 'max']
    assert subprocess.run(command, stdout=writer, stderr=writer, timeout=60, check=False).returncode == 0
    os.close(writer)


@pytest.mark.parametrize('value', ['1e300', '-1e300', 'inf', 'nan', '1' + 30 * '0'])
def test_numbers_beyond_any_use_are_refused(value: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Each is multiplied or divided to nanoseconds, periods and rates, of which none may overflow."""
    numbers = [action for action in make_parser()._actions if action.type in (_seconds, _positive, _count, _rate)]
    assert len(numbers) >= 10
    for action in numbers:
        with pytest.raises(SystemExit):
            make_parser().parse_args(['BAG', f'{action.option_strings[-1]}={value}'])
        assert action.option_strings[-1] in capsys.readouterr().err


def test_switches_that_cannot_be_used_are_one_line(graph: Graph, bag: Path) -> None:
    players = [graph.play(str(bag), *line.split()) for line in UNUSABLE_SWITCHES]
    assert_complaints(players, list(UNUSABLE_SWITCHES.values()))
