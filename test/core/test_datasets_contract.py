"""The contract of all readers, tested on a small copy of every layout (``dataset_layouts``)."""

from __future__ import annotations

import importlib.util
import json
import logging
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from dataset_layouts import CAMERA, COLOR_CAMERA, FLIP_Y_AND_Z, LAYOUTS, SHOTS, Layout, camera_yaml, rows, shoot

from splatam_core.cli import main
from splatam_core.datasets import icl, replica, replica_v2
from splatam_core.datasets.base import FIRST_STAMP_NS
from splatam_core.datasets.registry import READERS, _reader, open_sequence
from splatam_core.errors import CameraError, DatasetError, FrameError
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera

SECOND = 1_000_000_000
JPEG_ERROR = 6  # grey levels


@pytest.fixture(params=LAYOUTS)
def name(request: pytest.FixtureRequest) -> str:
    if request.param == 'record3d' and importlib.util.find_spec('OpenEXR') is None:
        pytest.skip("record3d needs OpenEXR: pip install 'splatam_ros[exr]'")
    return request.param


@pytest.fixture
def layout(name: str) -> Layout:
    return LAYOUTS[name]


@pytest.fixture
def source(layout: Layout, tmp_path: Path) -> Path:
    return layout.write(tmp_path)


@pytest.fixture
def shots(name: str):
    """The expected frames, in order."""
    shots = shoot(LAYOUTS[name].camera)
    return shots[::-1] if name.endswith('test') else shots


def read(source: Path, layout: Layout, **options):
    return open_sequence(str(source), **layout.options, **options)


def reprojection_errors(a, b, T_b_a):
    """Relative depth errors of a frame's points projected into another frame, for points that both frames see."""
    v, u = np.nonzero(a.depth_m)
    z = a.depth_m[v, u].astype(np.float64)
    points = np.stack([(u - a.camera.cx) / a.camera.fx * z, (v - a.camera.cy) / a.camera.fy * z, z, np.ones_like(z)])
    x, y, z = (T_b_a @ points)[:3]
    u, v = (np.rint(at).astype(int) for at in (x / z * b.camera.fx + b.camera.cx, y / z * b.camera.fy + b.camera.cy))
    inside = (z > 0) & (u >= 0) & (u < b.camera.width) & (v >= 0) & (v < b.camera.height)
    seen = b.depth_m[v[inside], u[inside]]
    return np.abs(z[inside] - seen)[seen > 0] / seen[seen > 0]


# --- frames and truth ---


def test_images_and_depth(source, layout, shots):
    sequence = read(source, layout)
    assert len(sequence) == 3
    for index, shot in enumerate(shots):
        frame = sequence[index]
        assert frame.rgb.shape == shot.rgb.shape
        assert (frame.rgb.dtype, frame.depth_m.dtype) == (np.uint8, np.float32)
        color_error = np.abs(frame.rgb.astype(float) - shot.rgb)[2:-2, 2:-2]
        depth_error = np.abs(frame.depth_m - shot.depth_m)[frame.depth_m > 0]
        assert (frame.depth_m > 0).mean() > 0.9  # rectified and moved images lack some edge
        if layout.is_exact:
            assert depth_error.max() <= 0.5 * layout.step_m + 1e-6  # rounded to whole counts
        else:
            # depth of the nearest stored pixel is up to half of its width off, 1/158 of the depth on slopes of 1;
            # another half where the image is rectified as well
            assert np.median(depth_error / shot.depth_m[frame.depth_m > 0]) < layout.depth_pixel / 79
        is_lossless = layout.is_exact and not [*source.rglob('*.jpg'), *source.rglob('*.JPG')]
        # JPEG at quality 95 of textures as fine as a pixel, and bilinear interpolation between such
        assert np.median(color_error) <= (0 if is_lossless else JPEG_ERROR)


def test_camera(source, layout):
    sequence = read(source, layout)
    c, expected = sequence.camera, layout.camera
    assert (c.width, c.height) == (expected.width, expected.height)
    assert [c.fx, c.fy, c.cx, c.cy] == pytest.approx([expected.fx, expected.fy, expected.cx, expected.cy])
    assert all(frame.camera == c for frame in sequence)


def test_stamps_are_integer_nanoseconds_in_order(source, layout, name):
    stamps = [frame.stamp_ns for frame in read(source, layout)]
    assert all(type(stamp) is int for stamp in stamps)
    if name == 'tum':
        assert stamps == [1305031102175304000, 1305031102208304000, 1305031102241304000]
    else:
        assert stamps == [FIRST_STAMP_NS + number * SECOND // layout.rate_hz for number in layout.numbers]


def test_truth(source, layout, shots):
    """Relative poses equal the room's: each dataset has its own world frame, but OpenCV's camera axes."""
    sequence = read(source, layout)
    truth = sequence.ground_truth()
    assert truth.stamps_ns.tolist() == [frame.stamp_ns for frame in sequence]
    assert np.allclose(np.linalg.det(truth.T_world_cam[:, :3, :3]), 1.0)  # turned, not mirrored
    for index, shot in enumerate(shots):
        found = se3.inverse(truth.T_world_cam[0]) @ truth.T_world_cam[index]
        expected = se3.inverse(shots[0].T_world_cam) @ shot.T_world_cam
        assert np.abs(found - expected).max() < 1e-9  # files hold all digits; a unit quaternion in between


def test_one_frame_reprojects_into_another(source, layout):
    """Tests poses, depth and camera together; the same frames with wrong poses must fail."""
    sequence = read(source, layout)
    truth = sequence.ground_truth().T_world_cam
    first, last = sequence[0], sequence[2]

    def share_that_agrees(T: np.ndarray) -> float:
        errors = reprojection_errors(first, last, T)
        # a pixel is 1/79 of the depth wide, and so far off is the nearest one on slopes of 2
        return (errors < layout.depth_pixel / 79).mean() if len(errors) > 1000 else 0.0

    T_last_first = se3.inverse(truth[2]) @ truth[0]
    right = share_that_agrees(T_last_first)
    assert right > 0.85  # the rest lies at depth edges
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    wrong = [se3.inverse(T_last_first), FLIP_Y_AND_Z @ T_last_first @ FLIP_Y_AND_Z, mirror @ T_last_first @ mirror]
    assert max(share_that_agrees(T) for T in wrong) < right - 0.1


POSES = ('transform_matrix', 'aligned_pose', 'pose', 'poses')


def without_poses(path: Path) -> bool:
    """Remove the poses from a JSON file. Returns True if there were any."""

    def stripped(values):
        if isinstance(values, list):
            return [stripped(value) for value in values]
        if isinstance(values, dict):
            return {name: stripped(value) for name, value in values.items() if name not in POSES}
        return values

    before = json.loads(path.read_text())
    path.write_text(json.dumps(after := stripped(before)))
    return after != before


def test_no_truth_is_needed(source, layout):
    if layout.format == 'rosbag':
        pytest.skip('its poses are in the bag; test_datasets_rosbag has bags without')
    if layout.truth is None:  # its poses are in the file with its cameras
        assert sum(map(without_poses, source.rglob('*.json')))
    else:
        removed = [path.unlink() for path in source.glob(layout.truth)]
        assert removed
    sequence = read(source, layout)
    assert len(sequence) == 3
    assert sequence[2].rgb.any()
    assert sequence.ground_truth() is None


def test_resized_cropped_and_thinned(source, layout):
    """A scene point is at the pixel that the camera predicts, whatever was done to the images."""
    whole = read(source, layout)
    part = read(source, layout, width=layout.camera.width // 2, crop=4, start=0, stride=2)
    assert len(part) == 2
    assert [frame.stamp_ns for frame in part] == [whole[0].stamp_ns, whole[2].stamp_ns]
    frame = part[1]
    size = (layout.camera.height // 2 - 8, layout.camera.width // 2 - 8)
    assert frame.depth_m.shape == size == (part.camera.height, part.camera.width)
    truth = whole.ground_truth().T_world_cam
    # the half-size pixel is twice as wide
    assert (reprojection_errors(frame, whole[0], se3.inverse(truth[0]) @ truth[2]) < 0.03).mean() > 0.85


# --- recognition and errors ---


def test_hidden_files_of_other_systems_change_nothing(source, layout):
    """macOS puts ._NAME beside each file on a disk of another kind."""
    if layout.format == 'rosbag':
        pytest.skip('the files of a bag are in its metadata')
    expected = len(read(source, layout))
    for path in [path for path in source.rglob('*') if path.is_file()]:
        path.with_name('._' + path.name).write_bytes(b'\0\5\x16\7')
        (path.parent / '.DS_Store').write_bytes(b'\0')
    sequence = read(source, layout)
    assert len([sequence[index] for index in range(len(sequence))]) == expected


def test_recognised_by_one_reader_only(source, layout):
    fitting = [reader for name in READERS if (reader := _reader(name)).recognises(str(source))]
    certain = [reader.name for reader in fitting if not reader.is_last_resort] or [reader.name for reader in fitting]
    assert certain == [layout.format]


def test_one_missing_depth_costs_one_frame(source, layout):
    if layout.depth is None:
        pytest.skip('a list names the files; test/field has such recordings')
    (source / layout.depth).unlink()
    sequence = read(source, layout)
    assert len(sequence) == 3
    with pytest.raises(FrameError, match='there is no depth image for it'):
        sequence[1]
    assert sequence[0].depth_m.any() and sequence[2].depth_m.any()


def color_of(source, layout):
    """The colour file of frame 1."""
    sequence = read(source, layout)
    return sequence._pairs[1].color


def test_one_missing_colour_costs_one_frame(source, layout):
    """It used to be left out in silence where frames are numbered."""
    if layout.depth is None:
        pytest.skip('a list names the files; test/field has such recordings')
    color = color_of(source, layout)
    color.unlink()
    sequence = read(source, layout)
    assert len(sequence) == 3
    with pytest.raises(FrameError, match=f'{color.name}.*cannot be read'):
        sequence[1]
    assert sequence[0].depth_m.any() and sequence[2].depth_m.any()


def test_many_missing_depths_are_said_at_once(source, layout):
    if layout.depth is None:
        pytest.skip('a list names the files; test/field has such recordings')
    depth = source / layout.depth
    for path in depth.parent.iterdir():
        if re.sub(r'\d+', '0', path.name) == re.sub(r'\d+', '0', depth.name):
            path.unlink()
    with pytest.raises(DatasetError, match='3 of 3 colour images have no depth, and at most a tenth may lack it'):
        read(source, layout)


@pytest.mark.parametrize('format', [name for name in READERS if name != 'synthetic'])
def test_wrong_folder_says_what_is_expected_and_what_is_there(tmp_path, format):
    (tmp_path / 'holiday.jpg').touch()
    with pytest.raises(DatasetError) as caught:
        open_sequence(str(tmp_path), format=format)
    assert f'{format} expects {_reader(format).expects}' in str(caught.value)
    assert 'holds holiday.jpg' in str(caught.value)


def test_the_folder_above_or_below_says_which_was_meant(layout, tmp_path):
    """The parent folder and a folder inside are common mistakes."""
    (tmp_path / 'downloads' / 'recording').mkdir(parents=True)
    source = layout.write(tmp_path / 'downloads' / 'recording')
    inside = [path for path in source.iterdir() if path.is_dir()] if source.is_dir() else []
    wrong = [path for path in (source.parent, *inside) if not any(_reader(name).recognises(str(path)) for name in READERS)]
    assert source.parent in wrong
    for path, options in [(path, options) for path in wrong for options in ({}, {'format': layout.format})]:
        with pytest.raises(DatasetError) as caught:
            open_sequence(str(path), **options)
        assert f'but {source} looks like {layout.format}: was that meant?' in str(caught.value)


def test_splits_and_flags_are_refused_where_there_are_none(source, layout):
    reader = _reader(layout.format)
    if not reader.has_splits:
        with pytest.raises(DatasetError, match='there is no train or test split'):
            open_sequence(str(source), split='train')
    if not reader.flags_bad:
        with pytest.raises(DatasetError, match='no frames are flagged as bad'):
            open_sequence(str(source), skip_bad=True)


def write(name: str, folder: Path) -> Path:
    return LAYOUTS[name].write(folder)


@pytest.mark.parametrize(
    ('name', 'file', 'text', 'message'),
    [
        ('replica', '../cam_params.json', '{"camera": {"w": 96}}', r"cam_params\.json: 'h' is missing"),
        ('replica', '../cam_params.json', '{', r'cam_params\.json: cannot be read as JSON'),
        ('replica', 'traj.txt', '1 0 0', r'traj\.txt, pose 0: expected the 16 numbers'),
        ('replica', 'traj.txt', rows(np.eye(4).reshape(1, 16)), r'has 1 poses, but there is a frame 2'),
        ('scannet', 'intrinsic/intrinsic_color.txt', '1 2 3', r'intrinsic_color\.txt: expected 4x4 or 3x3'),
        ('scannetpp train', 'dslr/train_test_lists.json', '{"train": ["DSC1.JPG"]}', '1 of 1 train frames are not in'),
        ('scannetpp test', 'dslr/train_test_lists.json', '{"train": []}', r"train_test_lists\.json: 'test' is missing"),
        ('scannetpp train', 'dslr/nerfstudio/transforms_undistorted.json', '[]', 'expected a JSON object, got list'),
        ('scannetpp_iphone', 'pose_intrinsic_imu.json', '{"frame_000000": {}}', "'frame_000010' is missing"),
        ('nerfcapture', 'transforms.json', '{"frames": [{"file_path": "rgb/0.png"}]}', 'none of 1 frames has a depth'),
        ('nerfcapture', 'transforms.json', '{"frames": [{"depth_path": "0.png"}]}', "'w' is missing"),
        ('icl', 'livingRoom2.gt.freiburg', '1 2 3', 'expected .frame tx ty tz qx qy qz qw. .*, got 3 numbers'),
        ('folder', 'camera.yaml', 'width: 3', r'camera\.yaml: missing cx, cy, fx, fy, height'),
        ('folder realsense', 'camera.yaml', 'pose_axes: up', r'camera\.yaml: missing'),
        ('folder distorted', 'camera.yaml', 'width: 3\ndistorti', r'camera\.yaml: cannot be read: .*scanning'),
        ('folder azure', 'intrinsic.json', '{"width": 96}', r"intrinsic\.json: 'intrinsic_matrix' is missing"),
        ('folder azure', 'trajectory.log', '1 2 3', r'trajectory\.log: expected blocks of 3 \+ 16 numbers'),
        ('folder distorted', 'traj.txt', rows(np.eye(4).reshape(1, 16)), 'has 1 poses for 3 frames'),
    ],
)
def test_broken_files_are_named(tmp_path, name, file, text, message):
    source = write(name, tmp_path)
    (source / file).write_text(text)
    with pytest.raises((DatasetError, CameraError), match=message) as caught:
        read(source, LAYOUTS[name]).ground_truth()
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(
    ('name', 'file', 'message'),
    [
        ('folder', 'poses/0000{}.txt', r'poses/0000\d\.txt: cannot be read'),
        ('folder realsense', 'poses/0000{}.npy', r'0000\d\.npy: is no complete \.npy file of numbers'),
        ('scannet', 'pose/{}.txt', r'pose/\d\.txt: cannot be read'),
    ],
)
def test_one_broken_pose_costs_one_pose(tmp_path, caplog, name, file, message):
    source = write(name, tmp_path)
    (source / file.format(1)).write_text('x')
    assert len(read(source, LAYOUTS[name]).ground_truth()) == 2
    assert re.search(f'1 of 3 true poses cannot be read and are left out: .*{message}', caplog.text)
    (source / file.format(2)).write_text('x')
    with pytest.raises(DatasetError, match=message):
        read(source, LAYOUTS[name]).ground_truth()


# --- what some datasets have of their own ---


def test_published_cameras():
    """From NICE-SLAM's cam_params.json of Replica, vMAP's config_replica_*.json, and ICL-NUIM's page."""
    assert replica.CAMERA.calibration.pinhole == PinholeCamera(1200, 680, 600.0, 600.0, 599.5, 339.5)
    assert (replica.CAMERA.depth_scale, replica_v2.DEPTH_SCALE, icl.DEPTH_SCALE) == (6553.5, 1000.0, 5000.0)
    assert icl.CAMERA.pinhole == PinholeCamera(640, 480, 481.2, 480.0, 319.5, 239.5)


@pytest.mark.parametrize(('name', 'size'), [('replica_v2 train', (1200, 680)), ('icl', (640, 480))])
def test_published_camera_without_a_camera_file(tmp_path, name, size):
    source = write(name, tmp_path)
    (source / 'camera.yaml').unlink()
    with pytest.raises(DatasetError, match=f'is 96x72, but the camera is for {size[0]}x{size[1]} images; .*camera.yaml'):
        read(source, LAYOUTS[name])
    for path in (*source.rglob('rgb/*.png'), *source.rglob('depth/*.png')):
        cv2.imwrite(str(path), cv2.resize(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), size, interpolation=cv2.INTER_NEAREST))
    sequence = read(source, LAYOUTS[name])
    assert (sequence.camera.width, sequence.camera.height) == size
    assert sequence[2].depth_m.any()


def test_scannet_frames_without_a_pose_are_frames_without_truth(tmp_path):
    source = write('scannet', tmp_path)
    (source / 'pose/1.txt').write_text('-inf -inf -inf -inf\n' * 4)
    sequence = open_sequence(str(source))
    assert len(sequence) == 3
    assert sequence[1].depth_m.any()
    assert sequence.ground_truth().stamps_ns.tolist() == [sequence[0].stamp_ns, sequence[2].stamp_ns]
    assert np.isfinite(sequence.ground_truth().T_world_cam).all()


def test_scannet_depth_without_its_own_intrinsics(tmp_path):
    """Depth is then colour's view at another size."""
    source = write('scannet', tmp_path)
    for path in (*source.glob('intrinsic/*_depth.txt'), *source.glob('depth/*')):
        path.unlink()
    small = COLOR_CAMERA.resized(72, 54)
    for index, shot in enumerate(shoot(small)):
        cv2.imwrite(str(source / f'depth/{index}.png'), np.rint(1000 * shot.depth_m).astype(np.uint16))
    read_m, expected_m = open_sequence(str(source))[0].depth_m, shoot(COLOR_CAMERA)[0].depth_m
    assert np.median(np.abs(read_m - expected_m) / expected_m) < 0.01  # half a pixel of the small image


def test_scannet_extrinsics_are_not_ignored_in_silence(tmp_path, caplog):
    source = write('scannet', tmp_path)
    with caplog.at_level(logging.WARNING):
        open_sequence(str(source))
    assert not caplog.records
    T = np.eye(4)
    T[0, 3] = 0.02
    (source / 'intrinsic/extrinsic_depth.txt').write_text(rows(T))
    with caplog.at_level(logging.WARNING):
        open_sequence(str(source))
    assert 'extrinsic_depth.txt is not the identity' in caplog.text


def test_splits_share_their_world(tmp_path):
    """The test path of these layouts is the train path backwards."""
    for name in ('replica_v2', 'scannetpp'):
        folder = tmp_path / name
        folder.mkdir()
        source = write(f'{name} train', folder)
        train, default, test = (open_sequence(str(source), split=split) for split in ('train', None, 'test'))
        assert train.name == default.name != test.name
        a, b = train.ground_truth().T_world_cam, test.ground_truth().T_world_cam
        assert np.array_equal(a, b[::-1])
        assert np.array_equal(train[0].rgb, test[2].rgb)


def test_command_line_takes_a_part(tmp_path):
    source = write('scannetpp train', tmp_path)
    options = ['--split', 'train', '--skip-bad', '--stride', '1', '--crop', '4', '--format', 'scannetpp']
    assert main(['convert', str(source), str(tmp_path / 'bag'), *options]) == 0
    part = open_sequence(str(source), split='train', skip_bad=True, crop=4)
    bag = open_sequence(str(tmp_path / 'bag'))
    assert (len(bag), bag.camera.width, bag.camera.height) == (2, 88, 64)
    assert np.array_equal(bag[1].rgb, part[1].rgb)
    assert np.array_equal(bag[1].depth_m, part[1].depth_m)


def test_missing_split_is_named(tmp_path):
    source = write('replica_v2 train', tmp_path)
    (source / 'imap/01').rename(source / 'imap/02')
    with pytest.raises(DatasetError, match=r'imap/01: there is no such folder; split test'):
        open_sequence(str(source), split='test')
    with pytest.raises(DatasetError, match="split 'val' is not one of train, test"):
        open_sequence(str(source), split='val')


def test_bad_frames_are_kept_unless_they_are_not_wanted(tmp_path):
    source = str(write('scannetpp train', tmp_path))
    kept, skipped = open_sequence(source), open_sequence(source, skip_bad=True)
    assert (len(kept), len(skipped)) == (3, 2)
    assert np.array_equal(skipped[1].rgb, kept[2].rgb)
    assert len(skipped.ground_truth()) == 2


def test_icl_frames_before_the_truth_have_none(tmp_path):
    source = write('icl', tmp_path)
    truth = source / 'livingRoom2.gt.freiburg'
    truth.write_text(truth.read_text().partition('\n')[2])
    sequence = open_sequence(str(source))
    assert len(sequence) == 3
    assert sequence.ground_truth().stamps_ns.tolist() == [sequence[1].stamp_ns, sequence[2].stamp_ns]


def test_camera_yaml_wins_over_the_cameras_of_frames(tmp_path):
    for name in ('nerfcapture', 'scannetpp_iphone'):
        folder = tmp_path / name
        folder.mkdir()
        source = write(name, folder)
        camera = PinholeCamera(96, 72, 90.0, 90.0, 48.0, 36.0)
        camera_yaml(source, camera)
        sequence = open_sequence(str(source))
        assert sequence.camera == camera
        assert len(sequence[1].rgb)


def test_pose_axes_are_for_plain_folders(tmp_path):
    source = write('tum', tmp_path)
    camera_yaml(source, pose_axes='opengl')
    with pytest.raises(CameraError, match=r'pose_axes is for plain folders'):
        open_sequence(str(source))


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        (lambda folder: (folder / 'camera.yaml').unlink(), 'the camera is not stated; put a camera.yaml'),
        (lambda folder: (folder / 'color').mkdir(), 'holds rgb and color, which mean the same; keep one'),
        (lambda folder: (folder / 'traj.txt').touch(), 'holds poses and traj.txt, which mean the same'),
        (lambda folder: (folder / 'rgb/cover.png').touch(), r'cover\.png: there is no number in the name'),
        (lambda folder: (folder / 'rgb/a00001.png').touch(), r'a00001\.png and frame00001\.png have the same number'),
        (lambda folder: [path.unlink() for path in folder.glob('rgb/*')], 'no frame in it; expected rgb/000000.jpg'),
    ],
)
def test_unclear_plain_folder(tmp_path, change: Callable[[Path], object], message):
    source = write('folder', tmp_path)
    change(source)
    with pytest.raises(DatasetError, match=message):
        open_sequence(str(source)).ground_truth()


def test_real_recording_as_a_plain_folder(tmp_path, recording):
    """Links to the files of a real recording, with its camera and poses, to test with real sizes and values."""
    folder = recording('7scenes_redkitchen')
    for kind, suffix in (('rgb', 'color.jpg'), ('depth', 'depth.png'), ('poses', 'pose.txt')):
        (tmp_path / kind).mkdir()
        for path in sorted(folder.glob(f'frame-*.{suffix}'))[:5]:
            (tmp_path / kind / path.name).symlink_to(path)
    (tmp_path / 'camera-intrinsics.txt').symlink_to(folder / 'camera-intrinsics.txt')
    plain, known = open_sequence(str(tmp_path)), open_sequence(str(folder), max_frames=5)
    assert len(plain) == 5
    for index in (0, 4):
        assert np.array_equal(plain[index].rgb, known[index].rgb)
        assert np.array_equal(plain[index].depth_m, known[index].depth_m)
        assert plain[index].camera == known[index].camera
    assert np.array_equal(plain.ground_truth().T_world_cam, known.ground_truth().T_world_cam[:5])


def test_a_ros1_bag_of_which_nothing_is_whole_says_so(tmp_path):
    path = write('rosbag1', tmp_path)
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(DatasetError, match='cannot be read as a ROS 1 bag, it may be truncated') as caught:
        open_sequence(str(path))
    assert '\n' not in str(caught.value)


def test_shots_are_of_some_use():
    """The frames differ enough to reveal a wrong pose, and overlap enough to be compared."""
    T = se3.inverse(SHOTS[0].T_world_cam) @ SHOTS[2].T_world_cam
    assert np.linalg.norm(T[:3, 3]) > 0.05
    assert np.degrees(np.linalg.norm(se3.rotation_vector(T[:3, :3]))) > 2
    red, _, blue = np.moveaxis(SHOTS[0].rgb.astype(int), -1, 0)
    assert np.median(np.abs(red - blue)) > JPEG_ERROR  # swapped channels show
    assert CAMERA.width == SHOTS[0].rgb.shape[1]
