"""Recognising the format of a recording, and cutting a window out of it."""

from __future__ import annotations

import numpy as np
import pytest

from splatam_core.datasets.base import BagTopics, Window, cut, nominal_stamp_ns
from splatam_core.datasets.registry import READERS, open_sequence
from splatam_core.errors import CameraError, DatasetError


def test_unknown_folder_says_what_is_expected_and_what_was_found(tmp_path):
    (tmp_path / 'notes.md').touch()
    with pytest.raises(DatasetError) as caught:
        open_sequence(str(tmp_path))
    message = str(caught.value)
    assert 'holds notes.md' in message
    for name in READERS:
        assert f'{name}: ' in message
    assert '\n' not in message


@pytest.mark.parametrize(
    ('make', 'message'),
    [
        (lambda path: None, 'there is no such file or folder'),
        (lambda path: path.mkdir(), 'is an empty folder'),
        (lambda path: path.touch(), 'is a file without a suffix'),
    ],
)
def test_what_was_found(tmp_path, make, message):
    make(tmp_path / 'source')
    with pytest.raises(DatasetError, match=message):
        open_sequence(str(tmp_path / 'source'))


def test_ambiguous_folder(tmp_path):
    for name in ('rgb.txt', 'depth.txt', 'frame-000000.color.png'):
        (tmp_path / name).touch()
    with pytest.raises(DatasetError, match='looks like tum and sevenscenes at once; choose one with --format'):
        open_sequence(str(tmp_path))


def test_unknown_format(tmp_path):
    with pytest.raises(DatasetError, match="format 'kitti' is not one of synthetic, tum, sevenscenes, replica, "):
        open_sequence(str(tmp_path), format='kitti')


@pytest.mark.parametrize('format', [name for name in READERS if name != 'synthetic'])
def test_format_of_a_missing_path(tmp_path, format):
    with pytest.raises(DatasetError, match='there is no such file or folder'):
        open_sequence(str(tmp_path / 'nowhere'), format=format)


def test_topics_belong_to_bags():
    with pytest.raises(DatasetError, match='read as synthetic, where there are no topics'):
        open_sequence('synthetic', topics=BagTopics(rgb='/rgb'))


@pytest.mark.parametrize(
    ('options', 'message'),
    [
        ({'start': -1}, 'start -1'),
        ({'max_frames': 0}, 'max_frames 0'),
        ({'stride': 0}, 'stride 0: must be at least 1'),
        ({'crop': -1}, 'crop -1: must be at least 0'),
        ({'crop': 20, 'width': 64}, 'crop 20: leaves 24x8 of the 64x48 frames'),
        ({'split': 'train'}, 'read as synthetic, where there is no train or test split; leave that option out'),
        ({'skip_bad': True}, 'read as synthetic, where no frames are flagged as bad'),
    ],
)
def test_impossible_window(options, message):
    with pytest.raises(DatasetError, match=message):
        open_sequence('synthetic', **options)


def test_stride_counts_from_the_start(room):
    whole = room(frames=9, width=32)
    thinned = open_sequence('synthetic:frames=9', start=1, stride=3, width=32)
    assert [frame.stamp_ns for frame in thinned] == [whole[i].stamp_ns for i in (1, 4, 7)]
    assert len(open_sequence('synthetic:frames=9', start=1, stride=3, max_frames=2, width=32)) == 2
    assert len(open_sequence('synthetic', start=1, stride=3, max_frames=4, width=32)) == 4  # frame 10 is the last asked


def test_crop_keeps_what_a_pixel_sees(room):
    whole, cropped = room(frames=1, width=64)[0], open_sequence('synthetic:frames=1', crop=5, width=64)
    assert np.array_equal(cropped[0].rgb, whole.rgb[5:-5, 5:-5])
    assert np.array_equal(cropped[0].depth_m, whole.depth_m[5:-5, 5:-5])
    a, b = cropped[0].camera, whole.camera
    assert (a.width, a.height, a.fx, a.fy) == (54, 38, b.fx, b.fy)
    assert (a.cx, a.cy) == (b.cx - 5, b.cy - 5)
    assert a == cropped.camera


def test_start_beyond_the_end():
    with pytest.raises(DatasetError, match='start 5 is beyond its 4 frames'):
        open_sequence('synthetic:frames=4', start=5, width=64)


def test_width_too_small():
    with pytest.raises(CameraError, match='width 8'):
        open_sequence('synthetic', width=8)


def test_window(room):
    whole = room(frames=6, width=32)
    window = open_sequence('synthetic:frames=6', start=2, max_frames=3, width=32)
    assert isinstance(window, Window)
    assert [frame.stamp_ns for frame in window] == [nominal_stamp_ns(i) for i in (2, 3, 4)]
    assert np.array_equal(window[0].rgb, whole[2].rgb)
    assert len(window.ground_truth()) == 6
    with pytest.raises(IndexError):
        window[3]
    assert len(open_sequence('synthetic:frames=6', start=4, max_frames=30, width=32)) == 2


def test_whole_sequence_is_not_wrapped(room):
    from splatam_core.datasets.base import ReadOptions

    sequence = room(frames=6, width=32)
    assert cut(sequence, ReadOptions(max_frames=6)) is sequence
