"""The node as a separate process, over DDS."""

from __future__ import annotations

import itertools
import json
import re
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera import CAMERA_FRAME, LATCHED, MAKE, QUICK, SLAM, Camera, run_node, stamps_of, still
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from graph import FRAMES, Graph, node_arguments
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from processes import TIMEOUT_S, Process
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import Header

from msg_adapters import images, point_clouds, poses, stamps
from splatam_core.config import load_config
from splatam_core.datasets.convert import write_bag
from splatam_core.datasets.synthetic import SyntheticSequence
from splatam_core.maps.ply import read_ply
from splatam_core.runs.record import read_run
from splatam_core.slam import Slam
from splatam_core.types import RgbdFrame


def trajectory_lines(folder: Path) -> list[str]:
    path = folder / 'trajectory.txt'
    return path.read_text().splitlines() if path.exists() else []


def newest_stamp(messages: list[Any]) -> int | None:
    """Returns the newest stamp of messages that have a header or are headers."""
    header = getattr(messages[-1], 'header', messages[-1]) if messages else None
    return None if header is None else stamps.to_ns(header.stamp)


def offline(sequence: SyntheticSequence) -> tuple[Slam, list[np.ndarray]]:
    slam = Slam(load_config('quick', QUICK))
    return slam, [slam.process(frame).T_world_cam for frame in sequence]


# --- from images to outputs ---


def test_recording_in_poses_renders_cloud_and_folder_out(
    graph: Graph, bag: Path, frames: SyntheticSequence, tf_message: type
) -> None:
    out = graph.folder / 'run'
    node = run_node(
        graph, save_path=out, queue_policy='all', exit_on_publisher_end=True,
        publish_rate__path=0.0, publish_rate__cloud=0.0, max_cloud_points=500,
    )  # fmt: skip
    received = {
        topic: graph.collect(message_class, f'/splatam/{topic}', qos)
        for topic, message_class, qos in (
            ('pose', PoseStamped, 100), ('odometry', Odometry, 100), ('path', PathMessage, LATCHED),
            ('render/rgb', Image, 100), ('render/depth', Image, 100), ('render/silhouette', Image, 100),
            ('map/points', PointCloud2, LATCHED), ('processed', Header, 100),
        )
    }  # fmt: skip
    topics = [f'/splatam/{topic}' for topic in received]
    graph.spin_until(lambda: all(graph.node.count_publishers(topic) for topic in topics), explain=lambda: node.text)
    player = graph.play_in_step(str(bag))
    graph.spin_until(lambda: not node.is_running, explain=lambda: player.text + node.text)
    assert (player.wait(), node.wait()) == (0, 0), player.text + node.text
    assert 'WARN' not in node.text

    expected_ns = [frame.stamp_ns for frame in frames]
    graph.spin_until(lambda: all(newest_stamp(messages) == expected_ns[-1] for messages in received.values()))
    assert stamps_of(received['pose']) == stamps_of(received['odometry']) == expected_ns
    assert [stamps.to_ns(message.stamp) for message in received['processed']] == expected_ns
    for topic in ('path', 'render/rgb', 'render/depth', 'render/silhouette', 'map/points'):
        # Their subscriptions may be discovered after the first frames.
        assert set(stamps_of(received[topic])) <= set(expected_ns)

    # Equal to the same frames processed offline, bit for bit.
    slam, expected_poses = offline(frames)
    for message, T_world_cam in zip(received['pose'], expected_poses, strict=True):
        assert message == poses.pose_stamped(MAKE, T_world_cam, stamps.message_stamp_ns(message), 'map')
    odometry = received['odometry'][-1]
    assert (odometry.header.frame_id, odometry.child_frame_id) == ('map', CAMERA_FRAME)
    assert odometry.pose.pose == received['pose'][-1].pose
    assert [stamps.message_stamp_ns(pose) for pose in received['path'][-1].poses] == expected_ns
    check_map({topic: messages[-1] for topic, messages in received.items()}, slam, expected_poses[-1])
    check_folder(out, expected_ns, expected_poses)


def test_realtime_through_the_node_is_realtime_offline(graph: Graph, bag: Path, frames: SyntheticSequence) -> None:
    """Poses and map are equal bit for bit, including the final steps after the last frame, however long they take."""
    out = graph.folder / 'run'
    node = graph.run_node(
        preset='realtime', slam__threads=1, save_path=out, queue_policy='all', exit_on_publisher_end=True, finish_limit=0.1
    )
    player = graph.play(str(bag), '--rate', 'max', '--wait-for')
    assert (player.wait(), node.wait()) == (0, 0), player.text + node.text
    slam = Slam(load_config('realtime', ['threads=1']))
    expected_poses = [slam.process(frame).T_world_cam for frame in frames]
    before, steps = slam.snapshot().means, slam.finish()
    check_folder(out, [frame.stamp_ns for frame in frames], expected_poses)
    saved = read_ply(out / 'map.ply').means.numpy()
    assert np.array_equal(saved, slam.snapshot().means) and not np.array_equal(saved, before)
    assert f'fitted the map to all keyframes once more: {steps} steps' in node.text
    assert json.loads((out / 'metrics.json').read_text())['finish_s'] > 0


def check_map(newest: dict[str, Any], slam: Slam, T_world_cam: np.ndarray) -> None:
    view = slam.render(T_world_cam)
    np.testing.assert_array_equal(images.decode_color(newest['render/rgb']), view.rgb)
    np.testing.assert_array_equal(images.decode_depth(newest['render/depth']), view.depth_m)
    silhouette = newest['render/silhouette']
    shown = np.frombuffer(silhouette.data, np.uint8).reshape(silhouette.height, silhouette.width) / 255
    assert silhouette.encoding == 'mono8'
    np.testing.assert_allclose(shown, view.silhouette, atol=0.51 / 255)  # rounded to whole steps
    assert {newest[topic].header.frame_id for topic in newest if topic.startswith('render')} == {CAMERA_FRAME}
    points, rgb = point_clouds.read_cloud(newest['map/points'])
    assert newest['map/points'].header.frame_id == 'map' and len(points) == len(rgb) == 500
    assert set(map(tuple, points)) <= set(map(tuple, slam.snapshot().means))


def check_folder(out: Path, expected_ns: list[int], expected_poses: list[np.ndarray]) -> None:
    run = read_run(out)
    assert run.description.program == 'splatam_node'
    assert run.trajectory.stamps_ns.tolist() == expected_ns
    # The file has nine decimals; a rotation's entries add up a few of their errors.
    np.testing.assert_allclose(run.trajectory.T_world_cam, np.stack(expected_poses), atol=5e-9)
    metrics = json.loads((out / 'metrics.json').read_text())
    assert metrics['frames'] == metrics['tracked'] == len(expected_ns)
    assert len(read_ply(out / 'map.ply').means) == metrics['num_gaussians'] > 500


def test_a_recording_that_is_over_before_the_first_frame_is_done_is_processed_to_its_end(
    graph: Graph, bag: Path, frames: SyntheticSequence
) -> None:
    """Nothing slows the player down: frames for which SLAM is too slow wait in the transport."""
    out = graph.folder / 'run'
    node = run_node(graph, save_path=out, queue_policy='all', queue_size=1, exit_on_publisher_end=True)
    player = graph.play(str(bag), '--rate', 'max')
    assert (player.wait(), node.wait()) == (0, 0), player.text + node.text
    assert read_run(out).trajectory.stamps_ns.tolist() == [frame.stamp_ns for frame in frames]


def test_compressed_recordings(graph: Graph, frames: SyntheticSequence) -> None:
    write_bag(frames, graph.folder / 'compressed', compressed=True, storage='mcap')
    out = graph.folder / 'run'
    node = run_node(
        graph, save_path=out, rgb_transport='compressed', depth_transport='compressedDepth', queue_policy='all',
        exit_on_publisher_end=True, width=32,
    )  # fmt: skip
    player = graph.play(str(graph.folder / 'compressed'), '--rate', 'max', '--wait-for')
    assert (player.wait(), node.wait()) == (0, 0), player.text + node.text
    run = read_run(out)
    # Frames may be lost: 32 pixels are too few for reliable tracking.
    assert sorted([*run.trajectory.stamps_ns, *run.lost_ns]) == [frame.stamp_ns for frame in frames]
    assert (run.camera.width, run.camera.height) == (32, 24)


HOLDS = """
import sys, time
from pathlib import Path
from splatam_core.slam import Slam
works = Slam.process
def process(self, *args):
    print('at work', flush=True)
    while not Path(sys.argv[1]).exists():
        time.sleep(0.01)
    return works(self, *args)
Slam.process = process
from splatam_ros.node.main import main
sys.exit(main(sys.argv[2:]))
"""


def test_live_the_newest_frames_are_taken_and_the_others_counted(graph: Graph, frames: SyntheticSequence) -> None:
    go = graph.folder / 'go'
    camera, done = Camera(graph), graph.collect(Header, '/splatam/processed')
    diagnostics = graph.collect(DiagnosticArray, '/diagnostics')
    node = graph.start('-c', HOLDS, str(go), *node_arguments(preset='quick', queue_size=2, **SLAM))
    camera.wait_matched()
    camera.send(still(frames, 0))
    node.wait_says('at work')
    for number in range(1, 10):
        camera.send(still(frames, number))

    def num_dropped() -> str | None:
        items = [item for array in diagnostics[-1:] for status in array.status for item in status.values]
        return next((item.value for item in items if item.key == 'frames dropped'), None)

    graph.spin_until(lambda: num_dropped() == '7', explain=lambda: f'{num_dropped()} {node.text}')
    node.wait_says('WARN', 'SLAM is slower than the camera')
    go.touch()
    graph.spin_until(lambda: len(done) == 3, explain=lambda: node.text)
    assert [stamps.to_ns(header.stamp) for header in done] == [still(frames, n).stamp_ns for n in (0, 8, 9)]


def test_queued_frames_are_published_under_their_own_frame_ids(graph: Graph, frames: SyntheticSequence) -> None:
    """Both frames are assembled before SLAM finishes the first; its outputs must not get the frame id of the second."""
    go = graph.folder / 'go'
    camera, diagnostics = Camera(graph), graph.collect(DiagnosticArray, '/diagnostics')
    odometry, renders = graph.collect(Odometry, '/splatam/odometry'), graph.collect(Image, '/splatam/render/rgb')
    node = graph.start('-c', HOLDS, str(go), *node_arguments(preset='quick', queue_policy='all', **SLAM))
    camera.wait_matched()
    graph.spin_until(lambda: graph.node.count_publishers('/splatam/odometry'), explain=lambda: node.text)
    frame_ids = {still(frames, number).stamp_ns: frame_id for number, frame_id in enumerate(('left_eye', 'right_eye'))}
    for number, frame_id in enumerate(frame_ids.values()):
        messages = camera.messages(still(frames, number), still(frames, number).stamp_ns)
        for message in messages.values():
            message.header.frame_id = frame_id
        camera.publish(messages)

    def num_waiting() -> str | None:
        items = [item for array in diagnostics[-1:] for status in array.status for item in status.values]
        return next((item.value for item in items if item.key == 'frames waiting'), None)

    graph.spin_until(lambda: num_waiting() == '2', explain=lambda: f'{num_waiting()} {node.text}')
    go.touch()
    graph.spin_until(lambda: len(odometry) == 2, explain=lambda: node.text)
    assert [message.child_frame_id for message in odometry] == ['left_eye', 'right_eye']
    assert all(message.header.frame_id == frame_ids[stamps.message_stamp_ns(message)] for message in renders)


def test_a_recording_in_a_loop_with_its_clock(graph: Graph, bag: Path, frames: SyntheticSequence) -> None:
    """Sim time and stamps jump back together: each loop gets its own map, and processing never stops."""
    done, tracked = graph.collect(Header, '/splatam/processed'), graph.collect(PoseStamped, '/splatam/pose')
    diagnostics = graph.collect(DiagnosticArray, '/diagnostics')
    node = run_node(graph, queue_policy='all', use_sim_time=True, no_data_timeout=10.0, time_jump_threshold=0.2)
    graph.spin_until(lambda: graph.node.count_publishers('/splatam/pose'), explain=lambda: node.text)
    player = graph.play(str(bag), '--loop', '--clock', '--wait-for')
    graph.spin_until(lambda: min(len(done), len(tracked)) >= 3 * FRAMES, explain=lambda: player.text + node.text)
    player.send(signal.SIGINT)
    player.wait()
    expected_ns = [frame.stamp_ns for frame in frames] * 3
    assert [stamps.to_ns(header.stamp) for header in done][: 3 * FRAMES] == expected_ns
    for loop in range(3):
        of_loop = tracked[loop * FRAMES : (loop + 1) * FRAMES]
        assert stamps_of(of_loop) == expected_ns[:FRAMES]
        assert [pose.pose for pose in of_loop] == [pose.pose for pose in tracked[:FRAMES]]  # from the start, each time
    assert sum('map reset: time jumped back' in line for line in node.lines) >= 2
    assert stamps_of(diagnostics)[-1] < 60 * 10**9  # sim time; the recording begins at 1 s
    assert node.is_running and not node.says('use_sim_time is true')


# --- shutdown, signals and crashes ---


def start_playback(graph: Graph, bag: Path, **parameters: Any) -> tuple[Process, Process, Path]:
    """Start node and player, and wait until a third of the recording is processed."""
    out = graph.folder / 'run'
    node = run_node(graph, save_path=out, queue_policy='all', **parameters)
    player = graph.play(str(bag), '--rate', '0.05', '--wait-for')  # 0.67 s a frame: slower than any machine
    graph.spin_until(lambda: len(trajectory_lines(out)) >= 4, explain=lambda: node.text + player.text)
    return node, player, out


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_in_mid_run_leave_a_whole_folder(graph: Graph, bag: Path, number: signal.Signals) -> None:
    node, player, out = start_playback(graph, bag)
    node.send(number)
    node.send(signal.SIGINT)  # an impatient user; must not interrupt saving
    assert node.wait() == 0, node.text
    assert node.says('saved', 'frames') and 'Traceback' not in node.text
    run = read_run(out)
    metrics = json.loads((out / 'metrics.json').read_text())
    assert len(run.trajectory) == len(run.frames) == metrics['frames'] == metrics['tracked'] >= 4
    assert len(read_ply(out / 'map.ply').means) == metrics['num_gaussians']
    assert not list(out.glob('*.tmp*'))
    assert player.wait() == 1, player.text  # the node it played for has left
    assert player.says('left in mid-playback')


def test_a_killed_node_loses_nothing_and_the_player_says_which_frame_is_missing(graph: Graph, bag: Path) -> None:
    node, player, out = start_playback(graph, bag)
    node.send(signal.SIGKILL)
    player.wait_says('no answer on /splatam/pose', 'still waiting')
    assert player.wait() == 1  # after the ten seconds for which a process may not respond
    lines = trajectory_lines(out)
    assert len(read_run(out).trajectory) == len(lines) >= 4
    error = next(line for line in player.lines if 'error:' in line)
    assert 'left in mid-playback' in error
    missing = re.search(r'first frame not answered: (\S+) \(image (\d+)\)', error)
    # Every answered frame was written; one more may be if the kill came between writing and answering.
    assert len(lines) in (int(missing[2]) - 1, int(missing[2]))
    assert missing[1] not in [line.split()[0] for line in lines[: int(missing[2]) - 1]]


def test_a_stalled_node_goes_on_and_loses_nothing(graph: Graph, bag: Path, frames: SyntheticSequence) -> None:
    node, player, out = start_playback(graph, bag, exit_on_publisher_end=True)
    node.send(signal.SIGSTOP)
    player.wait_says('no answer on /splatam/pose', 'still waiting')
    node.send(signal.SIGCONT)
    assert player.wait() == 0, player.text
    assert node.wait() == 0, node.text
    assert read_run(out).trajectory.stamps_ns.tolist() == [frame.stamp_ns for frame in frames]


BREAKS = """
import sys
from splatam_core.slam import Slam
works, count = Slam.process, 0
def process(self, *args):
    global count
    count += 1
    if count == 4:
        raise ZeroDivisionError('something nobody thought of')
    return works(self, *args)
Slam.process = process
from splatam_ros.node.main import main
sys.exit(main(sys.argv[1:]))
"""


def test_when_slam_breaks_it_costs_one_frame(graph: Graph, bag: Path, frames: SyntheticSequence) -> None:
    out = graph.folder / 'run'
    arguments = node_arguments('--log-level', 'splatam:=debug', preset='quick', save_path=out, exit_on_publisher_end=True, **SLAM)
    node = graph.start('-c', BREAKS, *arguments)
    player = graph.play(str(bag), '--wait-for')
    assert (player.wait(), node.wait()) == (0, 0), player.text + node.text
    (warning,) = [line for line in node.lines if '[WARN]' in line]
    assert 'skipped: unexpected ZeroDivisionError: something nobody thought of' in warning
    assert node.text.count('Traceback') == 1 and node.says('[DEBUG]', 'Traceback')
    expected = [frame.stamp_ns for number, frame in enumerate(frames, 1) if number != 4]
    assert read_run(out).trajectory.stamps_ns.tolist() == expected


def test_when_slam_breaks_for_every_frame_the_exit_code_says_so(graph: Graph, frames: SyntheticSequence) -> None:
    camera, done = Camera(graph), graph.collect(Header, '/splatam/processed')
    node = graph.start('-c', BREAKS.replace('count == 4', 'True'), *node_arguments(preset='quick', **SLAM))
    camera.wait_matched()
    for count in (1, 2):
        camera.send(frames[count - 1])
        graph.spin_until(lambda: len(done) == count, explain=lambda: node.text)  # noqa: B023
    node.send(signal.SIGINT)
    assert node.wait() == 1 and node.says('ERROR', 'SLAM failed for every frame (2)') and 'Traceback' not in node.text


SLOW = """
import sys, time
from splatam_core.slam import Slam
works = Slam.process
def process(self, *args):
    time.sleep(0.4)
    return works(self, *args)
Slam.process = process
from splatam_ros.node.main import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_node_told_to_stop_drops_what_it_has_no_time_for(graph: Graph, frames: SyntheticSequence, number: signal.Signals) -> None:
    """A hundred frames of 0.4 s wait, in the queue and in the transport. The rest of the 8 s is for the final fit and saving."""
    out = graph.folder / 'run'
    camera, done = Camera(graph), graph.collect(Header, '/splatam/processed')
    arguments = node_arguments(preset='realtime', save_path=out, queue_policy='all', queue_size=1000, slam__threads=1)
    node = graph.start('-c', SLOW, *arguments)
    camera.wait_matched()
    for index in range(100):
        camera.send(still(frames, index))
    graph.spin_until(lambda: len(done) >= 2, explain=lambda: node.text)
    before = len(done)
    node.send(number)
    assert node.wait() == 0, node.text
    assert node.says('WARN', 'frames that waited for SLAM were dropped, because the node was told to stop')
    run = read_run(out)
    assert before <= len(run.frames) < 50  # two seconds of frames and those whose answer was on its way: some ten
    assert json.loads((out / 'metrics.json').read_text())['frames'] == len(run.frames)
    assert len(read_ply(out / 'map.ply').means) > 500


SAYS_WHEN_IT_TRACKS = """
import sys
from splatam_core.tracking.render_and_compare import RenderAndCompareTracker
works = RenderAndCompareTracker.track
def track(*arguments, **options):
    print('tracking begins', flush=True)
    return works(*arguments, **options)
RenderAndCompareTracker.track = track
from splatam_ros.node.main import main
sys.exit(main(sys.argv[1:]))
"""


def test_a_node_told_to_stop_gives_up_a_long_frame(graph: Graph, frames: SyntheticSequence) -> None:
    """Its tracking would take a minute. The frames before it are saved."""
    out = graph.folder / 'run'
    camera, done = Camera(graph), graph.collect(Header, '/splatam/processed')
    endless = {'slam__tracking__iterations': 10_000, 'slam__mapping__iterations': 1, 'slam__threads': 1}
    node = graph.start('-c', SAYS_WHEN_IT_TRACKS, *node_arguments(preset='splatam', save_path=out, **endless))
    camera.wait_matched()
    camera.send(still(frames, 0))
    graph.spin_until(lambda: done, explain=lambda: node.text)
    camera.send(still(frames, 1))
    node.wait_says('tracking begins')
    node.send(signal.SIGINT)
    assert node.wait() == 0, node.text
    assert node.says('WARN', 'skipped: its tracking was interrupted, because there is no time left')
    assert len(read_run(out).frames) == 1 and len(read_ply(out / 'map.ply').means) > 100


def test_a_folder_that_vanishes_is_one_error_at_the_end(graph: Graph, frames: SyntheticSequence) -> None:
    out = graph.folder / 'run'
    camera, done = Camera(graph), graph.collect(Header, '/splatam/processed')
    node = run_node(graph, save_path=out)
    camera.wait_matched()
    for count in (1, 2):
        camera.send(frames[count - 1])
        graph.spin_until(lambda: len(done) == count, explain=lambda: node.text)  # noqa: B023
    shutil.rmtree(out)
    node.send(signal.SIGTERM)
    assert node.wait() == 1
    assert node.says('saving failed', str(out)) and 'Traceback' not in node.text


# --- bad input ---


def test_bad_input_is_a_warning_each_and_the_node_goes_on(graph: Graph, frames: SyntheticSequence) -> None:
    out = graph.folder / 'run'
    camera = Camera(graph)
    done = graph.collect(Header, '/splatam/processed')
    tracked = graph.collect(PoseStamped, '/splatam/pose')
    node = run_node(graph, save_path=out, queue_policy='all')
    camera.wait_matched()
    good = (still(frames, number) for number in itertools.count())

    def send_good() -> None:
        frame = next(good)
        camera.send(frame)
        # The bad frame itself may have been processed: an invalid camera info is ignored, and the last valid one is used.
        graph.spin_until(lambda: done and stamps.to_ns(done[-1].stamp) == frame.stamp_ns, explain=lambda: node.text)

    def send_bad(*expected: str, frame: RgbdFrame | None = None, **changes: Any) -> None:
        camera.send(frame or next(good), **changes)
        graph.spin_until(lambda: node.says('WARN', *expected), explain=lambda: f'{expected}: {node.text}')
        send_good()

    send_good()
    send_bad('colour skipped', "'nv99'", rgb__encoding='nv99')
    send_bad('depth skipped', "'rgb8'", depth__encoding='rgb8')
    send_bad('CameraInfo skipped', 'K is all zero', info__k=np.zeros(9))
    wide = frames[0]
    send_bad('frame skipped', '64x48', '32x48', 'aligned_depth_to_color', depth__width=32, depth__step=128,
             depth__data=images.depth_message(MAKE, wide.depth_m[:, :32], 0, '').data)  # fmt: skip
    last_ns = stamps.to_ns(done[-1].stamp)
    nothing = replace(wide, stamp_ns=last_ns + 1000, depth_m=np.full_like(wide.depth_m, np.nan))
    send_bad('lost', frame=nothing, depth__data=nan_depth(wide))
    send_bad('dropped', 'stamp', frame=replace(wide, stamp_ns=stamps.to_ns(done[-1].stamp)))
    last_ns = stamps.to_ns(done[-1].stamp)
    send_bad('dropped', 'older than the last frame', frame=replace(wide, stamp_ns=last_ns - 10**8 // 2))

    assert node.is_running
    node.send(signal.SIGINT)
    assert node.wait() == 0, node.text
    run = read_run(out)
    graph.spin_until(lambda: len(tracked) == len(run.trajectory))
    assert run.trajectory.stamps_ns.tolist() == stamps_of(tracked)
    assert list(run.lost_ns) == [nothing.stamp_ns]
    assert 'Traceback' not in node.text


def nan_depth(frame: RgbdFrame) -> Any:
    return images.depth_message(MAKE, frame.depth_m, 0, '').data.__class__('B', np.full_like(frame.depth_m, np.nan).tobytes())


def test_a_camera_that_changes_is_refused_and_the_first_one_goes_on(graph: Graph, frames: SyntheticSequence) -> None:
    camera, done = Camera(graph), graph.collect(Header, '/splatam/processed')
    tracked = graph.collect(PoseStamped, '/splatam/pose')
    node = run_node(graph, on_camera_change='refuse')
    camera.wait_matched()
    first, second, third = (still(frames, number) for number in range(3))
    other = replace(second, camera=replace(second.camera, fx=60.0))
    for count, frame in enumerate((first, other, third), start=1):
        camera.send(frame)
        graph.spin_until(lambda: len(done) == count, explain=lambda: node.text)  # noqa: B023
    assert node.says('WARN', 'the camera changed')
    graph.spin_until(lambda: len(tracked) == 2)
    assert stamps_of(tracked) == [first.stamp_ns, third.stamp_ns]


def test_a_best_effort_camera_is_heard(graph: Graph, frames: SyntheticSequence) -> None:
    node = run_node(graph, no_data_timeout=1.0)
    node.wait_says('no publisher on /rgb/camera_info, /rgb/image and /depth/image')
    camera = Camera(graph, ReliabilityPolicy.BEST_EFFORT)
    tracked = graph.collect(PoseStamped, '/splatam/pose')
    camera.wait_matched()
    node.wait_says('/rgb/image is published best effort')

    sent = iter(range(10**6))

    def send() -> int:
        """Send until a pose arrives: with best effort the first messages may be lost. Stamps must increase."""
        camera.send(replace(frames[0], stamp_ns=10**9 + 10**7 * next(sent)))
        return len(tracked)

    graph.spin_until(send, explain=lambda: node.text)


def test_frames_whose_stamps_differ_pair_and_the_last_does_not_wait_for_ever(graph: Graph, frames: SyntheticSequence) -> None:
    camera, tracked = Camera(graph), graph.collect(PoseStamped, '/splatam/pose')
    node = run_node(graph, queue_policy='all')
    camera.wait_matched()
    for number in range(3):
        camera.send(still(frames, number), depth_delay_ns=5_000_000)
    graph.spin_until(lambda: len(tracked) == 3, explain=lambda: node.text)
    assert stamps_of(tracked) == [still(frames, number).stamp_ns for number in range(3)]


# --- parameters on the command line ---

OVERRIDE = 'qos_overrides./rgb/image.subscription'


UNUSABLE = {
    '-p slam.tracking.iteratons:=3': "did you mean 'tracking.iterations'",
    '-p queue_policy:=newest': "queue_policy = 'newest': expected one of latest, all",
    f'-p {OVERRIDE}.reliability:=perfect': f"{OVERRIDE}.reliability = 'perfect': expected one of",
    f'-p {OVERRIDE}.depth:=-3': f'{OVERRIDE}.depth = -3: expected a whole number at least 1',
    '-r rgb/image:=/bad topic': "not understood: ['topic']",
    '-p': 'trailing -p flag',
}


def test_unusable_parameters_are_one_line(graph: Graph) -> None:
    nodes = [graph.run_node(*line.split()) for line in UNUSABLE]  # in parallel, because starting takes longest
    for node, message in zip(nodes, UNUSABLE.values(), strict=True):
        assert node.wait(len(nodes) * TIMEOUT_S) == 2, node.text
        errors = [line for line in node.lines if 'error:' in line]
        assert len(errors) == 1 and message in errors[0] and 'Traceback' not in node.text, node.text


def test_what_overrides_nothing_is_told(graph: Graph) -> None:
    """An override that is misspelt or names a topic before remapping; ROS itself does not warn."""
    node = graph.run_node('-p', f'{OVERRIDE}.reliability:=best_effort', '-r', 'rgb/image:=/camera/color')
    node.wait_says('WARN', f"'{OVERRIDE}.reliability' has no effect", 'one of /rgb/camera_info, /camera/color')


def test_a_run_without_a_frame_leaves_its_folder_empty(graph: Graph) -> None:
    """The next start, with the camera plugged in, can use the folder."""
    out = graph.folder / 'run'
    for _ in range(2):
        node = run_node(graph, save_path=out)
        node.wait_says('waiting for')
        node.send(signal.SIGINT)
        assert node.wait() == 0 and node.says('no frame was received, so nothing is saved')
        assert not list(out.iterdir())


def test_a_folder_that_is_in_use_is_refused(graph: Graph) -> None:
    (graph.folder / 'run').mkdir()
    (graph.folder / 'run' / 'thesis.tex').touch()
    node = graph.run_node(save_path=graph.folder / 'run')
    assert node.wait() == 2
    assert node.says('error:', 'run', 'choose another folder')
