"""Serializes and deserializes messages of the types that ROS 2 comes with."""

from __future__ import annotations

from functools import cache
from typing import Any

from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED_IMAGE = 'sensor_msgs/msg/CompressedImage'
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
FLOAT32 = 'std_msgs/msg/Float32'
POSE_STAMPED = 'geometry_msgs/msg/PoseStamped'
IMAGES = (IMAGE, COMPRESSED_IMAGE)


@cache
def ros2_types() -> Typestore:
    """Returns the message types of ROS 2 Jazzy; loading them takes a moment, so it is done once."""
    return get_typestore(Stores.ROS2_JAZZY)


def deserialize(type_name: str, data: bytes) -> Any:
    """Returns the message that CDR bytes hold; it has the same fields as rclpy's, with numpy arrays."""
    return ros2_types().deserialize_cdr(data, type_name)


def serialize(message: Any, type_name: str) -> memoryview:
    """Returns the CDR bytes of a message made of ``ros2_types``."""
    return ros2_types().serialize_cdr(message, type_name)
