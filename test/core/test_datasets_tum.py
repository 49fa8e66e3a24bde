"""The TUM RGB-D reader, on generated folders and on the real recording."""

from __future__ import annotations

import re
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatam_core.datasets import tum
from splatam_core.datasets.camera_file import read_camera_file
from splatam_core.datasets.registry import open_sequence
from splatam_core.datasets.tum import KNOWN_CAMERAS, associate
from splatam_core.errors import CameraError, DatasetError, FrameError
from splatam_core.geometry.camera import CameraCalibration, PinholeCamera

CAMERA_YAML = 'width: 64\nheight: 48\nfx: 50\nfy: 51\ncx: 31.5\ncy: 23.5\n'
BASE = 1305031000


def write_tum(folder: Path, rgb_s: list[float], depth_s: list[float], *, camera: str | None = CAMERA_YAML) -> Path:
    """Write 64x48 images: all pixels of colour image i are (10 i, 20, 30), those of depth image j are 5000 + 50 j counts."""
    for name in ('rgb', 'depth'):
        (folder / name).mkdir(parents=True)
    lists = {'rgb': ['# color images', '# timestamp filename'], 'depth': ['# depth maps', '']}
    for i, seconds in enumerate(rgb_s):
        image = np.broadcast_to(np.uint8([30, 20, 10 * i]), (48, 64, 3))  # OpenCV's order: blue first
        cv2.imwrite(str(folder / f'rgb/{i}.png'), image)
        lists['rgb'].append(f'{BASE + seconds:.6f} rgb/{i}.png')
    for j, seconds in enumerate(depth_s):
        cv2.imwrite(str(folder / f'depth/{j}.png'), np.full((48, 64), 5000 + 50 * j, np.uint16))
        lists['depth'].append(f'{BASE + seconds:.6f} depth/{j}.png')
    for name, lines in lists.items():
        (folder / f'{name}.txt').write_text('\n'.join(lines) + '\n')
    if camera is not None:
        (folder / 'camera.yaml').write_text(camera)
    return folder


def test_frames_have_colour_stamp_rgb_order_and_metres(tmp_path):
    folder = write_tum(tmp_path / 'mine', [1.0, 1.033333, 1.066667], [1.01, 1.04, 1.07])
    sequence = open_sequence(str(folder))
    frame = sequence[2]
    assert len(sequence) == 3
    assert sequence.name == 'mine'
    assert frame.stamp_ns == BASE * 10**9 + 1_066_667_000  # exact: the text is decimal, not a float
    assert frame.rgb[5, 7].tolist() == [20, 20, 30]
    assert np.all(frame.depth_m == np.float32(5100) / np.float32(5000))
    assert frame.depth_m.dtype == np.float32
    assert (sequence.camera.width, sequence.camera.fx, sequence.depth_scale) == (64, 50.0, 5000.0)
    assert sequence.ground_truth() is None


def test_each_depth_is_used_once_by_the_nearest_colour(tmp_path):
    # colour 0 and 1 both have depth 0 within reach; 1 is nearer. Colour 2 has none within 20 ms.
    folder = write_tum(tmp_path, [1.0, 1.01, 1.2], [1.012, 1.3])
    sequence = tum.read(folder)
    assert [sequence[i].rgb[0, 0, 0] for i in range(len(sequence))] == [10]


def test_associate_takes_second_best_when_the_best_is_taken():
    a, b = np.array([0, 10, 100]), np.array([9, 25])
    assert associate(a, b, 20) == [(1, 0)]  # 0 would reach 9 only, which is 10's
    assert associate(a, b, 30) == [(0, 1), (1, 0)]


@pytest.mark.parametrize(('interval', 'pairs'), [(20, [(0, 0)]), (19, [])])
def test_associate_limit_is_inclusive(interval, pairs):
    assert associate(np.array([0]), np.array([20]), interval) == pairs


def test_nothing_pairs(tmp_path):
    with pytest.raises(DatasetError, match='none of 1 colour and 1 depth images are within 20 ms.*--max-interval 1.001 pairs them'):
        tum.read(write_tum(tmp_path, [1.0], [2.0]))
    with pytest.raises(DatasetError, match='are their clocks the same'):
        tum.read(write_tum(tmp_path / 'other', [1.0], [200.0]))


@pytest.mark.parametrize(('period_s', 'late_s'), [(0.066, 0.032), (0.2, 0.045)])
def test_depth_that_is_late_is_paired_by_the_rate(tmp_path, period_s, late_s):
    stamps = [1.0 + period_s * i for i in range(4)]
    assert len(tum.read(write_tum(tmp_path, stamps, [stamp + late_s for stamp in stamps]))) == 4


def test_an_interval_can_be_stated(tmp_path, caplog):
    """It used to be refused: 'colour and depth are not paired by stamps'."""
    folder = write_tum(tmp_path, [1.0, 1.4, 1.8], [1.06, 1.45, 1.84])
    with pytest.raises(DatasetError, match=r'\+0.050 s from its colour \(median\): --max-interval 0.051 pairs them'):
        open_sequence(str(folder), max_interval_s=0.03)
    assert len(open_sequence(str(folder), max_interval_s=0.051)) == 2
    lines = zip((folder / 'rgb.txt').read_text().splitlines(), (folder / 'depth.txt').read_text().splitlines(), strict=True)
    (folder / 'associations.txt').write_text('\n'.join(f'{rgb} {depth}' for rgb, depth in lines))
    for name in ('rgb.txt', 'depth.txt'):
        (folder / name).unlink()
    assert len(open_sequence(str(folder))) == 3  # pairs that somebody states
    assert len(open_sequence(str(folder), max_interval_s=0.051)) == 2 and '1 of 3 pairs are more than 51 ms apart' in caplog.text
    with pytest.raises(DatasetError, match='3 of 3 pairs are more than 30 ms apart; the nearest depth is'):
        open_sequence(str(folder), max_interval_s=0.03)


@pytest.mark.parametrize(
    ('name', 'number'),
    [('rgbd_dataset_freiburg1_xyz', '1'), ('rgbd_dataset_freiburg2_desk', '2'), ('tum_fr3_office', '3')],
)
def test_known_camera_by_folder_name(tmp_path, name, number):
    folder = write_tum(tmp_path / name, [1.0], [1.0], camera=None)
    with pytest.raises(DatasetError, match=r'rgb/0\.png: is 64x48, but the camera is for 640x480 images'):
        tum.read(folder)
    cv2.imwrite(str(folder / 'rgb/0.png'), np.zeros((480, 640, 3), np.uint8))
    assert tum.read(folder).camera == KNOWN_CAMERAS[number].pinhole


def test_camera_yaml_wins_over_folder_name(tmp_path):
    folder = write_tum(tmp_path / 'freiburg1', [1.0], [1.0], camera=CAMERA_YAML + 'depth_scale: 1000\n')
    sequence = tum.read(folder)
    assert sequence.camera.fx == 50.0
    assert sequence.depth_scale == 1000.0
    assert np.all(sequence[0].depth_m == 5.0)


@pytest.mark.parametrize('name', ['mine', 'fr10_hall', 'afr1'])
def test_unknown_camera_says_what_to_do(tmp_path, name):
    with pytest.raises(DatasetError, match=r'camera is unknown.*put a camera\.yaml'):
        tum.read(write_tum(tmp_path / name, [1.0], [1.0], camera=None))


def test_broken_camera_yaml(tmp_path):
    with pytest.raises(CameraError, match=r'camera\.yaml: missing cx, cy, fy'):
        tum.read(write_tum(tmp_path, [1.0], [1.0], camera='width: 64\nheight: 48\nfx: 50\n'))


ROS_CALIBRATION = """
image_width: 64
image_height: 48
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [50., 0., 31.5, 0., 51., 23.5, 0., 0., 1.]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.1, -0.2, 0., 0., 0.]
rectification_matrix: {rows: 3, cols: 3, data: [1., 0., 0., 0., 1., 0., 0., 0., 1.]}
projection_matrix: {rows: 3, cols: 4, data: [50., 0., 31.5, 0., 0., 51., 23.5, 0., 0., 0., 1., 0.]}
"""


def test_a_calibration_of_ros_is_read(tmp_path):
    path = tmp_path / 'camera.yaml'
    path.write_text(ROS_CALIBRATION + 'depth_scale: 1000\n')
    read = read_camera_file(path)
    assert read.calibration == CameraCalibration(PinholeCamera(64, 48, 50, 51, 31.5, 23.5), 'plumb_bob', (0.1, -0.2, 0.0, 0.0, 0.0))
    assert read.depth_scale == 1000


@pytest.mark.parametrize(
    ('before', 'after', 'message'),
    [
        ('50., 0., 31.5, 0., 51., 23.5, 0., 0., 1.', '50., 51.', 'missing cx, cy, fx, fy'),
        ('image_width: 64', 'image_width: x', "could not convert string to float: 'x'"),
        ('image_width: 64', '', 'missing width'),
        ('camera_name', 'camera_nam', 'unknown camera_nam'),
        ('[0.1, -0.2, 0., 0., 0.]', '[[1], 2]', 'list'),
        ('50., 0., 31.5, 0., 51.', '{}, [], 3, 4, 5', 'dict'),
    ],
)  # fmt: skip
def test_a_damaged_calibration_of_ros_is_one_error(tmp_path, before, after, message):
    path = tmp_path / 'camera.yaml'
    path.write_text(ROS_CALIBRATION.replace(before, after, 1))
    with pytest.raises(CameraError, match=message):
        read_camera_file(path)


@pytest.mark.parametrize(
    ('line', 'message'),
    [
        ('abc rgb/0.png', r"rgb\.txt:1: expected 'stamp path', got 'abc rgb/0\.png'"),
        ('1.5', r"rgb\.txt:1: expected 'stamp path'"),
        ('\n'.join(f'1.0 rgb/{index}.png' for index in range(8)), 'stamps must differ, but 7 of 8 are there already'),
        ('# stamp path', r'rgb\.txt: no image in it; expected lines with stamp and path'),
        ('1.0 rgb/0.png\nx\n' * 4, r"rgb\.txt:2: expected 'stamp path', got 'x'"),
    ],
)
def test_broken_list(tmp_path, line, message):
    folder = write_tum(tmp_path, [1.0], [1.0])
    (folder / 'rgb.txt').write_text(line)
    with pytest.raises(DatasetError, match=message):
        tum.read(folder)


TIMES_S = [1 + 0.03 * index for index in range(20)]
ROWS = [f'{BASE + seconds:.2f} rgb/{index}.png' for index, seconds in enumerate(TIMES_S)]
SORTED = 'the lines are not in the order of their stamps, and are sorted'


@pytest.mark.parametrize(
    ('lines', 'missing', 'said'),
    [
        (ROWS[::-1], None, SORTED),
        ([*ROWS[10:], *ROWS[:10]], None, SORTED),
        (
            [*ROWS[:5], ROWS[4].replace('/4', '/9'), *ROWS[5:]],
            None,
            '1 of 21 lines have a stamp that is there already and are left out',
        ),
        ([*ROWS[:5], 'torn', *ROWS[6:]], 5, r"rgb\.txt:6: expected 'stamp path', got 'torn'; of 20 lines 1 are left out"),
        ([*ROWS[:19], '1.5'], 19, r"rgb\.txt:20: expected 'stamp path', got '1\.5'; of 20 lines 1 are left out"),
        (['timestamp filename', *ROWS], None, ''),
        ([row.replace(' ', ',') for row in ROWS], None, ''),
        ([row.replace(' ', '; ') for row in ROWS], None, ''),
        ([row.replace(' ', ' "') + '"' for row in ROWS], None, ''),
    ],
)
def test_lists_that_people_write(tmp_path, caplog, lines, missing, said):
    """Single lines cost themselves; their order is that of the stamps."""
    folder = write_tum(tmp_path, TIMES_S, TIMES_S)
    (folder / 'rgb.txt').write_text('\n'.join(lines) + '\n')
    read = tum.read(folder)
    assert [int(read[index].rgb[0, 0, 0]) // 10 for index in range(len(read))] == [i for i in range(20) if i != missing]
    assert re.search(said, caplog.text) if said else not caplog.records


@pytest.mark.parametrize('is_turned', [False, True])
def test_associations_that_people_write(tmp_path, caplog, is_turned):
    folder = write_tum(tmp_path, TIMES_S, TIMES_S)
    (folder / 'rgb.txt').unlink()
    rows = [f'{seconds:.2f},rgb/{index}.png,{seconds:.2f},depth/{index}.png' for index, seconds in enumerate(TIMES_S)]
    (folder / 'associations.txt').write_text('\n'.join([*rows[::-1], 'torn'] if is_turned else rows))
    assert len(tum.read(folder)) == 20
    assert (SORTED in caplog.text) == ("got 'torn'" in caplog.text) == is_turned


def cut(path, length):
    path.write_bytes(path.read_bytes()[:length])


@pytest.mark.parametrize(
    ('damage', 'message'),
    [
        (lambda folder: (folder / 'rgb/1.png').unlink(), r'rgb/1\.png: cannot be read: No such file'),
        (
            lambda folder: (folder / 'rgb/1.png').write_bytes((folder / 'rgb/2.png').read_bytes()[:20]),
            r'rgb/1\.png: is not an image',
        ),
        (
            lambda folder: (folder / 'rgb/1.png').write_bytes((folder / 'rgb/2.png').read_bytes()[:60]),
            r'rgb/1\.png: is damaged, or cut off after 60 bytes',
        ),
        (lambda folder: cv2.imwrite(str(folder / 'depth/1.png'), np.zeros((48, 64, 3), np.uint8)), '16 bits'),
    ],
)
def test_missing_and_broken_images_cost_one_frame(tmp_path, damage, message):
    folder = write_tum(tmp_path, [1.0, 2.0, 3.0], [1.0, 2.0, 3.0])
    damage(folder)
    sequence = tum.read(folder)
    with pytest.raises(FrameError, match=message):
        sequence[1]
    assert sequence[0].depth_m.any() and sequence[2].depth_m.any()


def by_trying_all_pairs(a, b, interval):
    """Pairs as ``associate`` states them: nearest first, each stamp once."""
    near = sorted((abs(x - y), i, j) for i, x in enumerate(a) for j, y in enumerate(b) if abs(x - y) <= interval)
    pairs: dict[int, int] = {}
    for _, i, j in near:
        if i not in pairs and j not in pairs.values():
            pairs[i] = j
    return sorted(pairs.items())


@pytest.mark.parametrize('spread', [15, 30, 100])
def test_associate_equals_trying_all_pairs(spread):
    rng = np.random.default_rng(spread)
    for _ in range(1000):
        a, b = (np.sort(rng.choice(spread, rng.integers(0, 12), replace=False)).astype(np.int64) for _ in range(2))
        interval = int(rng.integers(0, 12))
        assert associate(a, b, interval) == by_trying_all_pairs(a.tolist(), b.tolist(), interval)


def test_near_stamps_take_no_quadratic_time_or_memory():
    """These lists have 400 million pairs within 20 ms of each other, which would fill the memory."""
    stamps = np.arange(20_000, dtype=np.int64) * 10
    assert associate(stamps, stamps + 3, 20_000_000) == [(i, i) for i in range(20_000)]


def test_broken_truth_is_an_error_not_a_missing_truth(tmp_path):
    folder = write_tum(tmp_path, [1.0], [1.0])
    (folder / 'groundtruth.txt').write_text('1.0 0 0 0\n')
    with pytest.raises(DatasetError, match=r'groundtruth\.txt:1'):
        tum.read(folder).ground_truth()


def test_real_recording(recording):
    sequence = open_sequence(str(recording('tum_fr1_rpy')), width=320, max_frames=3)
    frame, truth = sequence[1], sequence.ground_truth()
    assert (frame.stamp_ns, frame.rgb.shape, frame.depth_m.shape) == (1305031235561675000, (240, 320, 3), (240, 320))
    assert sequence.camera.fx == pytest.approx(517.306408 / 2)
    assert 0.5 < (frame.depth_m > 0).mean() < 1.0
    # 60 deg/s would turn the view by 2 degrees in a frame: truth must bracket the frames closely
    assert truth.stamps_ns[0] < sequence[0].stamp_ns < truth.stamps_ns[-1]
    assert len(truth) > 900


def test_real_recording_is_the_known_camera(recording):
    folder = recording('tum_fr1_rpy')
    stated = KNOWN_CAMERAS['1']
    assert tum.read(folder).camera == stated.pinhole  # its camera.yaml states what the table states


@pytest.mark.parametrize('distortion', ['', 'distortion_model: plumb_bob\ndistortion: [0.1, 0, 0, 0, 0]\n'])
def test_reading_a_frame_keeps_each_image_twice_at_most(tmp_path: Path, distortion: str) -> None:
    """Memory that is taken in between is partly lost: frames that wait have their places between what went."""
    width, height = 640, 480
    camera = f'width: {width}\nheight: {height}\nfx: 600\nfy: 600\ncx: 320\ncy: 240\n{distortion}'
    sequence_folder = write_tum(tmp_path / 'sequence', [0, 1], [0, 1], camera=camera)
    for image in sequence_folder.glob('*/*.png'):
        cv2.imwrite(str(image), cv2.resize(cv2.imread(str(image), cv2.IMREAD_UNCHANGED), (width, height)))
    sequence = tum.read(sequence_folder, width=width)
    assert sequence[0].depth_m.any()  # what is made once
    tracemalloc.start()
    frame = sequence[1]
    kept, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert frame.rgb.nbytes + frame.depth_m.nbytes <= kept < 1.1 * (frame.rgb.nbytes + frame.depth_m.nbytes)
    assert peak < 17 * width * height  # colour and depth twice are 14 bytes a pixel, and two masks of readings
