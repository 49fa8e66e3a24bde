"""What the node is to the outside besides ``OUTPUTS`` and ``NODE_SETTINGS``: topics and frames, for the documentation.

``tools/ros_reference.py`` writes these tables into docs/ros.md; a test holds them against a running node.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Topic:
    """A topic the node publishes or subscribes to.

    Attributes:
        name: before remapping.
        type_name: e.g. ``sensor_msgs/msg/Image``.
        help: what it is for.
        when: when there are messages; empty for inputs.
    """

    name: str
    type_name: str
    help: str
    when: str = ''


@dataclass(frozen=True)
class Frame:
    """A coordinate frame.

    Attributes:
        default: its name where nobody says otherwise.
        parameter: that names it.
        help: what it is, and who publishes the transform from its parent.
    """

    default: str
    parameter: str
    help: str


INPUTS = (
    Topic('rgb/image', 'sensor_msgs/msg/Image', 'colour'),
    Topic('rgb/image/compressed', 'sensor_msgs/msg/CompressedImage', 'instead, with `rgb_transport: compressed`'),
    Topic('depth/image', 'sensor_msgs/msg/Image', 'depth, registered to colour'),
    Topic('depth/image/compressedDepth', 'sensor_msgs/msg/CompressedImage',
          'instead, with `depth_transport: compressedDepth`'),
    Topic('rgb/camera_info', 'sensor_msgs/msg/CameraInfo', 'of the colour camera'),
    Topic('odom', 'nav_msgs/msg/Odometry', 'where to start tracking from, with `odom.source: topic`'),
    Topic('/tf_static', 'tf2_msgs/msg/TFMessage', 'where the camera is in the base, and which frames have a parent'),
    Topic('/tf', 'tf2_msgs/msg/TFMessage', 'where to start tracking from, with `odom.source: tf`'),
)  # fmt: skip

OUTPUTS = (
    Topic('~/processed', 'std_msgs/msg/Header', 'the stamp of a frame that is done with', 'every frame, lost ones too'),
    Topic('/tf', 'tf2_msgs/msg/TFMessage', 'see Frames', 'with every pose, with `publish_tf`'),
    Topic('/tf_static', 'tf2_msgs/msg/TFMessage', 'base to camera, from `camera_in_base`; latched',
          'with `publish_tf`, where nobody else has it'),
    Topic('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray', 'input, tracking, processing, map',
          '1 Hz, steady clock'),
)  # fmt: skip

FRAMES = (
    Frame('map', 'map_frame',
          'fixed: the first camera, optical axes; or with `world_up: z_up` where the base, or without one the first '
          'camera, began, x forward and z up'),
    Frame('odom', 'odom_frame',
          'the same as map, or with `odom.source` what the odometry drifts in; from map: this node'),
    Frame('empty', 'base_frame', 'the robot; from odom: this node, or with `odom.source` the odometry'),
    Frame("the images' frame", 'camera_frame',
          "the optical frame of the camera; from base: the robot's /tf_static, or this node with `camera_in_base`; "
          'from odom, without a base: this node'),
)  # fmt: skip
