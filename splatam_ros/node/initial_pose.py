"""Receives where a person says that the robot is: RViz's "2D Pose Estimate" on the topic ``initialpose``."""

from __future__ import annotations

from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.node import Node

from msg_adapters import poses
from msg_adapters.errors import MessageError
from splatam_core.worker import SlamWorker
from splatam_ros.node.map_lifecycle import MapLifecycle

TOPIC = 'initialpose'


class InitialPose:
    """Subscribes to ``initialpose``; the next frame is tried there."""

    def __init__(self, node: Node, worker: SlamWorker, lifecycle: MapLifecycle) -> None:
        """Subscribe.

        Args:
            node: the node that subscribes.
            worker: passes the pose on between two frames.
            lifecycle: receives the pose.
        """
        self._node, self._worker, self._lifecycle = node, worker, lifecycle
        self._subscription = node.create_subscription(PoseWithCovarianceStamped, TOPIC, self._receive, 10)

    def _receive(self, message: PoseWithCovarianceStamped) -> None:
        try:
            T_map_body = poses.pose_matrix(message.pose.pose)
        except MessageError as error:
            self._node.get_logger().warning(f'{TOPIC} is refused: {error}')
            return
        frame_id = message.header.frame_id.removeprefix('/')
        self._worker.call(lambda _: self._lifecycle.suggest(frame_id, T_map_body))
