"""Faults caused on the running node, and its reactions."""

from __future__ import annotations

import array
import itertools
import resource
import signal
import struct
import zlib
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from camera import SLAM, Camera, CompressedCamera, Live, position, run_node, still
from control import Control
from geometry_msgs.msg import PoseStamped
from graph import Graph, node_arguments
from processes import TIMEOUT_S, Process
from std_msgs.msg import Header

from msg_adapters import stamps
from splatam_core.datasets.synthetic import SyntheticSequence
from splatam_core.maps.ply import read_ply
from splatam_core.runs.record import read_run
from splatam_core.types import RgbdFrame

SECOND = 10**9
STILL_M = 0.04  # a pixel, at 64 pixels width and 2.5 m

PUBLISHER = """
import sys, time
from dataclasses import replace
from pathlib import Path
sys.path[:0] = ['test', 'test/ros']
from camera import Camera
from graph import Graph
from splatam_core.datasets.synthetic import SyntheticSequence
import os, rclpy
from rclpy.executors import SingleThreadedExecutor
class Here:
    '''The graph this process was started on.'''
    def __init__(self):
        rclpy.init()
        self.node = rclpy.create_node('camera')
    def publisher(self, message_class, topic, qos):
        return self.node.create_publisher(message_class, topic, qos)
frame = SyntheticSequence(seed=0, noise=False, frames=12, width=64)[0]
camera = Camera(Here())
while True:
    camera.send(replace(frame, stamp_ns=time.time_ns()))
    time.sleep(0.1)
"""


def start_publisher(graph: Graph) -> Process:
    """Start a camera as a separate process that sends the same view ten times a second."""
    return graph.start('-c', PUBLISHER)


def covered(frame: RgbdFrame) -> RgbdFrame:
    """Returns what a covered camera sees: black, and no depth."""
    return replace(frame, rgb=np.zeros_like(frame.rgb), depth_m=np.zeros_like(frame.depth_m))


def test_a_publisher_that_is_killed_and_started_again(graph: Graph) -> None:
    poses = graph.collect(PoseStamped, '/splatam/pose')
    node = run_node(graph, no_data_timeout=1.0)
    first = start_publisher(graph)
    graph.spin_until(lambda: len(poses) >= 3, explain=lambda: node.text + first.text)
    first.send(signal.SIGKILL)
    # The graph notices a killed process only after DDS's lease of some seconds; missing images are noticed earlier.
    node.wait_says('no frame for 1 s: nothing was received on /rgb/image and /depth/image')
    before = len(poses)
    second = start_publisher(graph)
    graph.spin_until(lambda: len(poses) >= before + 3, explain=lambda: node.text + second.text)
    assert np.linalg.norm(position(poses[-1])) < STILL_M  # the map is the same, and so is the pose
    assert node.is_running and not node.says('map reset')


def test_a_covered_camera(graph: Graph, frames: SyntheticSequence) -> None:
    """For 3 s: no pose, the map does not change, tracking resumes with the view. With lost_reset_after: a new map."""
    out = graph.folder / 'run'
    live = Live(graph, save_path=out, queue_policy='all', slam__tracking__min_inlier_fraction=0.5)
    control = Control(graph)
    assert all(live.show(still(frames, number)) for number in range(3))
    control.succeed('save_map')
    before = (out / 'map.ply').read_bytes()
    assert not any(live.show(covered(still(frames, number))) for number in range(3, 33, 3))
    assert live.node.says('lost at')
    control.succeed('save_map')
    assert (out / 'map.ply').read_bytes() == before
    pose = live.show(still(frames, 33))
    assert pose is not None and np.linalg.norm(position(pose)) < STILL_M
    assert not live.node.says('map reset')

    control.change(lost_reset_after=0.5)
    assert not any(live.show(covered(still(frames, number))) for number in range(40, 47))
    live.wait_says('map reset', 'lost for 0.5 s')
    pose = live.show(still(frames, 50))
    assert pose is not None and not position(pose).any()
    assert len(read_run(out / 'previous').lost_ns) == 10 + 6  # the frames after the reset are of the new run


def test_depth_that_stops_and_comes_back(graph: Graph, frames: SyntheticSequence) -> None:
    live = Live(graph, no_data_timeout=1.0, sync__mode='exact', sync__queue_size=3)
    assert live.show(still(frames, 0))
    sent = iter(range(1, 10**6))

    def only_colour() -> bool:
        live.camera.send(still(frames, next(sent)), only=('info', 'rgb'))
        graph.spin_for(0.05)
        return live.node.says('no frame for 1 s: nothing was received on /depth/image for', 'though there is a publisher')

    live.wait(only_colour)
    assert live.node.says('dropped: colour without depth', 'the newest depth is -')
    assert live.show(still(frames, next(sent)))


def test_camera_info_that_is_late(graph: Graph, frames: SyntheticSequence) -> None:
    live = Live(graph, no_data_timeout=1.0, sync__queue_size=3, queue_policy='all')
    for number in range(6):
        live.camera.send(still(frames, number), only=('rgb', 'depth'))
        graph.spin_for(0.2)  # in a burst, three of one stream could push each other out before the other stream comes
    live.wait_says('no frame for 1 s: /rgb/camera_info has a publisher, but no message was received')
    live.wait_says('dropped: paired, but no CameraInfo was received')
    graph.spin_for(9.0)  # 10 s in total
    assert not live.done
    live.camera.send(still(frames, 6), only=('info',))  # the frames in the queue have waited for it
    live.wait_done(still(frames, 5).stamp_ns)
    assert [stamps.to_ns(header.stamp) for header in live.done] == [still(frames, n).stamp_ns for n in (3, 4, 5)]
    assert live.show(still(frames, 7))


def test_one_message_in_ten_is_lost(graph: Graph, frames: SyntheticSequence) -> None:
    """Every frame whose two images arrive gets a pose; the node warns about the others."""
    rng = np.random.default_rng(1)
    live = Live(graph, queue_policy='all', sync__mode='exact')
    live.show(still(frames, 0))
    expected = []
    for number in range(1, 61):
        arriving = [stream for stream in ('info', 'rgb', 'depth') if rng.random() >= 0.1]
        live.camera.send(still(frames, number), only=arriving)
        if {'rgb', 'depth'} <= set(arriving):
            expected.append(still(frames, number).stamp_ns)
            live.wait_done(expected[-1])  # in a burst, one stream could push its own out before the other stream comes
    assert 40 < len(expected) < 60  # some were lost
    assert [stamps.to_ns(header.stamp) for header in live.done][1:] == expected
    live.wait_says('dropped: colour without depth')
    live.wait(lambda: len(live.poses) > len(expected))
    assert [stamps.message_stamp_ns(pose) for pose in live.poses][1:] == expected


def test_corrupted_compressed_frames(graph: Graph, frames: SyntheticSequence) -> None:
    """Bytes flipped or cut off: a warning or a wrong image, but never a crash; every frame is answered, good ones are tracked."""
    rng = np.random.default_rng(2)
    live = Live(
        graph, camera_class=CompressedCamera, queue_policy='all', slam__tracking__min_inlier_fraction=0.5,
        **CompressedCamera.PARAMETERS,
    )  # fmt: skip

    def flip(messages: dict[str, Any]) -> None:
        for name in ('rgb', 'depth'):
            for at in rng.integers(0, len(messages[name].data), 8):
                messages[name].data[at] ^= int(rng.integers(1, 256))

    def cut(messages: dict[str, Any]) -> None:
        for name in ('rgb', 'depth'):
            messages[name].data = messages[name].data[: int(rng.integers(0, len(messages[name].data)))]

    assert live.show(still(frames, 0))
    for number in range(1, 41):
        frame = still(frames, number)
        messages = live.camera.messages(frame, frame.stamp_ns)
        (flip if number % 2 else cut)(messages)
        live.camera.publish(messages)
    pose = live.show(still(frames, 41))
    assert pose is not None and np.linalg.norm(position(pose)) < STILL_M
    assert live.node.says('colour skipped', 'truncated or damaged') and 'Traceback' not in live.node.text
    assert len(live.done) == 42


def test_a_stamp_that_jumps_and_returns(graph: Graph, frames: SyntheticSequence) -> None:
    """One message far in the future, and one in the past: the frames after them are tracked."""
    live = Live(graph, on_time_jump='continue', queue_policy='all')
    assert live.show(still(frames, 0))
    for wrong_ns in (10**6 * SECOND, SECOND // 2):
        live.camera.send(replace(frames[0], stamp_ns=wrong_ns))
        numbers = iter(range(1, 100))
        graph.spin_for(0.2)
        live.wait(lambda: _shows_pose(live, still(frames, next(numbers))))  # noqa: B023
    assert np.linalg.norm(position(live.poses[-1])) < STILL_M


def test_one_frame_stamped_a_day_ahead_costs_itself(graph: Graph, frames: SyntheticSequence) -> None:
    """Also if only one of its images is; neither a day behind costs the map."""
    live = Live(graph, queue_policy='all')
    numbers = itertools.count()
    for delta_ns, streams in ((86400 * SECOND, ('rgb', 'depth')), (86400 * SECOND, ('rgb',)), (-86400 * SECOND, ('rgb', 'depth'))):
        assert live.show(still(frames, next(numbers)))
        assert live.show(still(frames, next(numbers)))
        wrong = replace(frames[6], stamp_ns=still(frames, next(numbers)).stamp_ns + delta_ns)
        live.camera.send(wrong, only=('info', *streams))
        assert live.show(still(frames, next(numbers)))
        assert live.pose_of(wrong.stamp_ns) is None
    assert live.node.says('WARN', 'its stamp is +86400.100 s from the frames around it')
    assert not live.node.says('map reset') and not live.node.says('time jumped')


def claims(data: bytes, width: int, height: int) -> array.array[int]:
    """Returns a PNG whose header states another size."""
    header = b'IHDR' + struct.pack('>II', width, height) + data[24:29]
    return array.array('B', data[:12] + header + struct.pack('>I', zlib.crc32(header)) + data[33:])


def odd_frame(number: int, width: int, height: int) -> RgbdFrame:
    rgb = np.random.default_rng(number).integers(0, 255, (height, width, 3), np.uint8)
    camera: Any = SimpleNamespace(width=width, height=height, fx=50.0, fy=50.0, cx=width / 2, cy=height / 2)  # checks nothing
    return RgbdFrame(SECOND + number * 10**8, rgb, np.full((height, width), 2.0, np.float32), camera)


def test_no_message_ends_the_node(graph: Graph, frames: SyntheticSequence, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stamps that are no times, odd sizes, and sizes beyond what OpenCV can rectify: each costs itself."""
    live = Live(graph, queue_policy='all', slam__tracking__min_inlier_fraction=0.5, on_camera_change='refuse')
    first = odd_frame(0, 64, 1)
    live.camera.send(first)  # not even as the first frame
    graph.spin_for(0.5)
    assert live.show(still(frames, 1))
    for stream in ('rgb', 'depth', 'info'):
        messages = live.camera.messages(still(frames, 2), still(frames, 2).stamp_ns)
        messages[stream].header.stamp.sec, messages[stream].header.stamp.nanosec = 2147483647, 4294967295
        live.camera.publish(messages)
    live.wait_says('WARN', '/rgb/image: a message is skipped: stamp', '4294967295')
    assert live.show(still(frames, 3))
    monkeypatch.setattr('msg_adapters.pixels.check_size', lambda what, size: None)  # ours is never sent
    bent = {'info__distortion_model': 'plumb_bob', 'info__d': [-0.2, 0.05, 0.0, 0.0, 0.0]}
    live.camera.send(odd_frame(4, 40000, 2), **bent)
    live.wait_says('WARN', 'skipped', '40000x2')
    for number, size in enumerate(((64, 1), (1, 64), (1, 1), (3, 2), (64, 1)), start=5):
        live.camera.send(odd_frame(number, *size))
    pose = live.show(still(frames, 20))
    assert pose is not None and np.linalg.norm(position(pose)) < STILL_M
    assert 'Traceback' not in live.node.text and not live.node.says('map reset: the camera changed', 'run so far')


def test_images_that_claim_to_be_huge(graph: Graph, frames: SyntheticSequence) -> None:
    live = Live(graph, camera_class=CompressedCamera, queue_policy='all', **CompressedCamera.PARAMETERS)
    live.camera.color = 'png'
    assert live.show(still(frames, 0))
    for number, (stream, side) in enumerate((('rgb', 40000), ('depth', 40000), ('rgb', 20000)), start=1):
        messages = live.camera.messages(still(frames, number), still(frames, number).stamp_ns)
        data, before = bytes(messages[stream].data), 12 * (stream == 'depth')
        messages[stream].data = array.array('B', data[:before]) + claims(data[before:], side, side)
        live.camera.publish(messages)
    assert live.show(still(frames, 9))
    assert live.node.says('WARN', 'colour skipped') and live.node.says('WARN', 'depth skipped')
    assert 'Traceback' not in live.node.text


def _shows_pose(live: Live, frame: RgbdFrame) -> bool:
    live.camera.send(frame)
    return live.pose_of(frame.stamp_ns) is not None


# --- saving ---


def limit_file_size(node: Process, num_bytes: int) -> None:
    """Make writing beyond this size fail, as on a full disk."""
    resource.prlimit(node.pid, resource.RLIMIT_FSIZE, (num_bytes, resource.RLIM_INFINITY))


def test_a_disk_that_is_full(graph: Graph, frames: SyntheticSequence) -> None:
    """Saving fails with the reason, the old file stays complete, SLAM continues; with space again everything is saved.

    That a frame could not be written down is said too, but here the node's log is on the full disk as well.
    """
    out = graph.folder / 'run'
    live = Live(graph, save_path=out, queue_policy='all')
    control = Control(graph)
    assert live.show(still(frames, 0))
    control.succeed('save_map')
    before = (out / 'map.ply').read_bytes()
    assert live.show(still(frames, 1))
    limit_file_size(live.node, 50)  # not even a line of the trajectory
    why = control.fail('save_map')
    assert f'{out}: cannot be saved: File too large' in why and '\n' not in why
    assert all(live.show(still(frames, number)) for number in range(2, 6))
    assert len(read_run(out).trajectory) == 2
    assert (out / 'map.ply').read_bytes() == before and read_ply(out / 'map.ply').means.any()
    limit_file_size(live.node, resource.RLIM_INFINITY)
    assert live.show(still(frames, 6))
    assert '7 frames' in control.succeed('save_map')
    assert (out / 'map.ply').read_bytes() != before and not list(out.glob('.*'))
    assert len(read_run(out).trajectory) == 7  # including the frames that could not be written then
    live.node.send(signal.SIGINT)
    assert live.node.wait() == 0


def test_a_disk_that_is_full_at_the_first_frame(graph: Graph, frames: SyntheticSequence) -> None:
    """With space again nothing is missing, the camera included."""
    out = graph.folder / 'run'
    live = Live(graph, save_path=out, queue_policy='all')
    control = Control(graph)
    limit_file_size(live.node, 50)
    assert live.show(still(frames, 0)) and live.show(still(frames, 1))
    limit_file_size(live.node, resource.RLIM_INFINITY)
    assert live.show(still(frames, 2))
    assert '3 frames' in control.succeed('save_map')
    run = read_run(out)
    assert run.camera == frames[0].camera and len(run.trajectory) == len(run.frames) == 3


def test_a_disk_that_is_full_at_a_reset(graph: Graph, frames: SyntheticSequence) -> None:
    """The old map and the frames since wait in memory; with space again nothing is missing."""
    out = graph.folder / 'run'
    live = Live(graph, save_path=out, queue_policy='all')
    control = Control(graph)
    assert live.show(still(frames, 0)) and live.show(still(frames, 1))
    limit_file_size(live.node, 50)
    assert 'previous' not in control.succeed('reset')
    assert live.show(still(frames, 2)) and live.show(still(frames, 3)) and live.show(still(frames, 4))
    assert 'waits for room' in control.fail('save_map')
    limit_file_size(live.node, resource.RLIM_INFINITY)
    assert '3 frames' in control.succeed('save_map')
    before, now = read_run(out / 'previous'), read_run(out)
    assert len(before.frames) == 2 and len(now.frames) == len(now.trajectory) == 3 and now.camera == before.camera
    assert before.read_map().means.any() and now.read_map().means.any()


SLOW_DISK = """
import os, sys, time
from pathlib import Path
replace = os.replace
def slow(source, target):
    if Path(target).name == 'map.ply' and Path(target).exists():
        print('about to replace', target)
        time.sleep(60)
    replace(source, target)
os.replace = slow
from splatam_ros.node.main import main
sys.exit(main(sys.argv[1:]))
"""


def test_a_node_killed_while_it_saves(graph: Graph, frames: SyntheticSequence) -> None:
    """The old file stays complete, and the next run can use the folder."""
    out = graph.folder / 'run'
    camera, done = Camera(graph), graph.collect(Header, '/splatam/processed')
    node = graph.start('-c', SLOW_DISK, *node_arguments(preset='quick', save_path=out, **SLAM))
    camera.wait_matched()
    control = Control(graph)
    for count in (1, 2):
        camera.send(still(frames, count))
        graph.spin_until(lambda: len(done) == count, explain=lambda: node.text)  # noqa: B023
        if count == 1:
            control.succeed('save_map')
    before = (out / 'map.ply').read_bytes()
    node.send(signal.SIGTERM)  # which saves
    node.wait_says('about to replace')
    node.send(signal.SIGKILL)
    assert node.wait() == -signal.SIGKILL
    assert (out / 'map.ply').read_bytes() == before and read_ply(out / 'map.ply').means.any()
    assert len(read_run(out).trajectory) == 2
    assert [path.name for path in out.glob('.*')] == [f'.map.ply.{node.pid}']

    again = run_node(graph, save_path=out, overwrite=True)
    again.wait_says('waiting for')
    again.send(signal.SIGINT)
    assert again.wait() == 0 and not list(out.glob('.*'))


UNUSABLE = {
    'max_rate_hz:=-1.0': 'max_rate_hz = -1.0: expected a number at least 0 and at most 1000 (Hz)',
    'slam.depth.min_m:=-2.0': 'depth.min_m = -2.0: expected a number at least 0 (m)',
    'load_path:=/nowhere.ply': '/nowhere.ply: cannot be read',
    'load_path:=/dev/zero': '/dev/zero: cannot be read: it is no regular file',
    f'save_path:=/tmp/{"x" * 300}': 'cannot be used as a path: File name too long',
    'save_path:=~nosuchuser/x': "save_path = '~nosuchuser/x': cannot be used as a path",
    'save_root:=~nosuchuser/x': "save_root = '~nosuchuser/x': cannot be used as a path",
    'load_path:=~nosuchuser/x.ply ': 'cannot be used as a path',
    f'preset:=/{"x" * 300}.yaml': 'cannot be used as a path',
    'slam.keyframes.overlap_samples:=1000000000000000': 'overlap_samples = 1000000000000000: expected a whole number at least 1',
    'slam.mapping.iterations:=9000000000000000000': 'mapping.iterations = 9000000000000000000: expected',
    'finish_limit:=.inf': 'finish_limit = inf: expected a number',
    'width:=7': 'width = 7: expected 0',
    "load_pose:='1 2'": "expected 'x y z qx qy qz qw'",
}


def test_a_start_with_parameters_that_cannot_be_used(graph: Graph) -> None:
    nodes = [graph.run_node('-p', rule, load_path='/nowhere.ply') for rule in UNUSABLE]  # in parallel, because starting takes long
    for node, message in zip(nodes, UNUSABLE.values(), strict=True):
        assert node.wait(len(nodes) * TIMEOUT_S) == 2, node.text
        errors = [line for line in node.lines if 'error:' in line]
        assert len(errors) == 1 and message in errors[0] and 'Traceback' not in node.text, node.text
