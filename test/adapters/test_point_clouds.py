"""PointCloud2 as RViz expects it, and clouds of other publishers."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from msg_adapters.errors import MessageError
from msg_adapters.point_clouds import cloud_message, read_cloud
from msg_adapters.stamps import header, message_stamp_ns

FLOAT32, UINT32, FLOAT64 = 7, 6, 8


def random_cloud(n):
    rng = np.random.default_rng(n)
    return rng.normal(size=(n, 3)).astype(np.float32), rng.integers(0, 256, (n, 3), np.uint8)


@pytest.mark.parametrize('n', [0, 1, 100])
def test_a_cloud_comes_back_exactly(factory, n):
    points, rgb = random_cloud(n)
    message = cloud_message(factory, points, rgb, 99, 'map')
    assert (message.height, message.width, message.header.frame_id) == (1, n, 'map')
    assert message_stamp_ns(message) == 99
    read_points, read_rgb = read_cloud(message)
    assert_array_equal(read_points, points)
    assert_array_equal(read_rgb, rgb)


def test_colour_is_packed_as_rviz_unpacks_it(factory):
    message = cloud_message(factory, np.ones((1, 3), np.float32), np.array([[0x11, 0x22, 0x33]], np.uint8), 0, 'map')
    assert [(field.name, field.offset, field.datatype) for field in message.fields] == [
        ('x', 0, FLOAT32), ('y', 4, FLOAT32), ('z', 8, FLOAT32), ('rgb', 12, FLOAT32)
    ]  # fmt: skip
    assert struct.unpack_from('<I', bytes(message.data), 12) == (0x112233,)


def test_more_fields_follow_as_float32(factory):
    points, rgb = random_cloud(3)
    extra = {'opacity': np.float32([0.1, 0.2, 0.3]), 'radius': np.float32([1, 2, 3])}
    message = cloud_message(factory, points, rgb, 0, 'map', extra)
    assert [(field.name, field.offset, field.datatype, field.count) for field in message.fields[4:]] == [
        ('opacity', 16, FLOAT32, 1), ('radius', 20, FLOAT32, 1)
    ]  # fmt: skip
    assert (message.point_step, message.row_step) == (24, 72)
    records = np.frombuffer(bytes(message.data), '<f4').reshape(3, 6)
    assert_array_equal(records[:, 4:], np.stack([*extra.values()], axis=-1))
    assert_array_equal(read_cloud(message)[0], points)
    assert_array_equal(read_cloud(message)[1], rgb)


def test_a_field_of_another_length_is_not_sent(factory):
    with pytest.raises(MessageError, match=r'radius has shape \(2,\); expected one value for each of the 3 points'):
        cloud_message(factory, *random_cloud(3), 0, 'map', {'radius': np.zeros(2, np.float32)})


@pytest.mark.parametrize(('value', 'is_dense'), [(1.0, True), (np.nan, False), (np.inf, False)])
def test_points_that_are_not_finite_are_said(factory, value, is_dense):
    points = np.array([[0, 0, value]], np.float32)
    assert cloud_message(factory, points, np.zeros((1, 3), np.uint8), 0, 'map').is_dense is is_dense


def padded_organised_cloud(factory, points, rgb, order):
    """2 rows of 3 points with other fields between, padded rows, and rgb as an integer."""
    dtype = np.dtype(
        {
            'names': ['z', 'rgb', 'x', 'y'], 'formats': [f'{order}f4', f'{order}u4', f'{order}f4', f'{order}f4'],
            'offsets': [2, 7, 12, 20], 'itemsize': 25,
        }
    )  # fmt: skip
    records = np.zeros(6, dtype)
    records['x'], records['y'], records['z'] = points.T
    records['rgb'] = rgb.astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    rows = np.hstack([np.frombuffer(records.tobytes(), np.uint8).reshape(2, 75), np.full((2, 9), 7, np.uint8)])
    fields = [('z', 2, FLOAT32), ('rgb', 7, UINT32), ('x', 12, FLOAT32), ('y', 20, FLOAT32)]
    return factory.make(
        'sensor_msgs/msg/PointCloud2', header=header(factory, 0, 'map'), height=2, width=3,
        fields=[
            factory.make('sensor_msgs/msg/PointField', name=name, offset=offset, datatype=datatype, count=1)
            for name, offset, datatype in fields
        ],
        is_bigendian=order == '>', point_step=25, row_step=84, data=rows.reshape(-1), is_dense=True,
    )  # fmt: skip


@pytest.mark.parametrize('order', ['<', '>'])
def test_clouds_of_other_publishers(factory, order):
    points, rgb = random_cloud(6)
    read_points, read_rgb = read_cloud(padded_organised_cloud(factory, points, rgb, order))
    assert_array_equal(read_points, points)
    assert_array_equal(read_rgb, rgb)


@pytest.mark.parametrize(
    ('field', 'changes'),
    [(0, {'name': 'a'}), (3, {'name': 'intensity'}), (1, {'datatype': FLOAT64}), (2, {'offset': 13})],
)
def test_fields_that_are_missing_or_of_another_type_are_an_error(factory, field, changes):
    message = cloud_message(factory, *random_cloud(2), 0, 'map')
    for name, value in changes.items():
        setattr(message.fields[field], name, value)
    with pytest.raises(MessageError, match='expected x, y, z, rgb'):
        read_cloud(message)


@pytest.mark.parametrize('changes', [{'width': 3}, {'row_step': 31}, {'height': 2}])
def test_truncated_clouds_are_an_error(factory, changes):
    message = cloud_message(factory, *random_cloud(2), 0, 'map')
    for name, value in changes.items():
        setattr(message, name, value)
    with pytest.raises(MessageError, match='truncated'):
        read_cloud(message)


@pytest.mark.parametrize(
    ('points', 'rgb'),
    [
        (np.zeros((2, 3)), np.zeros((3, 3), np.uint8)),
        (np.zeros((2, 2)), np.zeros((2, 2), np.uint8)),
        (np.zeros((2, 3)), np.zeros((2, 3), np.float32)),
        (np.zeros((2, 3, 1)), np.zeros((2, 3, 1), np.uint8)),
    ],
)
def test_arrays_of_another_shape_or_type_are_not_sent(factory, points, rgb):
    with pytest.raises(MessageError, match='expected'):
        cloud_message(factory, points, rgb, 0, 'map')
