"""Connects the coordinate frames of a node to its topics: TF and odometry in, TF out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node

from splatam_core.types import RgbdFrame
from splatam_ros.frames.buffer import TransformBuffer
from splatam_ros.frames.gravity import GravitySubscription
from splatam_ros.frames.odometry_prior import OdometryPrior, OdometrySubscription
from splatam_ros.frames.options import FrameOptions
from splatam_ros.frames.rep105 import CoordinateFrames, Link, Located
from splatam_ros.frames.tf_topics import TfTopics
from splatam_ros.throttled_warnings import ThrottledWarnings

Matrix = NDArray[np.float64]

NO_TF = (
    'tf2_msgs is not installed: the node neither publishes nor receives /tf and /tf_static; '
    'apt install ros-jazzy-tf2-msgs, make tf2_msgs, or set publish_tf to false'
)


class RobotFrames:
    """Locates the camera in the coordinate frames of ROS and publishes their transforms.

    Attributes:
        odometry: subscription to ``odom``; None unless ``odom.source`` is ``topic``.
        prior: predicts the camera's motion from odometry, for the core; None without odometry.
    """

    def __init__(self, node: Node, options: FrameOptions, warnings: ThrottledWarnings, *, reliability: str, keep_all: bool) -> None:
        """Subscribe and advertise.

        Args:
            node: the node that subscribes and publishes.
            options: names and sources of the frames.
            warnings: receives a warning when a transform is missing or cannot be used.
            reliability: QoS reliability of the odometry subscription: auto, reliable or best_effort.
            keep_all: True to queue every odometry message.

        Raises:
            ConfigError: the options contradict each other.
        """
        buffer = TransformBuffer()
        self._up_world: Matrix | None = None
        self.begin_map()
        self._frames = CoordinateFrames(options, buffer, warnings)
        self._tf = TfTopics(node, options, buffer, warnings)
        if options.needs_tf_messages and not self._tf.is_available:
            node.get_logger().warning(NO_TF)
        self.odometry: OdometrySubscription | None = None
        if options.odom_source == 'topic':
            self.odometry = OdometrySubscription(
                node, options.odom_frame, buffer, warnings, reliability=reliability, keep_all=keep_all
            )
        self._gravity = GravitySubscription(node, buffer, warnings) if options.uses_imu else None
        self.prior: OdometryPrior | None = None
        if options.has_odometry:
            self.prior = OdometryPrior(self._frames, options.odom_max_wait_s, warnings)

    def camera_frame(self, frame_id: str) -> str:
        """Returns the name of the camera's frame, given the frame id of an image."""
        return self._frames.camera_frame(frame_id)

    def begin_frame(self, frame: RgbdFrame) -> None:
        """Call before a frame is tracked: the odometry prior predicts the motion of this frame's camera."""
        if self.prior is not None:
            self.prior.camera_frame = self._frames.camera_frame(frame.frame_id)

    def locate(
        self, frame: RgbdFrame, T_world_cam: Matrix, T_map_world: Matrix | None, T_world_odom: Matrix | None = None
    ) -> Located | None:
        """Express a tracked camera in the coordinate frames of ROS; see ``CoordinateFrames.locate``."""
        located = self._frames.locate(frame.stamp_ns, frame.frame_id, T_world_cam, T_map_world, T_world_odom)
        if located is None or self._gravity is None:
            return located
        if self._up_world is None and (up := self._gravity.up_in(located.camera_frame, frame.stamp_ns)) is not None:
            self._up_world = T_world_cam[:3, :3] @ up
        return replace(located, up_world=self._up_world)

    def told(self, frame: RgbdFrame, T_map_body: Matrix, T_map_world: Matrix | None) -> Matrix:
        """Returns where in the core's world a person says that the camera of a frame is; see ``CoordinateFrames.told``."""
        return self._frames.told(frame.stamp_ns, frame.frame_id, T_map_body, T_map_world)

    def begin_map(self) -> None:
        """Forget where the odometry is in the map, and which way is up: a new map begins."""
        self._held: dict[Link, Matrix] = {}
        self._held_at: Located | None = None
        self._up_world = None

    def publish(self, located: Located) -> None:
        """Publish the transforms of a tracked camera."""
        moving = self._frames.moving(located)
        if lasting := self._frames.lasting(moving):
            self._held, self._held_at = lasting, located
        self._tf.publish(located.stamp_ns, moving)
        self._tf.publish_static(located.stamp_ns, self._frames.static(located.camera_frame))

    def hold(self, stamp_ns: int, T_world_odom: Matrix) -> None:
        """Publish the last transform from map to odom once more, for a frame whose pose is uncertain or not known.

        Args:
            stamp_ns: stamp of the frame.
            T_world_odom: [4, 4] all corrections of the core's world so far: the map may have been corrected since.
        """
        if self._held_at is not None:
            self._tf.publish(stamp_ns, self._frames.corrected(self._held, self._held_at, T_world_odom))
