"""The 7-Scenes reader, on generated folders and on the real recording."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from splatam_core.datasets import sevenscenes
from splatam_core.datasets.registry import open_sequence
from splatam_core.datasets.sevenscenes import DEFAULT_CAMERA
from splatam_core.errors import DatasetError
from splatam_core.geometry.camera import PinholeCamera

K_TEXT = '50 0 31.5\n0 51 23.5\n0 0 1\n'


def write_scene(folder: Path, numbers: list[int], *, suffix: str = 'png', K: str | None = K_TEXT) -> Path:
    """Write 64x48 frames: green is the frame number, depth 1234 mm except 65535 in one corner and 0 in another."""
    folder.mkdir(exist_ok=True)
    for number in numbers:
        stem = f'{folder}/frame-{number:06d}'
        cv2.imwrite(f'{stem}.color.{suffix}', np.broadcast_to(np.uint8([30, number, 10]), (48, 64, 3)))
        depth = np.full((48, 64), 1234, np.uint16)
        depth[0, 0], depth[-1, -1] = 65535, 0
        cv2.imwrite(f'{stem}.depth.png', depth)
        pose = np.eye(4)
        pose[:3, 3] = number, 2, 3
        np.savetxt(f'{stem}.pose.txt', pose)
    if K is not None:
        (folder / 'camera-intrinsics.txt').write_text(K)
    return folder


def test_frames(tmp_path):
    sequence = open_sequence(str(write_scene(tmp_path, [0, 1, 2])))
    frame = sequence[1]
    assert len(sequence) == 3
    assert sequence.camera == PinholeCamera(64, 48, 50, 51, 31.5, 23.5)
    assert sequence.depth_scale == 1000
    assert frame.rgb[9, 9].tolist() == [10, 1, 30]
    assert frame.depth_m[0, 0] == frame.depth_m[-1, -1] == 0
    assert np.count_nonzero(frame.depth_m == np.float32(1234) / np.float32(1000)) == 64 * 48 - 2


def test_stamps_start_at_one_second_and_count_at_30_hz(tmp_path):
    # the numbers count, so a frame that was left out leaves its gap
    sequence = sevenscenes.read(write_scene(tmp_path, [10, 11, 40]))
    stamps = [sequence[i].stamp_ns for i in range(3)]
    assert stamps == [1_000_000_000, 1_033_333_333, 2_000_000_000]
    assert sequence.ground_truth().stamps_ns.tolist() == stamps
    assert sequence.ground_truth().T_world_cam[:, 0, 3].tolist() == [10, 11, 40]


def test_default_intrinsics(tmp_path):
    folder = write_scene(tmp_path, [0], K=None)
    cv2.imwrite(str(folder / 'frame-000000.color.png'), np.zeros((480, 640, 3), np.uint8))
    sequence = sevenscenes.read(folder)
    assert sequence.camera == DEFAULT_CAMERA.pinhole == PinholeCamera(640, 480, 585, 585, 320, 240)


def test_camera_yaml_wins(tmp_path):
    write_scene(tmp_path, [0])
    (tmp_path / 'camera.yaml').write_text('{width: 64, height: 48, fx: 70, fy: 70, cx: 32, cy: 24, depth_scale: 500}')
    sequence = sevenscenes.read(tmp_path)
    assert (sequence.camera.fx, sequence.depth_scale) == (70, 500)
    assert sequence[0].depth_m[9, 9] == np.float32(1234) / np.float32(500)


def test_jpeg_colour_and_png_wins_over_it(tmp_path):
    write_scene(tmp_path, [100, 101], suffix='jpg')
    assert abs(int(sevenscenes.read(tmp_path)[0].rgb[9, 9, 1]) - 100) <= 2  # JPEG rounds flat colours by 1 or 2
    cv2.imwrite(str(tmp_path / 'frame-000100.color.png'), np.full((48, 64, 3), 7, np.uint8))
    sequence = sevenscenes.read(tmp_path)
    assert len(sequence) == 2
    assert np.all(sequence[0].rgb == 7)


def test_truth_is_optional_and_may_have_gaps(tmp_path):
    write_scene(tmp_path, [0, 1, 2])
    (tmp_path / 'frame-000001.pose.txt').unlink()
    assert len(sevenscenes.read(tmp_path).ground_truth()) == 2
    for path in tmp_path.glob('*.pose.txt'):
        path.unlink()
    assert sevenscenes.read(tmp_path).ground_truth() is None


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('1 0 0\n', 'expected the 16 numbers of a 4x4 camera-to-world matrix, got 3'),
        ('x', 'cannot be read'),
        ('2 0 0 0  0 2 0 0  0 0 2 0  0 0 0 1', 'is no rotation'),
        ('-1 0 0 0  0 1 0 0  0 0 1 0  0 0 0 1', 'is no rotation'),
    ],
)
def test_broken_pose(tmp_path, text, message):
    write_scene(tmp_path, [0])
    (tmp_path / 'frame-000000.pose.txt').write_text(text)
    with pytest.raises(DatasetError, match=message):
        sevenscenes.read(tmp_path).ground_truth()


def test_missing_depth_is_said_at_once_where_much_is_missing(tmp_path):
    write_scene(tmp_path, list(range(6)))
    for number in (1, 2, 3, 5):
        (tmp_path / f'frame-00000{number}.depth.png').unlink()
    listed = r'frame-000001\.color\.png, frame-000002\.color\.png, frame-000003\.color\.png and so on'
    with pytest.raises(DatasetError, match=f'4 of 6 colour images have no depth.*: {listed}'):
        sevenscenes.read(tmp_path)


def test_no_frames(tmp_path):
    with pytest.raises(DatasetError, match='is an empty folder; sevenscenes expects a folder with frame-000000'):
        open_sequence(str(tmp_path), format='sevenscenes')


def test_real_recording(recording):
    sequence = open_sequence(str(recording('7scenes_redkitchen')), width=320)
    frame, truth = sequence[0], sequence.ground_truth()
    assert len(sequence) == len(truth) == 300
    assert frame.rgb.shape == (240, 320, 3)
    assert sequence.camera == PinholeCamera(640, 480, 525, 525, 320, 240).resized(320, 240)
    R = truth.T_world_cam[:, :3, :3]
    # the files round to nine digits; the reader makes rotations exact again
    assert np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max() < 1e-12
