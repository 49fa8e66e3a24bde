"""Bags as people bring them: interrupted, compressed, hand-edited, and of recorders and drivers with habits of their own."""

from __future__ import annotations

import gc
import os
import re
import shutil
import sqlite3
import struct
import tempfile

import cv2
import numpy as np
import pytest
import yaml
from rosbags import rosbag1
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from test_datasets_rosbag import FACTORY, MS, SECOND, STORAGES, TYPES, raw

from msg_adapters import camera_info, images, poses
from splatam_core.datasets.bag import unpacked
from splatam_core.datasets.bag.recording import Recording
from splatam_core.datasets.registry import open_sequence
from splatam_core.errors import CameraError, DatasetError, FrameError

SIZE = WIDTH, HEIGHT = 32, 24
RGB = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
DEPTH_M = np.full((HEIGHT, WIDTH), 1.25, np.float32)
PARAMETERS = camera_info.CameraParameters(WIDTH, HEIGHT, 30.0, 30.5, 15.5, 11.5, frame_id='color')
RGB_TOPIC, DEPTH_TOPIC, INFO_TOPIC = '/camera/color/image_raw', '/camera/depth/image_raw', '/camera/color/camera_info'
PERIOD = 33 * MS
NO_TIME = QosTime(0, 0)
QOS = Qos(QosHistory.KEEP_LAST, 10, QosReliability.RELIABLE, QosDurability.VOLATILE, NO_TIME, NO_TIME,
          QosLiveliness.SYSTEM_DEFAULT, NO_TIME, False)  # fmt: skip


BOMB = (
    'a0: &a0 [x]\n'
    + ''.join(f'a{i}: &a{i} [{", ".join([f"*a{i - 1}"] * 9)}]\n' for i in range(1, 12))
    + 'rosbag2_bagfile_information: {relative_file_paths: *a11}'
)


def color(stamp_ns, number=0, encoding='rgb8'):
    message = images.color_message(FACTORY, np.roll(RGB, number, axis=1), stamp_ns, 'color')
    message.encoding = encoding
    return message


def depth(stamp_ns, frame='color'):
    return images.depth_message(FACTORY, DEPTH_M, stamp_ns, frame, encoding='16UC1')


def info(stamp_ns, **changes):
    message = camera_info.info_message(FACTORY, PARAMETERS, stamp_ns)
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def with_focal_length(fx, stamp_ns):
    message = info(stamp_ns)
    message.k[0] = message.p[0] = fx
    return message


def scene(count=4, make_info=info, make_color=color, make_depth=depth, depth_late=0, period=PERIOD):
    """(topic, time of recording, message) of some frames, from 1 s on."""
    messages = []
    for i in range(count):
        stamp = SECOND + i * period
        rgb = color(stamp, i) if make_color is color else make_color(stamp)
        messages += [(INFO_TOPIC, stamp, make_info(stamp)), (RGB_TOPIC, stamp, rgb)]
        messages.append((DEPTH_TOPIC, stamp + depth_late, make_depth(stamp + depth_late)))
    return messages


def write(path, messages, storage='sqlite3', compress=None):
    """A bag of (topic, time, message); a message may be bytes of the type of the one before on its topic."""
    writer = Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
    if compress:
        writer.set_compression(compress, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, recorded_ns, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=TYPES, offered_qos_profiles=[QOS])
            writer.write(connections[topic], recorded_ns, message if isinstance(message, bytes) else raw(message))
    return path


def file_of(bag):
    (file,) = [path for path in bag.iterdir() if path.name != 'metadata.yaml']
    return file


def colors_of(sequence):
    return [sequence[i].rgb.tobytes() for i in range(len(sequence))]


@pytest.fixture
def whole(tmp_path):
    """The colour images of an undamaged recording of four frames."""
    return colors_of(open_sequence(str(write(tmp_path / 'whole', scene()))))


# --- ground truth ---


def test_unknown_poses_are_left_out_and_counted(tmp_path, caplog):
    """Trackers mark what they do not see with NaN, or with zeros for the quaternion."""
    truth = []
    for i in range(6):
        message = poses.pose_stamped(FACTORY, np.eye(4), SECOND + i * PERIOD, 'world')
        if i == 1:
            message.pose.position.x = float('nan')
        elif i == 2:
            message.pose.orientation.w = 0.0
        elif i == 3:
            message.pose.position.z = float('inf')
        truth.append(('/ground_truth/pose', SECOND + i * PERIOD, message))
    truth.append(('/ground_truth/pose', 2 * SECOND, b'\0\1\0\0' + struct.pack('<iI', 2, 0)))  # cut
    read = open_sequence(str(write(tmp_path / 'bag', scene() + truth)))
    assert read.ground_truth().stamps_ns.tolist() == [SECOND, SECOND + 4 * PERIOD, SECOND + 5 * PERIOD]
    assert len(colors_of(read)) == 4
    assert '4 of 7 poses on /ground_truth/pose are unknown' in caplog.text


def test_no_known_pose_is_no_ground_truth(tmp_path):
    message = poses.pose_stamped(FACTORY, np.eye(4), SECOND, 'world')
    message.pose.position.y = float('nan')
    read = open_sequence(str(write(tmp_path / 'bag', [*scene(), ('/ground_truth/pose', SECOND, message)])))
    assert read.ground_truth() is None


# --- cameras ---


@pytest.mark.parametrize('model', ['None', 'kannala', 'Inverse Brown Conrady', 'x y'])
def test_any_model_without_coefficients(tmp_path, model):
    read = open_sequence(str(write(tmp_path / 'bag', scene(make_info=lambda ns: info(ns, distortion_model=model)))))
    assert read[0].camera.fx == 30.0


@pytest.mark.parametrize('bad', [{'k': np.zeros(9), 'p': np.zeros(12)}, {'k': np.full(9, np.nan)}, {'width': 0}])
def test_camera_infos_that_cannot_be_used_are_left_out(tmp_path, caplog, bad):
    read = open_sequence(str(write(tmp_path / 'bag', scene(make_info=lambda ns: info(ns, **bad) if ns == SECOND else info(ns)))))
    assert len(colors_of(read)) == 4 and read.camera.fx == 30.0
    assert f'messages on {INFO_TOPIC} that state no camera are left out' in caplog.text
    (tmp_path / 'other').mkdir()
    with pytest.raises(CameraError, match=INFO_TOPIC):
        open_sequence(str(write(tmp_path / 'other' / 'bag', scene(make_info=lambda ns: info(ns, **bad)))))


def test_p_is_used_where_no_camera_info_has_k(tmp_path, caplog):
    read = open_sequence(str(write(tmp_path / 'bag', scene(make_info=lambda ns: info(ns, k=np.zeros(9), d=np.full(5, 0.1))))))
    assert read[0].camera.fx == 30.0 and np.array_equal(read[0].rgb, RGB)  # rectified already, whatever D says
    assert 'P is used, and the images are taken as rectified' in caplog.text


def test_p_is_not_used_where_another_camera_info_has_k(tmp_path, caplog):
    def other_p(ns):
        message = info(ns, k=np.zeros(9))
        message.p[0] = 99.0
        return message if ns == SECOND else info(ns)

    assert open_sequence(str(write(tmp_path / 'bag', scene(make_info=other_p))))[0].camera.fx == 30.0
    assert 'K is all zero' in caplog.text and 'P is used' not in caplog.text


def test_small_changes_of_the_camera_are_rectified_to_the_first(tmp_path):
    """As autofocus makes them. The first frame is as it is without, the others are magnified a little."""
    focal = {SECOND + i * PERIOD: 30.0 + 0.4 * i for i in range(4)}
    still = scene(make_color=color_of_squares)
    read = open_sequence(
        str(write(tmp_path / 'bag', scene(make_info=lambda ns: with_focal_length(focal[ns], ns), make_color=color_of_squares)))
    )
    plain = open_sequence(str(write(tmp_path / 'still', still)))
    frames = [read[i] for i in range(4)]
    assert {frame.camera for frame in frames} == {plain.camera}
    assert np.array_equal(frames[0].rgb, plain[0].rgb) and not np.array_equal(frames[3].rgb, plain[3].rgb)
    assert np.array_equal(read[3].rgb, frames[3].rgb) and np.array_equal(read[0].rgb, frames[0].rgb)  # in any order


def color_of_squares(stamp_ns):
    x = np.tile((np.arange(WIDTH) // 4 % 2 * 200).astype(np.uint8), (HEIGHT, 1))
    return images.color_message(FACTORY, np.dstack([x] * 3), stamp_ns, 'color')


def test_a_large_change_is_another_camera(tmp_path):
    bag = write(tmp_path / 'bag', scene(make_info=lambda ns: with_focal_length(30.0 if ns <= SECOND + PERIOD else 33.0, ns)))
    with pytest.raises(DatasetError, match=r'the camera changes at 1\.066000000 s'):
        open_sequence(str(bag))


@pytest.mark.parametrize('stray', [0, 2, 5])
@pytest.mark.parametrize('changes', [{'fx': 60.0}, {'size': (64, 48)}])
def test_one_camera_info_of_another_camera_costs_itself(tmp_path, caplog, stray, changes):
    """As for the node, which waits for a second message that says the same."""

    def make_info(ns):
        message = info(ns)
        if ns == SECOND + stray * PERIOD:
            message.k[0] = changes.get('fx', message.k[0])
            message.width, message.height = changes.get('size', (message.width, message.height))
        return message

    read = open_sequence(str(write(tmp_path / 'bag', scene(count=6, make_info=make_info))))
    assert {read[i].camera.fx for i in range(6)} == {30.0} and len(read) == 6
    assert f'1 messages on {INFO_TOPIC} state another camera than those before and after them, and are left out' in caplog.text


# --- stamps and pairs ---


@pytest.mark.parametrize('number', [0, 3, 5])
@pytest.mark.parametrize('off_ns', [86400 * SECOND, -3 * SECOND // 2])
def test_a_frame_with_a_wrong_stamp_costs_itself(tmp_path, caplog, number, off_ns):
    """As it does for the node. The last one a day ahead, or the first one too early, contradicts no other."""

    def stamped(make):
        return lambda ns: make(ns + (off_ns if ns == 2 * SECOND + number * PERIOD else 0))

    messages = scene(count=6, make_info=lambda ns: info(ns + SECOND), make_color=lambda ns: stamped(color)(ns + SECOND),
                     make_depth=lambda ns: stamped(depth)(ns + SECOND))  # fmt: skip
    read = open_sequence(str(write(tmp_path / 'bag', messages)))
    is_in_line = (number, off_ns > 0) in ((5, True), (0, False))
    frames = [read[index] for index in range(len(read))]
    assert len(frames) == 6 - (not is_in_line) and all((np.diff([frame.stamp_ns for frame in frames]) > 0).tolist())
    if not is_in_line:
        assert re.search(r'1 of 6 frames are skipped: .* its stamp is .* s from the frames around it', caplog.text)


def test_time_that_jumps_back_is_refused_where_two_frames_agree(tmp_path):
    messages = scene(count=6, make_color=lambda ns: color(ns + (ns < SECOND + 3 * PERIOD) * 9 * SECOND),
                     make_depth=lambda ns: depth(ns + (ns < SECOND + 3 * PERIOD) * 9 * SECOND))  # fmt: skip
    with pytest.raises(DatasetError, match='time does not increase from frame 2 .* to frame 3'):
        open_sequence(str(write(tmp_path / 'bag', messages)))


def test_depth_that_is_late_is_paired_by_the_rate(tmp_path, caplog):
    read = open_sequence(str(write(tmp_path / 'bag', scene(period=66 * MS, depth_late=30 * MS))))
    assert len(read) == 4
    assert 'depth is +0.030 s from its colour' in caplog.text and '--max-interval' in caplog.text


def test_nothing_pairs_tells_the_gap_and_the_option_that_helps(tmp_path):
    bag = str(write(tmp_path / 'bag', scene(count=1, depth_late=35 * MS)))
    with pytest.raises(
        DatasetError, match=r'nearest depth is \+0\.035 s from its colour \(median\): --max-interval (\S+)'
    ) as caught:
        open_sequence(bag)
    option = float(re.search(r'--max-interval (\S+)', str(caught.value))[1])
    assert len(open_sequence(bag, max_interval_s=option)) == 1
    for wrong in (-1.0, 11.0, float('nan')):
        with pytest.raises(DatasetError, match='max_interval'):
            open_sequence(bag, max_interval_s=wrong)


def test_a_small_interval_is_kept(tmp_path):
    bag = str(write(tmp_path / 'bag', scene(depth_late=10 * MS)))
    assert len(open_sequence(bag)) == 4
    with pytest.raises(DatasetError, match='within 9 ms'):
        open_sequence(bag, max_interval_s=0.009)


@pytest.mark.parametrize('topic', [RGB_TOPIC, DEPTH_TOPIC, None])
def test_images_that_nobody_stamped(tmp_path, topic):
    messages = scene()
    for name, _, message in messages:
        if topic in (None, name):
            message.header.stamp.sec = message.header.stamp.nanosec = 0
    bag = str(write(tmp_path / 'bag', messages))
    with pytest.raises(DatasetError, match=r'stamps on \S+ are equal .*: the driver does not stamp; .*--use-receive-time'):
        open_sequence(bag)
    read = open_sequence(bag, use_receive_time=True)
    assert [read[i].stamp_ns for i in range(len(read))] == [SECOND + i * PERIOD for i in range(4)]


def test_messages_with_damaged_stamps_cost_their_frames(tmp_path, caplog):
    messages = scene()
    messages[4][2].header.stamp.nanosec = 2**32 - 1
    read = open_sequence(str(write(tmp_path / 'bag', messages)))
    assert len(read) == 3
    assert np.array_equal(read[1].rgb, np.roll(RGB, 2, axis=1))  # the ones after it are still found
    assert f'1 messages on {RGB_TOPIC} are left out: the first stamp with sec' in caplog.text


@pytest.mark.parametrize('storage', STORAGES)
def test_damaged_messages_cost_their_frames(tmp_path, storage, caplog):
    messages = scene()
    messages[1] = (RGB_TOPIC, SECOND, color(SECOND))
    messages[4] = (*messages[4][:2], raw(messages[4][2])[:5].tobytes())  # no stamp
    messages[7] = (*messages[7][:2], raw(messages[7][2])[:50].tobytes())  # a stamp, no image
    messages[9] = (*messages[9][:2], raw(messages[9][2])[:40].tobytes())  # a camera info
    read = open_sequence(str(write(tmp_path / 'bag', messages, storage)))
    assert [pair.stamp_ns for pair in read._pairs] == [SECOND, SECOND + 2 * PERIOD, SECOND + 3 * PERIOD]
    assert np.array_equal(read[0].rgb, RGB) and np.array_equal(read[2].rgb, np.roll(RGB, 3, axis=1))
    with pytest.raises(FrameError, match=r'image at 1\.066000000 s'):
        read[1]
    assert 'has 5 bytes, too few for a header' in caplog.text


def test_a_first_image_that_is_damaged_does_not_hide_the_topic(tmp_path):
    messages = scene()
    with Writer(tmp_path / 'bag', version=9) as writer:
        by_topic = {topic: writer.add_connection(topic, message.__msgtype__, typestore=TYPES) for topic, _, message in messages[:3]}
        writer.write(by_topic[RGB_TOPIC], SECOND - 1, b'\0\1\0\0' + bytes(20))
        for topic, recorded_ns, message in messages:
            writer.write(by_topic[topic], recorded_ns, raw(message))
    assert len(open_sequence(str(tmp_path / 'bag'))) == 4


# --- images ---


def test_depth_of_another_frame_is_told_as_the_node_tells_it(tmp_path, caplog):
    read = open_sequence(str(write(tmp_path / 'bag', scene(make_depth=lambda ns: depth(ns, 'depth_optical')))))
    assert len(read) == 4
    assert "depth is in frame 'depth_optical', colour in 'color': depth must be registered to colour" in caplog.text


def test_depth_with_a_camera_of_its_own_is_told(tmp_path, caplog):
    def with_depth_camera(fx, width):
        message = with_focal_length(fx, SECOND)
        message.width, message.height, message.k[4] = width, width * 3 // 4, fx
        message.k[2], message.k[5] = (width - 1) / 2, (width * 3 // 4 - 1) / 2
        return [*scene(), ('/camera/depth/camera_info', SECOND, message)]

    open_sequence(str(write(tmp_path / 'same', with_depth_camera(15.0, 16))))  # the same view, half as large
    assert 'registered' not in caplog.text
    open_sequence(str(write(tmp_path / 'other', with_depth_camera(20.0, 32))))
    assert 'depth has a camera of its own' in caplog.text


def test_8uc3_is_read_as_bgr_with_a_warning_or_as_stated(tmp_path, caplog):
    bag = str(write(tmp_path / 'bag', scene(make_color=lambda ns: color(ns, encoding='8UC3'))))
    assert np.array_equal(open_sequence(bag)[0].rgb, RGB[..., ::-1])
    assert 'read as bgr8' in caplog.text and '--rgb-encoding' in caplog.text
    caplog.clear()
    assert np.array_equal(open_sequence(bag, rgb_encoding='rgb8')[0].rgb, RGB)
    assert 'read as' not in caplog.text
    with pytest.raises(DatasetError, match="rgb_encoding 'bgra8' is not one of"):
        open_sequence(bag, rgb_encoding='bgra8')
    with pytest.raises(DatasetError, match='leave that option out'):
        open_sequence('synthetic', rgb_encoding='rgb8')


@pytest.mark.parametrize('orientation', [3, 6])
def test_pixels_are_read_as_stored(tmp_path, orientation):
    def jpeg(stamp_ns):
        data = cv2.imencode('.jpg', cv2.GaussianBlur(RGB, (0, 0), 3)[..., ::-1])[1].tobytes()
        exif = b'Exif\0\0II*\0\x08\0\0\0' + struct.pack('<HHHIII', 1, 0x112, 3, 1, orientation, 0)
        data = data[:2] + b'\xff\xe1' + struct.pack('>H', len(exif) + 2) + exif + data[2:]
        header = color(stamp_ns).header
        return FACTORY.make('sensor_msgs/msg/CompressedImage', header=header, format='jpeg', data=np.frombuffer(data, np.uint8))

    frame = open_sequence(str(write(tmp_path / 'bag', scene(make_color=jpeg))))[0]
    assert np.abs(frame.rgb.astype(int) - cv2.GaussianBlur(RGB, (0, 0), 3)).mean() < 8


def test_infrared_beside_colour_is_not_mistaken_for_it(tmp_path):
    infrared = [('/camera/infra1/image_rect_raw', SECOND, images.mono_message(FACTORY, RGB[..., 0], SECOND, 'infra'))]
    assert len(open_sequence(str(write(tmp_path / 'bag', scene() + infrared)))) == 4


# --- files ---


@pytest.mark.parametrize('storage', STORAGES)
@pytest.mark.parametrize('profiles', ['', 'no yaml: [', 3, None, [{'history': 1}]])
def test_quality_of_service_is_not_needed_to_read(tmp_path, whole, storage, profiles):
    bag = write(tmp_path / 'bag', scene(), storage)
    content = yaml.safe_load((bag / 'metadata.yaml').read_text())
    for topic in content['rosbag2_bagfile_information']['topics_with_message_count']:
        topic['topic_metadata']['offered_qos_profiles'] = profiles
    (bag / 'metadata.yaml').write_text(yaml.safe_dump(content))
    assert colors_of(open_sequence(str(bag))) == whole


@pytest.mark.parametrize('mode', [CompressionMode.MESSAGE, CompressionMode.FILE])
def test_compressed_bags_and_their_bare_files(tmp_path, whole, mode):
    bag = write(tmp_path / 'bag', scene(), compress=mode)
    assert colors_of(open_sequence(str(bag))) == whole
    bare = shutil.copy(file_of(bag), tmp_path / file_of(bag).name)
    assert colors_of(open_sequence(str(bare))) == whole
    (bag / 'metadata.yaml').unlink()
    assert colors_of(open_sequence(str(bag))) == whole


def test_a_compressed_file_is_unpacked_once_and_removed(tmp_path, whole, monkeypatch):
    bag = write(tmp_path / 'bag', scene(), compress=CompressionMode.FILE)
    temporary = tmp_path / 'tmp'
    temporary.mkdir()
    monkeypatch.setattr(tempfile, 'tempdir', str(temporary))
    first, second = open_sequence(str(bag)), open_sequence(str(bag))
    assert colors_of(first) == colors_of(second) == whole
    assert len(list(temporary.iterdir())) == 1
    del first, second
    unpacked._unpacked.cache_clear()
    gc.collect()
    assert list(temporary.iterdir()) == []


def test_a_compressed_file_is_not_unpacked_where_there_is_no_space(tmp_path, monkeypatch):
    bag = write(tmp_path / 'bag', scene(), compress=CompressionMode.FILE)
    monkeypatch.setattr(unpacked, 'RESERVE', 10**18)
    with pytest.raises(DatasetError, match='GB free; set TMPDIR to a folder with space') as caught:
        open_sequence(str(bag))
    assert '\n' not in str(caught.value) and str(file_of(bag)) in str(caught.value)


def test_a_damaged_compressed_message_costs_its_frame(tmp_path, caplog):
    bag = write(tmp_path / 'bag', scene(), compress=CompressionMode.MESSAGE)
    with sqlite3.connect(file_of(bag)) as database:
        ids = [row[0] for row in database.execute('SELECT id FROM messages ORDER BY id')]
        (data,) = database.execute('SELECT data FROM messages WHERE id = ?', (ids[4],)).fetchone()
        database.execute('UPDATE messages SET data = ? WHERE id = ?', (data[: len(data) // 2], ids[4]))
    assert len(colors_of(open_sequence(str(bag)))) == 3
    assert 'are left out: the first has 0 bytes' in caplog.text


@pytest.mark.parametrize('storage', STORAGES)
def test_splits_without_metadata_are_read_in_order(tmp_path, whole, storage, caplog):
    bag = tmp_path / 'bag'
    bag.mkdir()
    messages = scene()
    for part, chosen in ((10, messages[:6]), (9, messages[6:])):
        shutil.move(file_of(write(tmp_path / f'part{part}', chosen, storage)), bag / f'bag_{part}{file_of_suffix(storage)}')
    assert colors_of(open_sequence(str(bag))) == whole
    assert 'there is no metadata.yaml, the recording was not closed; reading bag_10' in caplog.text


def test_a_folder_that_is_no_bag_is_not_taken_for_an_open_one(tmp_path):
    (tmp_path / 'rgb').mkdir()
    with pytest.raises(DatasetError, match=r'cannot be read as a rosbag2: it holds no \.db3 or \.mcap file$'):
        Recording(tmp_path)


def file_of_suffix(storage):
    return {'sqlite3': '.db3', 'mcap': '.mcap'}[storage]


def test_splits_that_overlap_are_merged_by_time(tmp_path, whole):
    bag = tmp_path / 'bag'
    bag.mkdir()
    messages = scene()
    shutil.move(file_of(write(tmp_path / 'a', [m for m in messages if m[0] == RGB_TOPIC])), bag / 'a.db3')
    shutil.move(file_of(write(tmp_path / 'b', [m for m in messages if m[0] != RGB_TOPIC])), bag / 'b.db3')
    read = open_sequence(str(bag))
    assert colors_of(read) == whole
    with Recording(bag) as recording:
        times = [message.time_ns for message in recording.messages([RGB_TOPIC, DEPTH_TOPIC, INFO_TOPIC])]
    assert times == sorted(times)


def test_a_missing_or_renamed_split_is_told_and_the_rest_read(tmp_path, whole, caplog):
    bag = write(tmp_path / 'bag', scene())
    metadata = (bag / 'metadata.yaml').read_text()
    (bag / 'metadata.yaml').write_text(metadata.replace('- bag.db3', '- bag.db3\n  - bag_1.db3'))
    assert colors_of(open_sequence(str(bag))) == whole
    assert 'files that metadata.yaml names are missing: bag_1.db3' in caplog.text
    (bag / 'metadata.yaml').write_text(metadata.replace('- bag.db3', '- before.db3'))
    assert colors_of(open_sequence(str(bag))) == whole
    (bag / 'bag.db3').unlink()
    with pytest.raises(DatasetError, match=r'files are missing: before\.db3'):
        open_sequence(str(bag))


@pytest.mark.parametrize('text', ['', '{}', 'rosbag2_bagfile_information: 3', ': :\n -', '[' * 3000, BOMB])
def test_damaged_metadata_beside_whole_files(tmp_path, whole, text, caplog):
    bag = write(tmp_path / 'bag', scene())
    (bag / 'metadata.yaml').write_text(text)
    assert colors_of(open_sequence(str(bag))) == whole
    assert 'metadata.yaml is damaged' in caplog.text


def test_names_and_profiles_that_unfold_to_gigabytes_are_not_read(tmp_path, whole):
    bag = write(tmp_path / 'bag', scene())
    content = yaml.safe_load((bag / 'metadata.yaml').read_text())
    for topic in content['rosbag2_bagfile_information']['topics_with_message_count']:
        topic['topic_metadata']['offered_qos_profiles'] = BOMB
    (bag / 'metadata.yaml').write_text(yaml.safe_dump(content))
    assert colors_of(open_sequence(str(bag))) == whole


def test_a_file_that_is_no_bag_beside_others_is_left_out(tmp_path, whole, caplog):
    bag = write(tmp_path / 'bag', scene())
    (bag / 'metadata.yaml').unlink()
    (bag / 'bag_1.db3').write_bytes(b'version https://git-lfs.github.com/spec/v1\n' * 30)
    assert colors_of(open_sequence(str(bag))) == whole
    assert 'a file cannot be read and is left out: bag_1.db3' in caplog.text


def long_scene():
    """Enough for several chunks of MCAP and many pages of SQLite."""
    return [(topic, ns, message) for topic, ns, message in scene(count=500)]


@pytest.mark.parametrize('storage', STORAGES)
@pytest.mark.parametrize('kept', [0.7, 0.8, 0.999])
def test_what_is_whole_of_a_cut_recording_is_read(tmp_path, storage, kept, caplog):
    bag = write(tmp_path / 'bag', long_scene(), storage)
    file, size = file_of(bag), file_of(bag).stat().st_size
    os.truncate(file, int(kept * size))
    for source in (bag, file):
        caplog.clear()
        read = open_sequence(str(source))
        assert 500 * kept - 240 < len(read) <= 500  # a chunk of MCAP holds a megabyte
        assert np.array_equal(read[len(read) - 1].rgb, np.roll(RGB, len(read) - 1, axis=1))
        assert np.array_equal(read[3].rgb, np.roll(RGB, 3, axis=1))
        assert f'{file.name} is cut or damaged' in caplog.text


def test_a_damaged_chunk_in_the_middle_costs_its_messages(tmp_path, caplog):
    bag = write(tmp_path / 'bag', long_scene(), 'mcap', CompressionMode.STORAGE)
    data = bytearray(file_of(bag).read_bytes())
    middle = len(data) // 2
    data[middle : middle + 64] = bytes(64)
    file_of(bag).write_bytes(data)
    read = open_sequence(str(bag))
    assert 100 < len(read) < 500
    assert len({read[i].stamp_ns for i in range(len(read))}) == len(read)
    assert 'damaged chunks is missing' in caplog.text


ROS1_COMPRESSIONS = [None, *rosbag1.Writer.CompressionFormat]


def write_ros1(path, messages, compression=None):
    """The recording as ROS 1 would have written it, with a chunk for each second."""
    ros1 = get_typestore(Stores.ROS1_NOETIC)
    writer = rosbag1.Writer(path)
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        connections = {}
        for topic, recorded_ns, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=ros1)
            data = TYPES.cdr_to_ros1(bytes(raw(message)), message.__msgtype__)
            writer.write(connections[topic], recorded_ns, data)
    return path


@pytest.mark.parametrize('compression', ROS1_COMPRESSIONS)
@pytest.mark.parametrize('kept', [0.5, 0.999])
def test_what_is_whole_of_a_cut_ros1_bag_is_read(tmp_path, compression, kept, caplog):
    """It used to be refused: its index is at the end."""
    bag = write_ros1(tmp_path / 'old.bag', long_scene(), compression)
    whole = colors_of(open_sequence(str(bag)))
    assert len(whole) == 500 and not caplog.records
    os.truncate(bag, int(kept * bag.stat().st_size))
    read = colors_of(open_sequence(str(bag)))
    assert 500 * kept - 240 < len(read) <= 500  # a chunk holds a megabyte
    assert read == whole[: len(read)]
    assert 'old.bag is cut or damaged' in caplog.text


@pytest.mark.parametrize('compression', ROS1_COMPRESSIONS)
def test_a_damaged_chunk_of_a_ros1_bag_costs_its_messages(tmp_path, compression, caplog):
    bag = write_ros1(tmp_path / 'old.bag', long_scene(), compression)
    data = bytearray(bag.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 9000] = bytes(9000)  # longer than a message
    bag.write_bytes(data)
    read = open_sequence(str(bag))
    assert 100 < len(read) < 500
    assert len({read[i].stamp_ns for i in range(len(read))}) == len(read)
    assert 'cut or damaged' in caplog.text


def test_an_mcap_file_without_chunks_that_was_not_closed(tmp_path, whole, caplog):
    """As rosbag2's profile 'fastwrite' writes it."""

    def text(value):
        return struct.pack('<I', len(value)) + value.encode()

    def record(kind, content):
        return struct.pack('<BQ', kind, len(content)) + content

    content = b'\x89MCAP0\r\n' + record(1, text('ros2') + text('x'))
    known = []
    for topic, recorded_ns, message in scene():
        if topic not in known:
            known.append(topic)
            number = struct.pack('<H', len(known))
            content += record(3, number + text(message.__msgtype__) + text('ros2msg') + text(''))
            content += record(4, number + number + text(topic) + text('cdr') + struct.pack('<I', 0))
        times = struct.pack('<HIQQ', known.index(topic) + 1, 0, recorded_ns, recorded_ns)
        content += record(5, times + bytes(raw(message)))
    (tmp_path / 'cut.mcap').write_bytes(content + content[-999:-500])
    assert colors_of(open_sequence(str(tmp_path / 'cut.mcap'))) == whole
    assert 'cut.mcap is cut or damaged' in caplog.text


def test_the_last_messages_of_a_killed_recording_are_in_its_journal(tmp_path, whole):
    bag = write(tmp_path / 'bag', scene())
    killed = tmp_path / 'killed.db3'
    database = sqlite3.connect(tmp_path / 'live.db3')
    database.execute('PRAGMA journal_mode=WAL')
    database.execute('PRAGMA wal_autocheckpoint=0')
    source = sqlite3.connect(file_of(bag))
    database.executescript('\n'.join(source.iterdump()))
    database.commit()
    for suffix in ('', '-wal'):
        shutil.copy(tmp_path / f'live.db3{suffix}', f'{killed}{suffix}')
    database.close()
    assert colors_of(open_sequence(str(killed))) == whole
    assert sorted(path.name for path in tmp_path.iterdir() if path.name.startswith('killed')) == ['killed.db3', 'killed.db3-wal']


# --- RealSense Viewer ---

VIEWER_COLOR, VIEWER_DEPTH = '/device_0/sensor_1/Color_0', '/device_0/sensor_0/Depth_0'


def write_viewer_bag(path, *, extra=b'', unit=None, depth_fx=30.0, infrared=False):
    """A recording as RealSense Viewer makes it: ROS 1, topics of its own, camera infos once at time 0."""
    store = get_typestore(Stores.ROS1_NOETIC)
    types = store.types

    def header(number, ns):
        return types['std_msgs/msg/Header'](number, types['builtin_interfaces/msg/Time'](ns // SECOND, ns % SECOND), '1')

    def camera(fx):
        k = np.array([fx, 0, 15.5, 0, 30.5 * fx / 30, 11.5, 0, 0, 1])
        region = types['sensor_msgs/msg/RegionOfInterest'](0, 0, 0, 0, False)
        return types['sensor_msgs/msg/CameraInfo'](
            header(0, 0), HEIGHT, WIDTH, 'Inverse Brown Conrady', np.zeros(5), k, np.zeros(9), np.zeros(12), 0, 0, region
        )

    with rosbag1.Writer(path) as writer:
        for name, fx in ((VIEWER_COLOR, 30.0), (VIEWER_DEPTH, depth_fx)):
            connection = writer.add_connection(f'{name}/info/camera_info', 'sensor_msgs/msg/CameraInfo', typestore=store)
            writer.write(connection, 1, store.serialize_ros1(camera(fx), 'sensor_msgs/msg/CameraInfo'))
        if unit is not None:
            topic = '/device_0/sensor_0/option/Depth_Units/value'
            connection = writer.add_connection(topic, 'std_msgs/msg/Float32', typestore=store)
            writer.write(connection, 1, store.serialize_ros1(types['std_msgs/msg/Float32'](unit), 'std_msgs/msg/Float32'))
        streams = [(VIEWER_COLOR, RGB, 'rgb8'), (VIEWER_DEPTH, np.full((HEIGHT, WIDTH), 1250, np.uint16), 'mono16')]
        streams += [('/device_0/sensor_0/Infrared_1', RGB[..., 0], 'mono8')] if infrared else []
        for name, pixels, encoding in streams:
            connection = writer.add_connection(f'{name}/image/data', 'sensor_msgs/msg/Image', typestore=store)
            for i in range(4):
                stamp = 10**18 + i * PERIOD
                data = np.frombuffer(pixels.tobytes(), np.uint8)
                message = types['sensor_msgs/msg/Image'](header(i, stamp), HEIGHT, WIDTH, encoding, 0, pixels.strides[0], data)
                writer.write(connection, stamp, bytes(store.serialize_ros1(message, 'sensor_msgs/msg/Image')) + extra)
    return str(path)


@pytest.mark.parametrize(
    ('options', 'metres'),
    [
        ({}, 1.25), ({'extra': np.float32(0.001).tobytes()}, 1.25), ({'extra': np.float32(0.0001).tobytes()}, 0.125),
        ({'unit': 0.00025}, 0.3125), ({'extra': b'abc'}, 1.25), ({'extra': b'\xff' * 4}, 1.25), ({'infrared': True}, 1.25),
    ],
)  # fmt: skip
def test_recordings_of_realsense_viewer(tmp_path, options, metres, caplog):
    read = open_sequence(write_viewer_bag(tmp_path / 'viewer.bag', **options))
    assert len(read) == 4 and np.array_equal(read[3].rgb, RGB)
    assert np.allclose(read[0].depth_m, metres, rtol=1e-6)
    assert 'registered' not in caplog.text


def test_depth_of_realsense_viewer_is_not_registered(tmp_path, caplog):
    assert len(open_sequence(write_viewer_bag(tmp_path / 'viewer.bag', depth_fx=20.0))) == 4
    assert 'depth must be registered to colour, and this is not' in caplog.text and 'Viewer' in caplog.text


# --- infos before a time ---


@pytest.mark.parametrize('storage', STORAGES)
def test_the_last_message_before_a_time(tmp_path, storage):
    messages = [(INFO_TOPIC, i * 10 * SECOND, info(i)) for i in range(1, 6)] + [('/once', SECOND, info(0))] + scene()
    with Recording(write(tmp_path / 'bag', messages, storage)) as recording:
        found = recording.last_before([INFO_TOPIC, '/once'], 40 * SECOND)
        assert {message.topic: message.time_ns for message in found} == {INFO_TOPIC: 30 * SECOND, '/once': SECOND}
        assert recording.last_before([INFO_TOPIC], SECOND) == []
