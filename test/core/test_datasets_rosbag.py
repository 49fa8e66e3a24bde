"""The bag writer and the bag reader: data are read back bit for bit, and damaged bags give clear errors."""

from __future__ import annotations

import numpy as np
import pytest
from rosbags.interfaces import QosDurability, QosReliability
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from msg_adapters import camera_info, images, poses
from msg_adapters.factory import RosbagsMessages
from splatam_core.datasets.bag.recording import Recording
from splatam_core.datasets.base import BagTopics
from splatam_core.datasets.convert import write_bag
from splatam_core.datasets.registry import open_sequence
from splatam_core.errors import CameraError, DatasetError, FrameError
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.geometry.trajectory import Trajectory
from splatam_core.types import RgbdFrame

STORAGES = ('sqlite3', 'mcap')
TYPES = get_typestore(Stores.ROS2_JAZZY)
FACTORY = RosbagsMessages(TYPES)
RNG = np.random.default_rng(0)
RGB = RNG.integers(0, 256, (12, 16, 3), np.uint8)
DEPTH_M = np.full((12, 16), 1.25, np.float32)
PARAMETERS = camera_info.CameraParameters(16, 12, 15.0, 15.5, 7.5, 5.5, frame_id='camera')
MS = 1_000_000
SECOND = 1_000_000_000


class Frames:
    """Frames of random pixels in memory."""

    name = 'frames'

    def __init__(self, stamps_ns, depth_scale, truth=None, size=(12, 16)):
        height, width = size
        self.camera = PinholeCamera(width, height, 15.123456789, 15.5, 7.25, 5.5)
        rng = np.random.default_rng(1)
        self.depth_scale = depth_scale
        self._stamps_ns, self._truth = stamps_ns, truth
        counts = rng.integers(0, 65536, (len(stamps_ns), height, width)).astype(np.uint16)
        self._depth_m = counts.astype(np.float32) / np.float32(depth_scale or 7321)
        self._rgb = rng.integers(0, 256, (len(stamps_ns), height, width, 3), np.uint8)

    def __len__(self):
        return len(self._stamps_ns)

    def __getitem__(self, index):
        return RgbdFrame(self._stamps_ns[index], self._rgb[index], self._depth_m[index], self.camera)

    def ground_truth(self):
        return self._truth


def assert_same(read: RgbdFrame, written: RgbdFrame) -> None:
    assert read.stamp_ns == written.stamp_ns
    assert read.camera == written.camera
    for a, b in ((read.rgb, written.rgb), (read.depth_m, written.depth_m)):
        assert a.dtype == b.dtype
        assert np.array_equal(a, b)


def raw(message):
    return TYPES.serialize_cdr(message, message.__msgtype__)


def color(stamp_ns, rgb=RGB):
    return images.color_message(FACTORY, rgb, stamp_ns, 'camera')


def depth(stamp_ns, depth_m=DEPTH_M, encoding='16UC1'):
    return images.depth_message(FACTORY, depth_m, stamp_ns, 'camera', encoding=encoding)


def info(stamp_ns, parameters=PARAMETERS):
    return camera_info.info_message(FACTORY, parameters, stamp_ns)


def make_bag(path, messages, storage='sqlite3'):
    """A bag of (topic, time of recording, message)."""
    with Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()]) as writer:
        connections = {}
        for topic, recorded_ns, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=TYPES)
            writer.write(connections[topic], recorded_ns, raw(message))
    return path


def rgbd(stamp_ns, camera='/camera'):
    """Camera info, colour and depth image with the same stamp."""
    return [
        (f'{camera}/color/camera_info', stamp_ns, info(stamp_ns)),
        (f'{camera}/color/image_raw', stamp_ns, color(stamp_ns)),
        (f'{camera}/depth/image_raw', stamp_ns, depth(stamp_ns)),
    ]


# --- written and read back ---


@pytest.mark.parametrize('storage', STORAGES)
@pytest.mark.parametrize('scale', [1000.0, 5000.0, None])
def test_round_trip_is_exact(tmp_path, storage, scale):
    """Millimetres go through 16UC1, everything else through 32FC1; stamps keep every nanosecond."""
    written = Frames([1_305_031_235_529_738_001, 1_305_031_235_561_675_123, 1_305_031_236_000_000_000], scale)
    write_bag(written, tmp_path / 'bag', storage=storage)
    read = open_sequence(str(tmp_path / 'bag'))
    assert len(read) == 3
    assert (read.name, read.camera) == ('bag', written.camera)
    assert read.depth_scale == (1000.0 if scale == 1000.0 else None)
    for index in range(3):
        assert_same(read[index], written[index])
    assert read.ground_truth() is None


@pytest.mark.parametrize('storage', STORAGES)
def test_synthetic_round_trip_with_truth(tmp_path, room, storage):
    written = room(frames=4, width=48)
    write_bag(written, tmp_path / 'bag', storage=storage)
    read = open_sequence(str(tmp_path / 'bag'))
    for index in range(4):
        assert_same(read[index], written[index])
    truth, expected = read.ground_truth(), written.ground_truth()
    assert truth.stamps_ns.tolist() == expected.stamps_ns.tolist()
    # through a unit quaternion in float64 and back
    assert np.abs(truth.T_world_cam - expected.T_world_cam).max() < 1e-14


@pytest.mark.parametrize('name', ['tum_fr1_rpy', '7scenes_redkitchen'])
def test_real_round_trip(tmp_path, recording, name):
    """Rectified and resized depth still consists of whole counts, so the bag has the same frames."""
    written = open_sequence(str(recording(name)), width=80, start=3, max_frames=4)
    write_bag(written, tmp_path / 'bag')
    read = open_sequence(str(tmp_path / 'bag'))
    assert len(read) == 4
    for index in range(4):
        assert_same(read[index], written[index])


def test_a_bag_of_a_bag_is_the_same(tmp_path, room):
    write_bag(room(frames=2, width=32), tmp_path / 'a')
    write_bag(open_sequence(str(tmp_path / 'a')), tmp_path / 'b', storage='mcap')
    a, b = open_sequence(str(tmp_path / 'a')), open_sequence(str(tmp_path / 'b'))
    assert_same(b[1], a[1])
    # through a unit quaternion in float64 and back
    assert np.abs(a.ground_truth().T_world_cam - b.ground_truth().T_world_cam).max() < 1e-14


@pytest.mark.parametrize('storage', STORAGES)
def test_single_file_reads_like_its_folder(tmp_path, room, storage):
    write_bag(room(frames=2, width=32), tmp_path / 'bag', storage=storage)
    (file,) = [path for path in (tmp_path / 'bag').iterdir() if path.suffix in ('.db3', '.mcap')]
    read = open_sequence(str(file))
    assert_same(read[1], room(frames=2, width=32)[1])


@pytest.mark.parametrize('storage', STORAGES)
def test_compressed(tmp_path, room, storage):
    written = room(frames=2, width=160)
    write_bag(written, tmp_path / 'bag', storage=storage, compressed=True)
    read = open_sequence(str(tmp_path / 'bag'))
    with Reader(tmp_path / 'bag') as reader:
        assert {'/rgb/image/compressed', '/depth/image/compressedDepth'} < set(reader.topics)
    assert np.array_equal(read[1].depth_m, written[1].depth_m)  # PNG of whole millimetres
    difference = np.abs(read[1].rgb.astype(int) - written[1].rgb)
    assert 0 < difference.mean() < 4  # JPEG at quality 95, grey levels


@pytest.mark.parametrize('storage', STORAGES)
def test_topics_types_order_and_qos(tmp_path, room, storage):
    write_bag(room(frames=3, width=32), tmp_path / 'bag', storage=storage)
    with Reader(tmp_path / 'bag') as reader:
        assert {topic: details.msgtype for topic, details in reader.topics.items()} == {
            '/rgb/image': 'sensor_msgs/msg/Image',
            '/depth/image': 'sensor_msgs/msg/Image',
            '/rgb/camera_info': 'sensor_msgs/msg/CameraInfo',
            '/ground_truth/pose': 'geometry_msgs/msg/PoseStamped',
        }
        for connection in reader.connections:
            (qos,) = connection.ext.offered_qos_profiles
            assert (qos.reliability, qos.durability) == (QosReliability.RELIABLE, QosDurability.VOLATILE)
        stamps = []
        for connection, recorded_ns, data in reader.messages(reader.connections):
            header = TYPES.deserialize_cdr(data, connection.msgtype).header
            assert header.stamp.sec * SECOND + header.stamp.nanosec == recorded_ns
            stamps.append(recorded_ns)
    assert stamps == sorted(stamps)
    assert len(stamps) == 12


def test_truth_covers_the_frames_and_no_more(tmp_path):
    stamps = np.arange(0, 100) * 10 * MS
    truth = Trajectory(stamps, np.broadcast_to(np.eye(4), (100, 4, 4)))
    write_bag(Frames([205 * MS, 238 * MS, 300 * MS], 1000.0, truth), tmp_path / 'bag')
    kept = open_sequence(str(tmp_path / 'bag')).ground_truth().stamps_ns
    assert kept.tolist() == list(range(200 * MS, 301 * MS, 10 * MS))  # 205 and 300 can be interpolated


def test_progress_sees_every_frame(tmp_path, room):
    seen = []

    def progress(indices):
        for index in indices:
            seen.append(index)
            yield index

    write_bag(room(frames=3, width=32), tmp_path / 'bag', progress=progress)
    assert seen == [0, 1, 2]


def test_existing_path_is_refused(tmp_path, room):
    (tmp_path / 'bag').mkdir()
    with pytest.raises(DatasetError, match='exists already; remove it or choose another name'):
        write_bag(room(), tmp_path / 'bag')
    assert list((tmp_path / 'bag').iterdir()) == []


def test_unknown_storage(tmp_path, room):
    with pytest.raises(DatasetError, match="storage 'ros1' is not one of sqlite3, mcap"):
        write_bag(room(), tmp_path / 'bag', storage='ros1')


@pytest.mark.parametrize('storage', STORAGES)
def test_interrupted_writing_leaves_nothing(tmp_path, room, storage):
    class Breaking(Frames):
        def __getitem__(self, index):
            if index == 1:
                raise DatasetError('no such image')
            return super().__getitem__(index)

    with pytest.raises(DatasetError, match='no such image'):
        write_bag(Breaking([1, 2, 3], 1000.0), tmp_path / 'bag', storage=storage)
    assert list(tmp_path.iterdir()) == []


def test_half_written_bag_is_not_at_its_place(tmp_path, room):
    """While the bag is written (and so after a kill, too) there is no folder with its name."""
    seen = []

    def progress(indices):
        for index in indices:
            seen.append((tmp_path / 'bag').exists())
            yield index

    write_bag(room(frames=2, width=32), tmp_path / 'bag', progress=progress)
    assert seen == [False, False]
    assert [path.name for path in tmp_path.iterdir()] == ['bag']


def test_unwritable_place(tmp_path, room):
    (tmp_path / 'file').touch()
    with pytest.raises(DatasetError, match='cannot be written'):
        write_bag(room(), tmp_path / 'file' / 'bag')


# --- reading in any order ---


@pytest.mark.parametrize('storage', STORAGES)
def test_any_order(tmp_path, storage):
    """More frames than the look-ahead, in several chunks of 1 MB, read forwards, backwards, in jumps and twice."""
    written = Frames([(i + 1) * 33 * MS for i in range(30)], 1000.0, size=(96, 128))
    write_bag(written, tmp_path / 'bag', storage=storage)
    read = open_sequence(str(tmp_path / 'bag'))
    for index in [0, 1, 2, 29, 28, 3, 3, 20, 0, -1]:
        assert_same(read[index], written[index])
    assert [frame.stamp_ns for frame in read] == [written[i].stamp_ns for i in range(30)]
    with pytest.raises(IndexError):
        read[30]


@pytest.mark.parametrize('storage', STORAGES)
def test_messages_recorded_at_the_same_time(tmp_path, storage):
    """A recorder may give the same time to many messages; each must still be found."""
    stamps = [SECOND + i * 100 * MS for i in range(5)]
    messages = [('/info', SECOND, info(stamps[0]))]
    for i, stamp in enumerate(stamps):
        messages += [('/rgb', 5 * SECOND, color(stamp, np.full_like(RGB, i))), ('/depth', 5 * SECOND, depth(stamp))]
    read = open_sequence(str(make_bag(tmp_path / 'bag', messages, storage)))
    assert [int(read[i].rgb[0, 0, 0]) for i in (4, 0, 3, 1, 2)] == [4, 0, 3, 1, 2]


@pytest.mark.parametrize('storage', STORAGES)
def test_iterations_over_messages_do_not_disturb_each_other(tmp_path, storage):
    """Two iterations at the same time, with jumps between chunks of 1 MB."""
    write_bag(Frames([(i + 1) * 33 * MS for i in range(30)], 1000.0, size=(96, 128)), tmp_path / 'bag', storage=storage)
    with Recording(tmp_path / 'bag') as recording:
        expected = [message.data for message in recording.messages(['/rgb/image'])]
        assert len(set(expected)) == 30
        first = recording.messages(['/rgb/image'])
        seen = [next(first).data for _ in range(3)]
        last = [message.data for message in recording.messages(['/rgb/image'], start_ns=28 * 33 * MS)]
        assert last == expected[27:]
        assert seen + [message.data for message in first] == expected


def test_what_a_recording_says_about_its_topics(tmp_path):
    bag = make_bag(tmp_path / 'bag', [*rgbd(SECOND), *rgbd(3 * SECOND)])
    with Recording(bag) as recording:
        assert (recording.start_ns, recording.end_ns, recording.duration_s) == (SECOND, 3 * SECOND, 2.0)
        topic = recording.topics['/camera/depth/image_raw']
        assert (topic.type_name, topic.is_image, topic.num_messages) == ('sensor_msgs/msg/Image', True, 2)
        assert recording.encoding(topic.name) == '16UC1'
        assert [recording.is_depth(name) for name in ('/camera/depth/image_raw', '/camera/color/image_raw')] == [True, False]
        assert recording.topics_of('sensor_msgs/msg/CameraInfo') == ['/camera/color/camera_info']


# --- pairing ---


def test_pairs_by_header_stamp_not_by_order(tmp_path):
    """Depth arrives late and has its own stamps; the frame has the colour image's stamp."""
    messages = [('/info', 0, info(0))]
    for i in range(4):
        stamp = SECOND + i * 33 * MS
        messages.append(('/rgb', stamp, color(stamp)))
        messages.append(('/depth', stamp + 60 * MS, depth(stamp + 9 * MS, DEPTH_M + np.float32(i))))
    messages.sort(key=lambda message: message[1])
    read = open_sequence(str(make_bag(tmp_path / 'bag', messages)))
    assert [read[i].stamp_ns for i in range(4)] == [SECOND + i * 33 * MS for i in range(4)]
    assert [float(read[i].depth_m[0, 0]) for i in range(4)] == [1.25, 2.25, 3.25, 4.25]


def test_nothing_pairs(tmp_path):
    messages = [('/info', 0, info(0)), ('/rgb', 0, color(SECOND)), ('/depth', 0, depth(SECOND + 21 * MS))]
    with pytest.raises(DatasetError, match='none of 1 images on /rgb and 1 on /depth are within 20 ms'):
        open_sequence(str(make_bag(tmp_path / 'bag', messages)))


def test_unpaired_colour_is_warned_about(tmp_path, caplog):
    messages = [*rgbd(SECOND), ('/camera/color/image_raw', 2 * SECOND, color(2 * SECOND))]
    assert len(open_sequence(str(make_bag(tmp_path / 'bag', messages)))) == 1
    assert '1 of 2 colour images have no depth' in caplog.text


def test_info_may_come_last(tmp_path):
    """A latched info may be anywhere in the bag; the reader knows it beforehand."""
    messages = [message for i in range(1, 60) for message in rgbd(i * SECOND)[1:]]
    read = open_sequence(str(make_bag(tmp_path / 'bag', [*messages, rgbd(60 * SECOND)[0]])))
    assert len(read) == 59


def test_time_that_runs_backwards(tmp_path):
    messages = [*rgbd(5 * SECOND), *rgbd(SECOND)]
    messages = [(topic, i, message) for i, (topic, _, message) in enumerate(messages)]
    with pytest.raises(DatasetError, match=r'time does not increase from frame 0 \(5000000000 ns\) to frame 1'):
        open_sequence(str(make_bag(tmp_path / 'bag', messages)))


# --- topics ---


def test_camera_info_beside_the_colour_image_is_taken(tmp_path):
    other = camera_info.CameraParameters(99, 99, 1.0, 1.0, 0.0, 0.0)
    messages = [*rgbd(SECOND), ('/camera/depth/camera_info', SECOND, info(SECOND, other))]
    assert open_sequence(str(make_bag(tmp_path / 'bag', messages))).camera.width == 16


def test_several_topics_are_listed_and_can_be_chosen(tmp_path):
    messages = [*rgbd(SECOND, '/left'), *rgbd(SECOND, '/right')]
    bag = str(make_bag(tmp_path / 'bag', messages))
    with pytest.raises(DatasetError) as caught:
        open_sequence(bag)
    message = str(caught.value)
    for part in ('/left/color/image_raw', '/right/color/image_raw', '--rgb', '--depth', '--info'):
        assert part in message
    with pytest.raises(DatasetError, match='several topics could be the depth image'):
        open_sequence(bag, topics=BagTopics(rgb='/left/color/image_raw'))
    read = open_sequence(bag, topics=BagTopics('/right/color/image_raw', '/right/depth/image_raw'))
    assert len(read) == 1


def test_chosen_topic_that_is_not_there(tmp_path):
    bag = str(make_bag(tmp_path / 'bag', rgbd(SECOND)))
    with pytest.raises(DatasetError, match="--rgb '/nope' is no colour image topic with messages; there is /camera/co"):
        open_sequence(bag, topics=BagTopics(rgb='/nope'))
    both = BagTopics('/camera/color/image_raw', '/camera/color/image_raw')
    with pytest.raises(DatasetError, match=r'--depth .* is no depth image topic with messages; there is /camera/depth'):
        open_sequence(bag, topics=both)
    with pytest.raises(DatasetError, match="--info '/nope' is no camera info topic"):
        open_sequence(bag, topics=BagTopics(info='/nope'))


@pytest.mark.parametrize(
    ('left_out', 'what'), [(0, 'camera info'), (1, 'colour image'), (2, 'depth image')], ids=['info', 'rgb', 'depth']
)
def test_missing_topic_says_what_there_is(tmp_path, left_out, what):
    messages = rgbd(SECOND)
    del messages[left_out]
    with pytest.raises(DatasetError, match=rf'no {what} topic with messages; the bag holds /camera.*sensor_msgs/msg'):
        open_sequence(str(make_bag(tmp_path / 'bag', messages)))


@pytest.mark.parametrize(('encoding', 'scale'), [('16UC1', 1000.0), ('32FC1', None)])
def test_depth_encodings(tmp_path, encoding, scale):
    messages = [*rgbd(SECOND)[:2], ('/d', SECOND, depth(SECOND, encoding=encoding))]
    read = open_sequence(str(make_bag(tmp_path / 'bag', messages)))
    assert read.depth_scale == scale
    assert np.all(read[0].depth_m == 1.25)


def test_depth_compressed_without_compressed_depth_is_known_by_its_name(tmp_path):
    import cv2

    stamp = SECOND
    header = depth(stamp).header
    _, png = cv2.imencode('.png', np.full((12, 16), 1250, np.uint16))
    message = FACTORY.make('sensor_msgs/msg/CompressedImage', header=header, format='png', data=png.reshape(-1))
    messages = [*rgbd(stamp)[:2], ('/camera/depth/image_raw/compressed', stamp, message)]
    assert np.all(open_sequence(str(make_bag(tmp_path / 'bag', messages)))[0].depth_m == 1.25)


# --- cameras ---


def test_distorted_camera_is_rectified(tmp_path):
    bent = camera_info.CameraParameters(16, 12, 15.0, 15.5, 7.5, 5.5, 'plumb_bob', (0.3, 0.0, 0.0, 0.0, 0.0))
    messages = [('/camera/color/camera_info', SECOND, info(SECOND, bent)), *rgbd(SECOND)[1:]]
    frame = open_sequence(str(make_bag(tmp_path / 'bag', messages)))[0]
    assert not np.array_equal(frame.rgb, RGB)
    assert np.count_nonzero(frame.depth_m == 0) > 0  # the corners lie outside the recorded image


def test_camera_that_changes(tmp_path):
    other = camera_info.CameraParameters(16, 12, 16.0, 15.5, 7.5, 5.5)
    messages = [*rgbd(SECOND), ('/camera/color/camera_info', 2 * SECOND, info(2 * SECOND, other))]
    with pytest.raises(DatasetError, match=r'the camera changes at 2\.000000000 s'):
        open_sequence(str(make_bag(tmp_path / 'bag', messages)))


def test_camera_yaml_wins_and_needs_no_info(tmp_path):
    bag = make_bag(tmp_path / 'bag', rgbd(SECOND)[1:])
    (bag / 'camera.yaml').write_text('{width: 16, height: 12, fx: 20, fy: 20, cx: 8, cy: 6, depth_scale: 500}')
    read = open_sequence(str(bag))
    assert (read.camera.fx, read.depth_scale) == (20, 500)
    assert np.all(read[0].depth_m == 2.5)  # 1250 counts of 2 mm


def test_depth_scale_is_for_counts_not_for_metres(tmp_path):
    bag = make_bag(tmp_path / 'bag', [*rgbd(SECOND)[:2], ('/d', SECOND, depth(SECOND, encoding='32FC1'))])
    (bag / 'camera.yaml').write_text('{width: 16, height: 12, fx: 20, fy: 20, cx: 8, cy: 6, depth_scale: 500}')
    read = open_sequence(str(bag))
    assert read.depth_scale is None
    assert np.all(read[0].depth_m == 1.25)


def test_uncalibrated_camera(tmp_path):
    message = info(SECOND)
    message.k[:] = message.p[:] = 0
    with pytest.raises(CameraError, match=r'/camera/color/camera_info: CameraInfo K'):
        messages = [('/camera/color/camera_info', SECOND, message), *rgbd(SECOND)[1:]]
        open_sequence(str(make_bag(tmp_path / 'bag', messages)))


@pytest.mark.parametrize(
    ('make', 'message'),
    [
        (lambda: color(SECOND, RGB[:6]), 'colour image is 16x6'),
        (lambda: depth(SECOND, DEPTH_M[:, :8]), 'depth image is 8x12'),
    ],
)
def test_sizes_that_differ(tmp_path, make, message):
    bad = make()
    topic = '/camera/color/image_raw' if bad.encoding == 'rgb8' else '/camera/depth/image_raw'
    messages = [entry for entry in rgbd(SECOND) if entry[0] != topic]
    read = open_sequence(str(make_bag(tmp_path / 'bag', [*messages, (topic, SECOND, bad)])))
    with pytest.raises(FrameError, match=message):
        read[0]


def test_unknown_encoding_is_an_error_of_its_frame(tmp_path):
    bad = color(2 * SECOND)
    bad.encoding = 'mono12'
    messages = [*rgbd(SECOND), ('/camera/color/image_raw', 2 * SECOND, bad), rgbd(2 * SECOND)[2]]
    read = open_sequence(str(make_bag(tmp_path / 'bag', messages)))
    assert read[0].stamp_ns == SECOND
    with pytest.raises(FrameError, match=r"image at 2\.000000000 s: colour image has encoding 'mono12'"):
        read[1]


def test_poses_that_are_not_truth_are_left_alone(tmp_path):
    pose = poses.pose_stamped(FACTORY, np.eye(4), SECOND, 'map')
    messages = [*rgbd(SECOND), ('/robot/pose', SECOND, pose)]
    assert open_sequence(str(make_bag(tmp_path / 'bag', messages))).ground_truth() is None


# --- broken bags ---


@pytest.mark.parametrize('storage', STORAGES)
def test_empty_bag(tmp_path, storage):
    with pytest.raises(DatasetError, match='the bag is empty'):
        open_sequence(str(make_bag(tmp_path / 'bag', [], storage)))


@pytest.mark.parametrize('storage', STORAGES)
@pytest.mark.parametrize('kept', [0.0, 0.001, 0.3, 0.7, 0.98])
@pytest.mark.parametrize('as_file', [False, True])
def test_truncated_bag(tmp_path, storage, kept, as_file, caplog):
    """A bag cut anywhere, opened as folder or as file, gives one error, or the frames that are whole and a warning."""
    written = Frames([(i + 1) * 33 * MS for i in range(12)], 1000.0, size=(16, 20))
    write_bag(written, tmp_path / 'bag', storage=storage)
    (file,) = [path for path in (tmp_path / 'bag').iterdir() if path.suffix in ('.db3', '.mcap')]
    data = file.read_bytes()
    file.write_bytes(data[: int(kept * len(data))])
    try:
        sequence = open_sequence(str(file if as_file else tmp_path / 'bag'))
    except DatasetError as error:
        assert kept < 0.5 or storage == 'mcap'  # which has all images in one chunk here
        assert '\n' not in str(error)
        assert str(tmp_path / 'bag') in str(error)
    else:
        assert f'{file.name} is cut or damaged' in caplog.text
        for index in range(len(sequence)):
            assert_same(sequence[index], written[index])


def test_messages_missing_from_what_the_bag_states(tmp_path, room, caplog):
    write_bag(room(width=32), tmp_path / 'bag')
    metadata = tmp_path / 'bag' / 'metadata.yaml'
    metadata.write_text(metadata.read_text().replace('message_count: 3', 'message_count: 4'))
    assert len(open_sequence(str(tmp_path / 'bag'))) == 3
    assert 'has 3 messages of the 4 that the bag states; is the copy complete?' in caplog.text


@pytest.mark.parametrize('text', ['', '{}', 'rosbag2_bagfile_information: 3', ': :\n -'])
def test_broken_metadata(tmp_path, text):
    (tmp_path / 'metadata.yaml').write_text(text)
    with pytest.raises(DatasetError, match='cannot be read as a rosbag2') as caught:
        open_sequence(str(tmp_path))
    assert '\n' not in str(caught.value)


def test_no_bag_at_all(tmp_path):
    with pytest.raises(DatasetError, match='is an empty folder; rosbag expects a rosbag2 folder'):
        open_sequence(str(tmp_path), format='rosbag')
