"""CameraInfo: calibration, binning, region of interest, and cameras that are not calibrated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from msg_adapters import remarks
from msg_adapters.camera_info import CameraParameters, info_message, parameters
from msg_adapters.errors import MessageError
from msg_adapters.stamps import message_stamp_ns

CAMERA = CameraParameters(640, 480, 525.0, 526.0, 319.5, 239.5, frame_id='camera')


@pytest.fixture
def info(factory):
    """An info message of ``CAMERA`` with some fields changed."""

    def make(**changes):
        message = info_message(factory, CAMERA, 5)
        for name, value in changes.items():
            setattr(message, name, value)
        return message

    return make


@pytest.mark.parametrize(
    ('model', 'distortion'),
    [
        ('none', ()),
        ('plumb_bob', (0.1, -0.2, 0.001, 0.002, 0.3)),
        ('rational_polynomial', (0.1, -0.2, 0.001, 0.002, 0.3, 0.4, 0.5, 0.6)),
        ('equidistant', (0.1, -0.2, 0.3, 0.4)),
    ],
)
def test_a_camera_comes_back_exactly(factory, model, distortion):
    camera = replace(CAMERA, distortion_model=model, distortion=distortion)
    message = info_message(factory, camera, 1_234_567_890_123_456_789)
    assert parameters(message) == camera
    assert message_stamp_ns(message) == 1_234_567_890_123_456_789


def test_matrices_say_a_monocular_camera(info):
    message = info()
    k = np.array(message.k).reshape(3, 3)
    np.testing.assert_array_equal(k, [[525, 0, 319.5], [0, 526, 239.5], [0, 0, 1]])
    np.testing.assert_array_equal(np.array(message.r).reshape(3, 3), np.eye(3))
    np.testing.assert_array_equal(np.array(message.p).reshape(3, 4), np.hstack([k, np.zeros((3, 1))]))


def test_no_distortion_is_said_as_rectified_ros_cameras_say_it(info):
    assert info().distortion_model == 'plumb_bob'
    assert list(info().d) == [0.0] * 5


@pytest.mark.parametrize(
    'model', ['', 'none', 'None', 'pinhole', 'plumb_bob', 'rational_polynomial', 'equidistant', 'kannala', 'Inverse Brown Conrady']
)
@pytest.mark.parametrize('d', [[], [0.0] * 4, [0.0] * 5, [0.0] * 8])
def test_zero_coefficients_are_no_distortion(info, model, d):
    camera = parameters(info(distortion_model=model, d=d))
    assert (camera.distortion_model, camera.distortion) == ('none', ())


@pytest.mark.parametrize(
    ('model', 'd', 'expected'),
    [
        ('plumb_bob', [0.1, 0.2, 0.3, 0.4], (0.1, 0.2, 0.3, 0.4, 0.0)),
        ('plumb_bob', [0.1, 0.2, 0.3, 0.4, 0.5, 0.0, 0.0, 0.0], (0.1, 0.2, 0.3, 0.4, 0.5)),
        ('rational_polynomial', [0.1, 0.2, 0.3, 0.4, 0.5], (0.1, 0.2, 0.3, 0.4, 0.5, 0.0, 0.0, 0.0)),
        ('equidistant', [0.1], (0.1, 0.0, 0.0, 0.0)),
    ],
)
def test_missing_coefficients_are_zero_and_zeros_too_many_are_dropped(info, model, d, expected):
    assert parameters(info(distortion_model=model, d=d)).distortion == expected


@pytest.mark.parametrize(
    ('model', 'd', 'said'),
    [
        ('kannala', [0.1, 0.0, 0.0, 0.0], "'kannala'"),
        ('None', [0.1], "'None'"),
        ('none', [0.1], "'none'"),
        ('plumb_bob', [0.1, 0.0, 0.0, 0.0, 0.0, 0.2], 'has 5 coefficients'),
        ('equidistant', [0.1, 0.0, 0.0, 0.0, 0.2], 'has 4 coefficients'),
        ('plumb_bob', [float('nan')] * 5, 'finite'),
    ],
)
def test_distortion_that_is_not_understood_is_an_error(info, model, d, said):
    with pytest.raises(MessageError, match=said):
        parameters(info(distortion_model=model, d=d))


@pytest.mark.parametrize(
    'k',
    [
        [0.0] * 9,
        [-525.0, 0.0, 320.0, 0.0, 525.0, 240.0, 0.0, 0.0, 1.0],
        [525.0, 0.0, 320.0, 0.0, 0.0, 240.0, 0.0, 0.0, 1.0],
        [525.0, 0.0, float('nan'), 0.0, 525.0, 240.0, 0.0, 0.0, 1.0],
        [float('inf'), 0.0, 320.0, 0.0, 525.0, 240.0, 0.0, 0.0, 1.0],
    ],
)
def test_a_camera_without_calibration_is_one_line_of_error(info, k):
    with pytest.raises(MessageError, match='not calibrated') as caught:
        parameters(info(k=np.array(k), p=np.zeros(12)))
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(('model', 'same'), [
    ('Brown Conrady', 'plumb_bob'), ('inverse brown_conrady', 'plumb_bob'), ('Plumb Bob', 'plumb_bob'),
    ('Kannala-Brandt4', 'equidistant'), ('RATIONAL_POLYNOMIAL', 'rational_polynomial'),
])  # fmt: skip
def test_other_names_of_the_same_models(info, model, same):
    assert parameters(info(distortion_model=model, d=[0.1, 0.2, 0.3, 0.4])).distortion_model == same


def test_a_camera_with_only_p_is_taken_as_rectified_and_said(info):
    p = [400.0, 0.0, 310.0, 0.0, 0.0, 410.0, 230.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    message = info(k=np.zeros(9), p=p, d=[0.1, 0.0, 0.0, 0.0, 0.0])
    camera = parameters(message)
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion) == (400.0, 410.0, 310.0, 230.0, ())
    assert 'P is used' in remarks.on_info(message)
    assert remarks.on_info(info()) == '' == remarks.on_info(info(k=np.zeros(9), p=np.zeros(12)))


@pytest.mark.parametrize(('changes', 'said'), [
    ({'width': 40000, 'height': 2}, '40000x2'),
    ({'width': 16000, 'height': 16000}, '67108864 pixels'),
    ({'width': 2**32 - 1, 'height': 2**32 - 1}, '4294967295x4294967295'),
    ({'k': np.array([525.0, 0.0, 1e300, 0.0, 525.0, 239.5, 0.0, 0.0, 1.0])}, 'in pixels'),
    ({'k': np.array([1e9, 0.0, 319.5, 0.0, 525.0, 239.5, 0.0, 0.0, 1.0])}, 'in pixels'),
])  # fmt: skip
def test_a_camera_that_cannot_be_is_an_error(info, changes, said):
    with pytest.raises(MessageError, match=said):
        parameters(info(**changes))


@pytest.mark.parametrize('changes', [{'width': 0}, {'height': 0}])
def test_a_camera_without_size_is_an_error(info, changes):
    with pytest.raises(MessageError, match='width and height'):
        parameters(info(**changes))


def project(camera, point):
    """Pixel indices of a point in front of the camera."""
    x, y, z = point
    return np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])


def with_roi(message, x=0, y=0, width=0, height=0):
    message.roi.x_offset, message.roi.y_offset, message.roi.width, message.roi.height = x, y, width, height
    return message


@pytest.mark.parametrize('binning', [0, 1])
def test_binning_of_one_is_none(info, binning):
    assert parameters(info(binning_x=binning, binning_y=binning)) == CAMERA


def test_binning_and_region_of_interest_move_pixels_where_the_image_has_them(info):
    """ROS: the region is in unbinned pixels; binned pixel i covers the unbinned 2 i and 2 i + 1 of the region."""
    camera = parameters(with_roi(info(binning_x=2, binning_y=4), x=100, y=40, width=300, height=200))
    assert (camera.width, camera.height) == (150, 50)
    point = np.array([-0.1, 0.05, 1.2])
    in_region = project(CAMERA, point) - [100, 40]
    covering = (in_region + 0.5) / [2, 4] - 0.5
    np.testing.assert_allclose(project(camera, point), covering, rtol=1e-12)


def test_binning_alone_and_region_alone(info):
    binned = parameters(info(binning_x=2, binning_y=2))
    assert binned == replace(CAMERA, width=320, height=240, fx=262.5, fy=263.0, cx=159.5, cy=119.5)
    region = parameters(with_roi(info(), x=10, y=20, width=630, height=460))
    assert region == replace(CAMERA, width=630, height=460, cx=309.5, cy=219.5)


@pytest.mark.parametrize('roi', [(1, 0, 640, 480), (0, 1, 640, 480), (0, 0, 641, 480), (0, 0, 10, 0), (700, 0, 5, 5)])
def test_a_region_outside_the_image_is_an_error(info, roi):
    with pytest.raises(MessageError, match='region of interest'):
        parameters(with_roi(info(), *roi))


def test_binning_that_leaves_nothing_is_an_error(info):
    with pytest.raises(MessageError, match='binning'):
        parameters(info(binning_x=641))


def test_the_camera_of_rectified_images_is_p(info):
    """With an image_rect topic, D still describes the lens, but the images are already rectified to P."""
    p = [400.0, 0.0, 310.0, 0.0, 0.0, 410.0, 230.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    message = info(d=[0.1, -0.2, 0.0, 0.0, 0.0], p=p, binning_x=2)
    camera = parameters(message, is_rectified=True)
    assert (camera.distortion_model, camera.distortion) == ('none', ())
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (200.0, 410.0, 310.5 / 2 - 0.5, 230.0)


def test_rectified_images_without_p_are_an_error(info):
    with pytest.raises(MessageError, match='CameraInfo P .* focal lengths must be positive'):
        parameters(info(p=[0.0] * 12), is_rectified=True)


def test_a_matrix_given_column_by_column_is_refused(info):
    """Its principal point would be read as 0, in silence."""
    with pytest.raises(MessageError, match='row by row; it is given column by column'):
        parameters(info(k=np.reshape(info().k, (3, 3)).T.reshape(-1).copy()))
