"""Names and units in recordings of RealSense Viewer, which are ROS 1 bags with topics of their own.

::

    /device_0/sensor_0/Depth_0/image/data            # mono16 counts, not registered to colour
    /device_0/sensor_0/Depth_0/info/camera_info      # once
    /device_0/sensor_0/option/Depth_Units/value      # std_msgs/Float32, metres per count
    /device_0/sensor_1/Color_0/image/data
    /device_0/sensor_1/Color_0/info/camera_info

Source: librealsense, ``src/media/ros/ros_file_format.h``. Some versions put metres per count behind each image, as a float.
"""

from __future__ import annotations

import re
import struct

IMAGE_DATA, CAMERA_INFO = '/image/data', '/info/camera_info'
_IMAGE = re.compile(r'(/device_\d+/sensor_\d+)/(\w+)_\d+/image/data')
SHORTEST_UNIT_M, LONGEST_UNIT_M = 1e-6, 0.1


def is_color(topic: str) -> bool:
    """Returns True if a topic is the colour stream of a RealSense Viewer recording."""
    found = _IMAGE.fullmatch(topic)
    return found is not None and found[2] == 'Color'


def is_viewer(topic: str) -> bool:
    """Returns True if RealSense Viewer names image topics like this one."""
    return _IMAGE.fullmatch(topic) is not None


def unit_topic(topic: str) -> str | None:
    """Returns the topic with the unit of a depth topic; None for topics of other recorders."""
    found = _IMAGE.fullmatch(topic)
    return None if found is None else f'{found[1]}/option/Depth_Units/value'


def unit_m(data: bytes) -> float | None:
    """Returns the metres per count that four bytes hold; None if they hold something else."""
    if len(data) != 4:
        return None
    (unit,) = struct.unpack('<f', data)
    return float(f'{unit:.7g}') if SHORTEST_UNIT_M <= unit <= LONGEST_UNIT_M else None
