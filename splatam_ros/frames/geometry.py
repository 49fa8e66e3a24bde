"""Everything about coordinate frames that a node needs, connected to its topics."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.node import Node

from splatam_ros.frames.buffer import TransformTree
from splatam_ros.frames.odometry_prior import OdometryInput, OdometryPrior
from splatam_ros.frames.rep105 import Frames, Located
from splatam_ros.frames.tf_topics import Tf
from splatam_ros.node.parameters import NodeOptions
from splatam_ros.throttled_warnings import ThrottledWarnings

NO_TF = (
    'tf2_msgs is not installed: nothing is published or heard on /tf and /tf_static; apt install ros-jazzy-tf2-msgs, '
    'make tf2_msgs, or set publish_tf to false'
)


class Geometry:
    """Frames, TF and the odometry of a node.

    Attributes:
        frames: where things are.
        odometry: subscription to ``odom``; None unless ``odom.source`` says so.
        prior: for the core; None without odometry.
    """

    def __init__(self, node: Node, options: NodeOptions, warnings: ThrottledWarnings, header_frame: Callable[[], str]) -> None:
        """Subscribe and advertise.

        Args:
            node: to do so with.
            options: the node's.
            warnings: says what cannot be used.
            header_frame: gives the frame id of the newest image; empty before the first.

        Raises:
            ConfigError: the parameters of the frames contradict each other.
        """
        tree = TransformTree()
        self._header_frame = header_frame
        self.frames = Frames(options, tree, warnings)
        by_tf = options.odom_source == 'tf'
        needs_tf = options.publish_tf or self.frames.looks_up or by_tf
        hears = needs_tf or self.frames.has_odometry
        self._tf = Tf(node, tree, warnings, hears=hears, hears_moving=by_tf, says=options.publish_tf)
        if needs_tf and not self._tf.is_available:
            node.get_logger().warning(NO_TF)
        self.odometry = OdometryInput(node, options, tree, warnings) if options.odom_source == 'topic' else None
        self.prior = (
            OdometryPrior(self.frames, lambda: self.camera_frame, options.odom_max_wait, warnings)
            if self.frames.has_odometry
            else None
        )
        self._fixed: set[tuple[str, str]] = set()

    @property
    def camera_frame(self) -> str:
        """Name of the camera's frame; empty before the first image."""
        return self.frames.camera_frame(self._header_frame())

    def publish(self, located: Located) -> None:
        """Publish the transforms that belong to a tracked camera."""
        self._tf.move(located.stamp_ns, self.frames.moving(located))
        fixed = self.frames.fixed(located.camera_frame)
        if fixed.keys() != self._fixed:
            self._tf.fix(located.stamp_ns, fixed)
            self._fixed = set(fixed)
