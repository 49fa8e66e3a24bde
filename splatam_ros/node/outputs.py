"""What the node publishes: a table, one row a topic. A new output is a function and a row."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from msg_adapters import images, point_clouds, poses, stamps
from msg_adapters.factory import MessageFactory, RclpyMessages
from splatam_core.slam import Slam
from splatam_core.types import FrameResult, RenderedView
from splatam_ros.frames.covariance import Motion, MotionEstimator
from splatam_ros.frames.geometry import Geometry
from splatam_ros.frames.rep105 import Located
from splatam_ros.node.parameters import NodeOptions
from splatam_ros.player.recording import message_class

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

    located: Located
    T_world_cam: Matrix
    motion: Motion
    slam: Slam
    path: PathHistory
    options: NodeOptions
    factory: MessageFactory

    @property
    def stamp_ns(self) -> int:
        """Of the frame."""
        return self.located.stamp_ns

    @cached_property
    def view(self) -> RenderedView:
        """The map as the camera should see it; one render serves all three images."""
        return self.slam.render(self.T_world_cam)

    @cached_property
    def pose(self) -> Any:
        """The camera in the map, as a message; the path is made of these."""
        return poses.pose_stamped(self.factory, self.located.T_map_camera, self.stamp_ns, self.options.map_frame)


@dataclass(frozen=True)
class Output:
    """A row of the table.

    Attributes:
        topic: below the node's name.
        type_name: e.g. ``nav_msgs/msg/Path``.
        qos: of the publisher.
        trigger: when it is due.
        message: makes the message.
        help: what it is, for the documentation.
        rate: gives the most messages a second, 0 = no limit.
    """

    topic: str
    type_name: str
    qos: QoSProfile
    trigger: Trigger
    message: Callable[[Moment], Any]
    help: str
    rate: Callable[[NodeOptions], float] = lambda options: 0.0


def _pose(moment: Moment) -> Any:
    return moment.pose


def _odometry(moment: Moment) -> Any:
    located, motion = moment.located, moment.motion
    return poses.odometry(
        moment.factory, located.T_map_body, moment.stamp_ns, moment.options.map_frame, located.body_frame,
        pose_covariance=motion.pose_covariance, twist=motion.twist, twist_covariance=motion.twist_covariance,
    )  # fmt: skip


def _path(moment: Moment) -> Any:
    return poses.path(moment.factory, moment.path.poses, moment.stamp_ns, moment.options.map_frame)


def _rgb(moment: Moment) -> Any:
    return images.color_message(moment.factory, moment.view.rgb, moment.stamp_ns, moment.located.camera_frame)


def _depth(moment: Moment) -> Any:
    return images.depth_message(moment.factory, moment.view.depth_m, moment.stamp_ns, moment.located.camera_frame)


def _silhouette(moment: Moment) -> Any:
    gray = np.rint(np.clip(moment.view.silhouette, 0, 1) * 255).astype(np.uint8)
    return images.mono_message(moment.factory, gray, moment.stamp_ns, moment.located.camera_frame)


def _cloud(moment: Moment) -> Any:
    snapshot = moment.slam.snapshot()
    count = len(snapshot.means)
    kept = np.linspace(0, count - 1, min(count, moment.options.max_cloud_points)).astype(np.int64)
    rgb = np.rint(np.clip(snapshot.rgb[kept], 0, 1) * 255).astype(np.uint8)
    R, t = (part.astype(np.float32) for part in (moment.located.T_map_world[:3, :3], moment.located.T_map_world[:3, 3]))
    extra = {'opacity': snapshot.opacities[kept], 'radius': np.exp(snapshot.log_scales[kept].max(axis=1))}
    return point_clouds.cloud_message(
        moment.factory, snapshot.means[kept] @ R.T + t, rgb, moment.stamp_ns, moment.options.map_frame, extra
    )


OUTPUTS = (
    Output('pose', 'geometry_msgs/msg/PoseStamped', POSE_QOS, Trigger.POSE, _pose, 'the camera in the map'),
    Output('odometry', 'nav_msgs/msg/Odometry', POSE_QOS, Trigger.POSE, _odometry,
           'the base, or without one the camera, in the map; with velocity and covariance, see below'),
    Output('path', 'nav_msgs/msg/Path', LATCHED_QOS, Trigger.LISTENER, _path,
           'all poses so far, thinned out evenly beyond `max_path_poses`; latched', lambda o: o.publish_rate_path),
    Output('render/rgb', 'sensor_msgs/msg/Image', IMAGE_QOS, Trigger.LISTENER, _rgb,
           'the map as the camera should see it', lambda o: o.publish_rate_render),
    Output('render/depth', 'sensor_msgs/msg/Image', IMAGE_QOS, Trigger.LISTENER, _depth,
           'its depth, 32FC1, metres; 0 where the silhouette is below 0.5', lambda o: o.publish_rate_render),
    Output('render/silhouette', 'sensor_msgs/msg/Image', IMAGE_QOS, Trigger.LISTENER, _silhouette,
           'how sure the map is, mono8', lambda o: o.publish_rate_render),
    Output('map/points', 'sensor_msgs/msg/PointCloud2', LATCHED_QOS, Trigger.LISTENER, _cloud,
           'centres of the Gaussians, x y z rgb opacity radius, evenly thinned out beyond `max_cloud_points`; latched',
           lambda o: o.publish_rate_cloud),
)  # fmt: skip


class PathHistory:
    """All poses so far, as messages, thinned out evenly once there are too many; the newest is always there."""

    def __init__(self, max_poses: int) -> None:
        self._max_poses = max_poses
        self._stride = 1
        self._count = 0
        self._kept: list[Any] = []
        self._newest: Any = None

    def append(self, pose: Any) -> None:
        """Take a pose."""
        self._newest = pose
        if self._count % self._stride == 0:
            self._kept.append(pose)
        self._count += 1
        if len(self._kept) >= self._max_poses:  # the newest may come on top
            self._kept = self._kept[::2]
            self._stride *= 2

    @property
    def poses(self) -> list[Any]:
        """The poses, in order."""
        ends_with_newest = self._newest is None or (self._kept and self._kept[-1] is self._newest)
        return list(self._kept) if ends_with_newest else [*self._kept, self._newest]


class Outputs:
    """The publishers of a node. Publishing belongs to the worker's thread.

    Attributes:
        num_poses: poses published so far.
    """

    def __init__(self, node: Node, options: NodeOptions, geometry: Geometry) -> None:
        self.num_poses = 0
        self._node = node
        self._options = options
        self._geometry = geometry
        self._factory = RclpyMessages()
        self._publishers = [(output, self._create(output.type_name, output.topic, output.qos)) for output in OUTPUTS]
        self._processed = self._create('std_msgs/msg/Header', 'processed', POSE_QOS)
        self.forget()

    def use(self, options: NodeOptions) -> None:
        """Take other rates and limits from now on; for any thread."""
        self._options = options

    def forget(self) -> None:
        """Start anew: poses and map so far have nothing to do with those to come."""
        self._geometry.frames.reset()
        self._path = PathHistory(self._options.max_path_poses)
        self._motion = MotionEstimator(self._options.stddev_position, self._options.stddev_orientation)
        self._moment: Moment | None = None
        self._due_s: dict[str, float] = {}
        self._said_ns: dict[str, int] = {}

    def interrupt(self) -> None:
        """The next pose is of another time: there is no velocity from the last one to it."""
        self._motion.lost()

    def publish(self, result: FrameResult, slam: Slam) -> None:
        """Publish what is due for a frame, all with its stamp; of a lost frame only that it is done.

        Args:
            result: of the frame.
            slam: as it is after the frame.
        """
        if result.T_world_cam is None:
            self._motion.lost()
        elif self._node.context.ok():
            located = self._geometry.frames.locate(result.stamp_ns, result.T_world_cam, self._geometry.camera_frame)
            if located is not None:
                self._publish(located, result, slam)
        self.done(result.stamp_ns)

    def done(self, stamp_ns: int) -> None:
        """Say on ``~/processed`` that nothing more will come of the frame of this stamp."""
        if self._node.context.ok():
            self._processed.publish(stamps.header(self._factory, stamp_ns, self._options.map_frame))

    @property
    def is_behind(self) -> bool:
        """Whether somebody listens to a latched topic who has not been told the newest."""
        moment, now_s = self._moment, time.monotonic()
        return moment is not None and any(
            output.qos is LATCHED_QOS
            and self._said_ns.get(output.topic) != moment.stamp_ns
            and self._is_due(output, publisher, now_s)
            for output, publisher in self._publishers
        )

    def catch_up(self) -> None:
        """Tell them: they may have come after the last frame."""
        if self._moment is not None and self._node.context.ok() and self.is_behind:
            self._publish_due(self._moment, [row for row in self._publishers if row[0].qos is LATCHED_QOS])

    def _publish(self, located: Located, result: FrameResult, slam: Slam) -> None:
        motion = self._motion.observe(located, result)
        self._moment = Moment(located, result.T_world_cam, motion, slam, self._path, self._options, self._factory)
        self._path.append(self._moment.pose)
        self._geometry.publish(located)
        self._publish_due(self._moment, self._publishers)
        self.num_poses += 1

    def _publish_due(self, moment: Moment, rows: Sequence[tuple[Output, Publisher]]) -> None:
        now_s = time.monotonic()  # one for all: renders of one rate are of one frame
        for output, publisher in rows:
            if self._is_due(output, publisher, now_s):
                rate_hz = output.rate(self._options)
                self._due_s[output.topic] = now_s + (1 / rate_hz if rate_hz else 0.0)
                self._said_ns[output.topic] = moment.stamp_ns
                publisher.publish(output.message(moment))

    def _create(self, type_name: str, topic: str, qos: QoSProfile) -> Publisher:
        return self._node.create_publisher(message_class(type_name), f'~/{topic}', qos)

    def _is_due(self, output: Output, publisher: Publisher, now_s: float) -> bool:
        is_wanted = output.trigger is Trigger.POSE or publisher.get_subscription_count() > 0
        return is_wanted and now_s >= self._due_s.get(output.topic, 0.0)
