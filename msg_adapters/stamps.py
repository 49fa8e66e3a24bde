"""Converts ROS times to integer nanoseconds and back, and makes headers."""

from __future__ import annotations

import struct
from typing import Any

from msg_adapters.errors import MessageError
from msg_adapters.factory import MessageFactory

NANOSECONDS = 1_000_000_000


def to_ns(stamp: Any) -> int:
    """Convert a ``builtin_interfaces/Time`` to nanoseconds.

    Raises:
        MessageError: seconds or nanoseconds are out of range.
    """
    return _checked_ns(int(stamp.sec), int(stamp.nanosec))


def _checked_ns(sec: int, nanosec: int) -> int:
    if not (-(2**31) <= sec < 2**31 and 0 <= nanosec < NANOSECONDS):
        raise MessageError(
            f'stamp with sec {sec} and nanosec {nanosec}: sec must fit 32 bits, nanosec be from 0 to {NANOSECONDS - 1}; '
            'the driver stamps wrongly'
        )
    return sec * NANOSECONDS + nanosec


def from_ns(stamp_ns: int) -> tuple[int, int]:
    """Convert nanoseconds to ``(sec, nanosec)`` with nanosec in [0, 1e9).

    Raises:
        MessageError: the seconds do not fit ROS's 32 bits.
    """
    sec, nanosec = divmod(int(stamp_ns), NANOSECONDS)
    if not -(2**31) <= sec < 2**31:
        raise MessageError(f'stamp {stamp_ns} ns: ROS stamps hold 32-bit seconds; is it in nanoseconds?')
    return sec, nanosec


def message_stamp_ns(message: Any) -> int:
    """Returns the stamp of a message's header in nanoseconds.

    Raises:
        MessageError: seconds or nanoseconds are out of range.
    """
    return to_ns(message.header.stamp)


def serialized_stamp_ns(data: bytes) -> int:
    """Returns the stamp at the beginning of a serialized message in nanoseconds, without decoding the rest.

    Args:
        data: CDR bytes of a message whose first field is a ``std_msgs/Header`` or a ``builtin_interfaces/Time``.

    Raises:
        MessageError: there are too few bytes, or the stamp is out of range.
    """
    if len(data) < 12:
        raise MessageError(f'has {len(data)} bytes, too few for a header')
    byte_order = '<' if data[1] & 1 else '>'  # second of the four bytes of the CDR encapsulation
    seconds, nanoseconds = struct.unpack_from(f'{byte_order}iI', data, 4)
    return _checked_ns(seconds, nanoseconds)


def header(factory: MessageFactory, stamp_ns: int, frame_id: str) -> Any:
    """Make a ``std_msgs/Header``."""
    return factory.make('std_msgs/msg/Header', stamp=time_message(factory, stamp_ns), frame_id=frame_id)


def time_message(factory: MessageFactory, stamp_ns: int) -> Any:
    """Make a ``builtin_interfaces/Time``."""
    sec, nanosec = from_ns(stamp_ns)
    return factory.make('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec)
