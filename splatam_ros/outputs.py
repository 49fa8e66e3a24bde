"""What the node publishes: a table, one row a topic. A new output is a function and a row."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import Any

import numpy as np
import rclpy
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from msg_adapters import images, point_clouds, poses, stamps
from msg_adapters.factory import MessageFactory, RclpyMessages
from splatam_core.slam import Slam
from splatam_core.types import FrameResult, RenderedView
from splatam_ros.parameters import NodeOptions
from splatam_ros.recording import message_class

Matrix = NDArray[np.float64]


def _qos(depth: int, durability: DurabilityPolicy = DurabilityPolicy.VOLATILE) -> QoSProfile:
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=durability)


POSE_QOS = _qos(10)
IMAGE_QOS = _qos(2)
LATCHED_QOS = _qos(1, DurabilityPolicy.TRANSIENT_LOCAL)


class Trigger(Enum):
    """When an output is due."""

    POSE = 'with every pose'
    LISTENER = 'with every pose, when somebody listens, at most at its rate'


@dataclass
class Moment:
    """A tracked frame, and what can be made of it; made when first asked for."""

    stamp_ns: int
    T_world_cam: Matrix
    camera_frame: str
    slam: Slam
    path: Sequence[tuple[int, Matrix]]
    options: NodeOptions
    factory: MessageFactory

    @cached_property
    def view(self) -> RenderedView:
        """The map as the camera should see it; one render serves all three images."""
        return self.slam.render(self.T_world_cam)


@dataclass(frozen=True)
class Output:
    """A row of the table.

    Attributes:
        topic: below the node's name.
        type_name: e.g. ``nav_msgs/msg/Path``.
        qos: of the publisher.
        trigger: when it is due.
        message: makes the message.
        rate: gives the most messages a second, 0 = no limit.
    """

    topic: str
    type_name: str
    qos: QoSProfile
    trigger: Trigger
    message: Callable[[Moment], Any]
    rate: Callable[[NodeOptions], float] = lambda options: 0.0


def _pose(moment: Moment) -> Any:
    return poses.pose_stamped(moment.factory, moment.T_world_cam, moment.stamp_ns, moment.options.map_frame)


def _odometry(moment: Moment) -> Any:
    return poses.odometry(
        moment.factory, moment.T_world_cam, moment.stamp_ns, moment.options.map_frame, moment.camera_frame
    )


def _path(moment: Moment) -> Any:
    return poses.path(moment.factory, moment.path, moment.stamp_ns, moment.options.map_frame)


def _rgb(moment: Moment) -> Any:
    return images.color_message(moment.factory, moment.view.rgb, moment.stamp_ns, moment.camera_frame)


def _depth(moment: Moment) -> Any:
    return images.depth_message(moment.factory, moment.view.depth_m, moment.stamp_ns, moment.camera_frame)


def _silhouette(moment: Moment) -> Any:
    gray = np.rint(np.clip(moment.view.silhouette, 0, 1) * 255).astype(np.uint8)
    return images.mono_message(moment.factory, gray, moment.stamp_ns, moment.camera_frame)


def _cloud(moment: Moment) -> Any:
    snapshot = moment.slam.snapshot()
    count = len(snapshot.means)
    kept = np.linspace(0, count - 1, min(count, moment.options.max_cloud_points)).astype(np.int64)
    rgb = np.rint(np.clip(snapshot.rgb[kept], 0, 1) * 255).astype(np.uint8)
    return point_clouds.cloud_message(
        moment.factory, snapshot.means[kept], rgb, moment.stamp_ns, moment.options.map_frame
    )


OUTPUTS = (
    Output('pose', 'geometry_msgs/msg/PoseStamped', POSE_QOS, Trigger.POSE, _pose),
    Output('odometry', 'nav_msgs/msg/Odometry', POSE_QOS, Trigger.POSE, _odometry),
    Output('path', 'nav_msgs/msg/Path', LATCHED_QOS, Trigger.LISTENER, _path, lambda o: o.publish_rate_path),
    Output('render/rgb', 'sensor_msgs/msg/Image', IMAGE_QOS, Trigger.LISTENER, _rgb, lambda o: o.publish_rate_render),
    Output('render/depth', 'sensor_msgs/msg/Image', IMAGE_QOS, Trigger.LISTENER, _depth,
           lambda o: o.publish_rate_render),
    Output('render/silhouette', 'sensor_msgs/msg/Image', IMAGE_QOS, Trigger.LISTENER, _silhouette,
           lambda o: o.publish_rate_render),
    Output('map/points', 'sensor_msgs/msg/PointCloud2', LATCHED_QOS, Trigger.LISTENER, _cloud,
           lambda o: o.publish_rate_cloud),
)  # fmt: skip


class PathHistory:
    """All poses so far, thinned out evenly once there are too many; the newest is always there."""

    def __init__(self, max_poses: int) -> None:
        self._max_poses = max_poses
        self._stride = 1
        self._count = 0
        self._kept: list[tuple[int, Matrix]] = []
        self._newest: tuple[int, Matrix] | None = None

    def append(self, stamp_ns: int, T_world_cam: Matrix) -> None:
        """Take a pose."""
        self._newest = stamp_ns, T_world_cam
        if self._count % self._stride == 0:
            self._kept.append(self._newest)
        self._count += 1
        if len(self._kept) >= self._max_poses:  # the newest may come on top
            self._kept = self._kept[::2]
            self._stride *= 2

    @property
    def poses(self) -> list[tuple[int, Matrix]]:
        """Stamps (ns) and poses, in order."""
        ends_with_newest = self._newest is None or (self._kept and self._kept[-1] is self._newest)
        return list(self._kept) if ends_with_newest else [*self._kept, self._newest]


class Outputs:
    """The publishers of a node. Publishing belongs to the worker's thread."""

    def __init__(self, node: Node, options: NodeOptions) -> None:
        self._node = node
        self._options = options
        self._factory = RclpyMessages()
        self._path = PathHistory(options.max_path_poses)
        self._publishers = [(output, self._create(output.type_name, output.topic, output.qos)) for output in OUTPUTS]
        self._processed = self._create('std_msgs/msg/Header', 'processed', POSE_QOS)
        self._due_s: dict[str, float] = {}

    def publish(self, result: FrameResult, slam: Slam, camera_frame: str) -> None:
        """Publish what is due for a frame, all with its stamp; of a lost frame only that it is done.

        Args:
            result: of the frame.
            slam: as it is after the frame.
            camera_frame: frame id of the camera.
        """
        if result.T_world_cam is not None and rclpy.ok():
            self._path.append(result.stamp_ns, result.T_world_cam)
            moment = Moment(result.stamp_ns, result.T_world_cam, camera_frame, slam, self._path.poses, self._options,
                            self._factory)  # fmt: skip
            now_s = time.monotonic()  # one for all: renders of one rate are of one frame
            for output, publisher in self._publishers:
                if self._is_due(output, publisher, now_s):
                    publisher.publish(output.message(moment))
        self.done(result.stamp_ns)

    def done(self, stamp_ns: int) -> None:
        """Say on ``~/processed`` that nothing more will come of the frame of this stamp."""
        if rclpy.ok():
            self._processed.publish(stamps.header(self._factory, stamp_ns, self._options.map_frame))

    def _create(self, type_name: str, topic: str, qos: QoSProfile) -> Publisher:
        return self._node.create_publisher(message_class(type_name), f'~/{topic}', qos)

    def _is_due(self, output: Output, publisher: Publisher, now_s: float) -> bool:
        if output.trigger is Trigger.POSE:
            return True
        rate_hz = output.rate(self._options)
        if publisher.get_subscription_count() == 0 or now_s < self._due_s.get(output.topic, 0.0):
            return False
        self._due_s[output.topic] = now_s + (1 / rate_hz if rate_hz else 0.0)
        return True
