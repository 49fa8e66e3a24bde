"""Makes messages of rclpy's classes (to publish) or rosbags' (to write a bag).

The builders in this package name the message type and give every field; arrays are numpy arrays.
"""

from __future__ import annotations

import array
import importlib
import re
from collections.abc import Mapping
from functools import cache
from typing import Any, Protocol

import numpy as np

from msg_adapters.errors import MessageError

_NAME = re.compile(r'[A-Za-z]\w*', re.ASCII)


class MessageFactory(Protocol):
    """Makes messages of one library."""

    def make(self, type_name: str, **fields: Any) -> Any:
        """Make a message, e.g. ``make('geometry_msgs/msg/Point', x=0.0, y=0.0, z=1.0)``."""


class TypeStore(Protocol):
    """The part of rosbags' ``Typestore`` that is used here."""

    @property
    def types(self) -> Mapping[str, Any]:
        """Message classes by name."""


class RclpyMessages:
    """Makes the messages that rclpy publishes; their classes are imported when first needed."""

    def make(self, type_name: str, **fields: Any) -> Any:
        """Make a message.

        Raises:
            MessageError: the message's package is not installed, or has no such message.
        """
        values = {name: _rclpy_value(value) for name, value in fields.items()}
        return message_class(type_name)(**values)


class RosbagsMessages:
    """Makes the messages that a rosbags ``Typestore`` serializes."""

    def __init__(self, typestore: TypeStore) -> None:
        self._types = typestore.types

    def make(self, type_name: str, **fields: Any) -> Any:
        """Make a message.

        Raises:
            MessageError: the typestore does not know the type.
        """
        cls = self._types.get(type_name)
        if cls is None:
            raise MessageError(f"message type '{type_name}' is not in the typestore; register it first")
        return cls(**fields)


@cache
def message_class(type_name: str) -> type:
    """Import rclpy's class of a message type.

    Args:
        type_name: such as ``sensor_msgs/msg/Image``.

    Raises:
        MessageError: the message's package is not installed, or has no such message.
    """
    package, _, name = type_name.partition('/msg/')
    if not (_NAME.fullmatch(package) and _NAME.fullmatch(name)):
        raise MessageError(f"message type '{type_name}' is no name of a type; expected package/msg/Name")
    try:
        cls = getattr(importlib.import_module(f'{package}.msg'), name)
        if not isinstance(cls, type):
            raise AttributeError(f"'{package}.msg.{name}' is no class")
        return cls
    except (ImportError, AttributeError) as error:
        raise MessageError(
            f'message type {type_name} is not installed ({error}); source a ROS 2 workspace that has it, '
            "or pip install 'ros-jazzy-rclpy[fastrtps]' ros-jazzy-common-interfaces"
        ) from None


def _rclpy_value(value: Any) -> Any:
    """Convert numpy arrays to what rclpy's fields take; for bytes, anything but array.array is 10 to 1000 times slower."""
    if not isinstance(value, np.ndarray):
        return value
    if value.dtype not in (np.uint8, np.int8):
        return value.tolist()
    buffer = array.array('B' if value.dtype == np.uint8 else 'b')
    buffer.frombytes(np.ascontiguousarray(value).data)
    return buffer
