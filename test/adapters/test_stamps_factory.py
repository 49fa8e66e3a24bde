"""Stamps, headers, and the factories that make messages."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from msg_adapters import stamps
from msg_adapters.errors import MessageError
from msg_adapters.factory import RosbagsMessages, message_class


@given(st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1))
def test_a_stamp_splits_into_seconds_and_nanoseconds_without_loss(stamp_ns):
    sec, nanosec = stamps.from_ns(stamp_ns)
    assert 0 <= nanosec < 10**9
    assert sec * 10**9 + nanosec == stamp_ns


@pytest.mark.parametrize('stamp_ns', [-(2**31) * 10**9 - 1, 2**31 * 10**9])
def test_a_stamp_beyond_32_bit_seconds_is_an_error(stamp_ns):
    with pytest.raises(MessageError, match='32-bit'):
        stamps.from_ns(stamp_ns)


@pytest.mark.parametrize(('sec', 'nanosec'), [(2147483647, 4294967295), (1, 10**9), (0, 2**32 - 1)])
def test_a_stamp_out_of_range_is_an_error(factory, sec, nanosec):
    stamp = factory.make('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec)
    with pytest.raises(MessageError, match=f'stamp with sec {sec} and nanosec {nanosec}'):
        stamps.to_ns(stamp)
    header = factory.make('std_msgs/msg/Header', stamp=stamp, frame_id='')
    message = factory.make(
        'geometry_msgs/msg/PointStamped', header=header, point=factory.make('geometry_msgs/msg/Point', x=0.0, y=0.0, z=0.0)
    )
    with pytest.raises(MessageError, match='stamp with sec'):
        stamps.message_stamp_ns(message)
    with pytest.raises(MessageError, match='stamp with sec'):
        stamps.serialized_stamp_ns(b'\0\1\0\0' + struct.pack('<iI', sec, nanosec))


@pytest.mark.parametrize(
    'name', ['.x/msg/Foo', '..std_msgs/msg/Header', 'std_msgs/msg/', '/msg/Foo', 'a b/msg/C', 'std_msgs/msg/__name__',
             'std_msgs/msg/_header', 'std\0msgs/msg/A', 'x' * 5000 + '/msg/A']
)  # fmt: skip
def test_a_name_that_is_no_type_is_an_error(name):
    with pytest.raises(MessageError, match='message type'):
        message_class(name)


def test_a_header_keeps_stamp_and_frame(factory):
    pose = factory.make(
        'geometry_msgs/msg/PointStamped',
        header=stamps.header(factory, 1_305_031_102_175_304_000, 'camera'),
        point=factory.make('geometry_msgs/msg/Point', x=0.0, y=0.0, z=0.0),
    )
    assert stamps.message_stamp_ns(pose) == 1_305_031_102_175_304_000
    assert pose.header.frame_id == 'camera'


@pytest.mark.parametrize('is_little_endian', [True, False])
def test_the_stamp_of_a_serialized_message_is_read_without_decoding_it(is_little_endian):
    typestore = get_typestore(Stores.ROS2_JAZZY)
    factory = RosbagsMessages(typestore)
    point = factory.make(
        'geometry_msgs/msg/PointStamped',
        header=stamps.header(factory, -1_304_031_102_175_304_001, 'camera'),
        point=factory.make('geometry_msgs/msg/Point', x=0.0, y=0.0, z=0.0),
    )
    data = typestore.serialize_cdr(point, 'geometry_msgs/msg/PointStamped', little_endian=is_little_endian)
    assert stamps.serialized_stamp_ns(bytes(data)) == -1_304_031_102_175_304_001
    with pytest.raises(MessageError, match='has 11 bytes, too few for a header'):
        stamps.serialized_stamp_ns(bytes(data)[:11])


@pytest.mark.parametrize('type_name', ['no_such_msgs/msg/Thing', 'std_msgs/msg/NoSuchMessage', 'nonsense'])
def test_a_type_that_is_not_there_is_an_error_that_names_it(factory, type_name):
    with pytest.raises(MessageError, match=type_name):
        factory.make(type_name)
