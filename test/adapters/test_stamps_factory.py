"""Stamps, headers, and the factories that make messages."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from msg_adapters import stamps
from msg_adapters.errors import MessageError


@given(st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1))
def test_a_stamp_splits_into_seconds_and_nanoseconds_without_loss(stamp_ns):
    sec, nanosec = stamps.from_ns(stamp_ns)
    assert 0 <= nanosec < 10**9
    assert sec * 10**9 + nanosec == stamp_ns


@pytest.mark.parametrize('stamp_ns', [-(2**31) * 10**9 - 1, 2**31 * 10**9])
def test_a_stamp_beyond_32_bit_seconds_is_an_error(stamp_ns):
    with pytest.raises(MessageError, match='32-bit'):
        stamps.from_ns(stamp_ns)


def test_a_header_keeps_stamp_and_frame(factory):
    pose = factory.make(
        'geometry_msgs/msg/PointStamped',
        header=stamps.header(factory, 1_305_031_102_175_304_000, 'camera'),
        point=factory.make('geometry_msgs/msg/Point', x=0.0, y=0.0, z=0.0),
    )
    assert stamps.message_stamp_ns(pose) == 1_305_031_102_175_304_000
    assert pose.header.frame_id == 'camera'


@pytest.mark.parametrize('type_name', ['no_such_msgs/msg/Thing', 'std_msgs/msg/NoSuchMessage', 'nonsense'])
def test_a_type_that_is_not_there_is_an_error_that_names_it(factory, type_name):
    with pytest.raises(MessageError, match=type_name):
        factory.make(type_name)
