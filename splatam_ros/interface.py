"""The node's inputs, shared outputs and coordinate frames, for the documentation.

The topics below the node's name are in ``node/outputs.py``, the parameters in ``node/parameters.py``; add new ones there.
``tools/ros_reference.py`` writes all of these tables into docs/ros.md. A test compares them with a running node.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Topic:
    """A topic that the node publishes or subscribes to.

    Attributes:
        name: name before remapping.
        type_name: e.g. ``sensor_msgs/msg/Image``.
        help: one line for the documentation.
        when: when it is published; empty for inputs.
    """

    name: str
    type_name: str
    help: str
    when: str = ''


@dataclass(frozen=True)
class Frame:
    """A coordinate frame.

    Attributes:
        default: default name.
        parameter: parameter that sets the name.
        help: meaning of the frame, and who publishes the transform from its parent.
    """

    default: str
    parameter: str
    help: str


INPUTS = (
    Topic('rgb/image', 'sensor_msgs/msg/Image', 'colour image'),
    Topic('rgb/image/compressed', 'sensor_msgs/msg/CompressedImage', 'replaces `rgb/image` with `rgb_transport: compressed`'),
    Topic('depth/image', 'sensor_msgs/msg/Image', 'depth image, registered to colour'),
    Topic('depth/image/compressedDepth', 'sensor_msgs/msg/CompressedImage',
          'replaces `depth/image` with `depth_transport: compressedDepth`'),
    Topic('rgb/camera_info', 'sensor_msgs/msg/CameraInfo', 'calibration of the colour camera'),
    Topic('odom', 'nav_msgs/msg/Odometry', 'odometry from which tracking starts, with `odom.source: topic`'),
    Topic('initialpose', 'geometry_msgs/msg/PoseWithCovarianceStamped',
          "where the robot is in `map_frame`, told by a person (RViz's 2D Pose Estimate); without a base, where the camera is and "
          'looks to'),
    Topic('imu', 'sensor_msgs/msg/Imu', 'gravity while the camera rests, with `grid.imu`'),
    Topic('/tf_static', 'tf2_msgs/msg/TFMessage', 'pose of the camera in the base; which frames already have a parent'),
    Topic('/tf', 'tf2_msgs/msg/TFMessage', 'odometry from which tracking starts, with `odom.source: tf`'),
)  # fmt: skip

SHARED_OUTPUTS = (
    Topic('~/processed', 'std_msgs/msg/Header', 'stamp of a frame for which nothing more is published',
          'with every frame, also lost ones'),
    Topic('/tf', 'tf2_msgs/msg/TFMessage', 'see Frames',
          'with every tracked frame, and map to odom with every frame, if `publish_tf`'),
    Topic('/tf_static', 'tf2_msgs/msg/TFMessage', 'base to camera, from `camera_in_base`; latched',
          'with the first pose, if `publish_tf` and no one else publishes it'),
    Topic('/diagnostics', 'diagnostic_msgs/msg/DiagnosticArray', 'statuses input, tracking, processing and map',
          'at 1 Hz of the steady clock'),
)  # fmt: skip

FRAMES = (
    Frame('map', 'map_frame',
          'fixed frame: the first camera, in optical axes; with `world_up: z_up` the first base (the first camera, if there '
          'is no base), x forward and z up'),
    Frame('odom', 'odom_frame',
          'equal to map, or with `odom.source` the frame in which the odometry drifts; map to odom: published by this node'),
    Frame('empty', 'base_frame', 'the robot; odom to base: published by this node, or with `odom.source` by the odometry'),
    Frame("the images' frame id", 'camera_frame',
          'optical frame of the camera; base to camera: published on /tf_static by the robot, or with `camera_in_base` by '
          'this node; without a base, odom to camera: published by this node'),
)  # fmt: skip
