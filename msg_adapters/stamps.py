"""ROS times as integer nanoseconds, and the headers that carry them."""

from __future__ import annotations

from typing import Any

from msg_adapters.errors import MessageError
from msg_adapters.factory import MessageFactory

NANOSECONDS = 1_000_000_000


def to_ns(stamp: Any) -> int:
    """Nanoseconds of a ``builtin_interfaces/Time``."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def from_ns(stamp_ns: int) -> tuple[int, int]:
    """``(sec, nanosec)`` of nanoseconds, with nanosec in [0, 1e9).

    Raises:
        MessageError: the seconds do not fit the 32 bits that ROS has for them.
    """
    sec, nanosec = divmod(int(stamp_ns), NANOSECONDS)
    if not -(2**31) <= sec < 2**31:
        raise MessageError(f'stamp {stamp_ns} ns: ROS stamps hold 32-bit seconds; is it in nanoseconds?')
    return sec, nanosec


def message_stamp_ns(message: Any) -> int:
    """Nanoseconds of a message's header stamp."""
    return to_ns(message.header.stamp)


def header(factory: MessageFactory, stamp_ns: int, frame_id: str) -> Any:
    """A ``std_msgs/Header``."""
    sec, nanosec = from_ns(stamp_ns)
    stamp = factory.make('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec)
    return factory.make('std_msgs/msg/Header', stamp=stamp, frame_id=frame_id)
