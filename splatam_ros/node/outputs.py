"""The topics that the node publishes, as a table. To add one, write a function and add a row to ``OUTPUTS``."""

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

from msg_adapters import images, markers, point_clouds, poses, stamps
from msg_adapters.factory import MessageFactory, RclpyMessages, message_class
from splatam_core.graph.keyframe_graph import KeyframeGraph
from splatam_core.slam import Slam
from splatam_core.types import FrameResult, RenderedView, RgbdFrame
from splatam_ros.frames.covariance import Motion, MotionEstimator
from splatam_ros.frames.rep105 import Located
from splatam_ros.frames.robot_frames import RobotFrames
from splatam_ros.node.floor_plan import FloorPlan
from splatam_ros.node.parameters import NodeOptions
from splatam_ros.throttled_warnings import ThrottledWarnings
from splatam_ros.viewer.feed import ViewerFeed

Matrix = NDArray[np.float64]


def _qos(depth: int, durability: DurabilityPolicy = DurabilityPolicy.VOLATILE) -> QoSProfile:
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=durability)


POSE_QOS = _qos(10)
IMAGE_QOS = _qos(2)
LATCHED_QOS = _qos(1, DurabilityPolicy.TRANSIENT_LOCAL)


class Trigger(Enum):
    """When an output is published, if someone subscribes."""

    TRACKED = 'with every tracked frame'
    POSE = 'with every tracked or uncertain frame'
    SUBSCRIBED = 'with every tracked frame while someone subscribes, limited by its rate'


@dataclass(eq=False)
class PublishContext:
    """A frame with a pose and everything that messages about it are made of. Costly parts are made when first used.

    Attributes:
        located: the camera in the coordinate frames of ROS.
        T_world_cam: [4, 4] camera to the core's world.
        motion: velocity and covariances.
        slam: SLAM in its state after the frame; the map may be rendered.
        path: all tracked poses so far.
        floor_plan: makes the occupancy grid.
        options: the node's options.
        factory: makes the messages.
        is_idle: whether no frame waits, so that a message may take its time.
    """

    located: Located
    T_world_cam: Matrix
    motion: Motion
    slam: Slam
    path: PathHistory
    floor_plan: FloorPlan
    options: NodeOptions
    factory: MessageFactory
    is_idle: bool = False

    @property
    def stamp_ns(self) -> int:
        """Stamp of the frame."""
        return self.located.stamp_ns

    @property
    def map_frame(self) -> str:
        """Coordinate frame of poses and map."""
        return self.options.map_frame

    @property
    def camera_frame(self) -> str:
        """Coordinate frame of the camera's images."""
        return self.located.camera_frame

    @cached_property
    def view(self) -> RenderedView:
        """The map rendered from the camera's pose; one render serves all three images."""
        return self.slam.render(self.T_world_cam)

    @cached_property
    def pose(self) -> Any:
        """The camera in the map, as a ``PoseStamped`` message; the path consists of these."""
        return poses.pose_stamped(self.factory, self.located.T_map_camera, self.stamp_ns, self.map_frame)


def _no_limit(options: NodeOptions) -> float:
    return 0.0


@dataclass(frozen=True)
class Output:
    """A row of the table.

    Attributes:
        topic: name below the node's name.
        type_name: e.g. ``nav_msgs/msg/Path``.
        qos: QoS of the publisher.
        trigger: when it is published.
        message: makes the message.
        help: one line for the documentation.
        rate_hz: returns the largest number of messages per second, 0 = no limit.
        nothing: makes the message that takes back what was published of a map that is gone; None = there is none.
    """

    topic: str
    type_name: str
    qos: QoSProfile
    trigger: Trigger
    message: Callable[[PublishContext], Any]
    help: str
    rate_hz: Callable[[NodeOptions], float] = _no_limit
    nothing: Callable[[PublishContext], Any] | None = None


def _pose(context: PublishContext) -> Any:
    return context.pose


def _odometry(context: PublishContext) -> Any:
    located, motion = context.located, context.motion
    return poses.odometry(
        context.factory, located.T_map_body, context.stamp_ns, context.map_frame, located.body_frame,
        pose_covariance=motion.pose_covariance, twist=motion.twist, twist_covariance=motion.twist_covariance,
    )  # fmt: skip


def _pose_with_covariance(context: PublishContext) -> Any:
    return poses.pose_with_covariance(
        context.factory, context.located.T_map_camera, context.motion.camera_covariance, context.stamp_ns, context.map_frame
    )


def _path(context: PublishContext) -> Any:
    return poses.path(context.factory, context.path.poses(context), context.stamp_ns, context.map_frame)


def _no_path(context: PublishContext) -> Any:
    return poses.path(context.factory, [], context.stamp_ns, context.map_frame)


def _no_graph(context: PublishContext) -> Any:
    none = np.empty((0, 2), np.intp)
    return markers.graph(context.factory, np.empty((0, 3)), none, none, stamp_ns=context.stamp_ns, frame_id=context.map_frame)


def _graph(context: PublishContext) -> Any:
    graph, T = context.slam.graph, context.located.T_map_world
    centres_m = graph.nodes.T_world_cam[:, :3, 3] @ T[:3, :3].T + T[:3, 3]
    return markers.graph(
        context.factory, centres_m, graph.pairs(loops=False), graph.pairs(loops=True),
        stamp_ns=context.stamp_ns, frame_id=context.map_frame,
    )  # fmt: skip


def _rgb(context: PublishContext) -> Any:
    return images.color_message(context.factory, context.view.rgb, context.stamp_ns, context.camera_frame)


def _depth(context: PublishContext) -> Any:
    return images.depth_message(context.factory, context.view.depth_m, context.stamp_ns, context.camera_frame)


def _silhouette(context: PublishContext) -> Any:
    gray = np.rint(np.clip(context.view.silhouette, 0, 1) * 255).astype(np.uint8)
    return images.mono_message(context.factory, gray, context.stamp_ns, context.camera_frame)


def _cloud(context: PublishContext) -> Any:
    snapshot = context.slam.snapshot()
    count = len(snapshot.means)
    kept = np.linspace(0, count - 1, min(count, context.options.max_cloud_points)).astype(np.int64)
    rgb = np.rint(np.clip(snapshot.rgb[kept], 0, 1) * 255).astype(np.uint8)
    T_map_world = context.located.T_map_world
    R, t = T_map_world[:3, :3].astype(np.float32), T_map_world[:3, 3].astype(np.float32)
    extra = {'opacity': snapshot.opacities[kept], 'radius': np.exp(snapshot.log_scales[kept].max(axis=1))}
    points = snapshot.means[kept] @ R.T + t  # [N, 3] in the map
    return point_clouds.cloud_message(context.factory, points, rgb, context.stamp_ns, context.map_frame, extra)


def _grid(context: PublishContext) -> Any:
    return context.floor_plan.message(
        context.slam, context.located, context.options, context.factory, is_complete=context.is_idle
    )  # fmt: skip


def _path_rate(options: NodeOptions) -> float:
    return options.publish_rate_path


def _render_rate(options: NodeOptions) -> float:
    return options.publish_rate_render


def _cloud_rate(options: NodeOptions) -> float:
    return options.publish_rate_cloud


def _grid_rate(options: NodeOptions) -> float:
    return options.publish_rate_grid


OUTPUTS = (
    Output('pose', 'geometry_msgs/msg/PoseStamped', POSE_QOS, Trigger.TRACKED, _pose, 'pose of the camera in the map'),
    Output('pose_with_covariance', 'geometry_msgs/msg/PoseWithCovarianceStamped', POSE_QOS, Trigger.POSE, _pose_with_covariance,
           'pose of the camera in the map, with its covariance, which is large while the pose is uncertain'),
    Output('odometry', 'nav_msgs/msg/Odometry', POSE_QOS, Trigger.POSE, _odometry,
           'pose of the base (of the camera, if there is no base) in the map, with velocity and covariances; see below'),
    Output('path', 'nav_msgs/msg/Path', LATCHED_QOS, Trigger.SUBSCRIBED, _path,
           'all tracked poses so far as corrected by loops, thinned out evenly beyond `max_path_poses`; latched',
           rate_hz=_path_rate, nothing=_no_path),
    Output('graph', 'visualization_msgs/msg/MarkerArray', LATCHED_QOS, Trigger.SUBSCRIBED, _graph,
           'keyframes, the edges between them, and loops: places that were recognised; latched', rate_hz=_path_rate,
           nothing=_no_graph),
    Output('render/rgb', 'sensor_msgs/msg/Image', IMAGE_QOS, Trigger.SUBSCRIBED, _rgb,
           'the map rendered from the pose of the camera', rate_hz=_render_rate),
    Output('render/depth', 'sensor_msgs/msg/Image', IMAGE_QOS, Trigger.SUBSCRIBED, _depth,
           'depth of that render, 32FC1 in metres; 0 where the silhouette is below 0.5', rate_hz=_render_rate),
    Output('render/silhouette', 'sensor_msgs/msg/Image', IMAGE_QOS, Trigger.SUBSCRIBED, _silhouette,
           'silhouette of that render, mono8: 255 where the map covers the pixel', rate_hz=_render_rate),
    Output('map/points', 'sensor_msgs/msg/PointCloud2', LATCHED_QOS, Trigger.SUBSCRIBED, _cloud,
           'centres of the Gaussians with x y z rgb opacity radius, thinned out evenly beyond `max_cloud_points`; latched',
           rate_hz=_cloud_rate),
    Output('map/grid', 'nav_msgs/msg/OccupancyGrid', LATCHED_QOS, Trigger.SUBSCRIBED, _grid,
           'floor plan: free, occupied or unknown, seen from above; latched; see below', rate_hz=_grid_rate),
)  # fmt: skip


@dataclass(slots=True, eq=False)
class _Place:
    """A pose of the path: the camera in the core's world as it was tracked, and as a message after the corrections so far.

    ``is_past`` says that it is where it will stay, because stamps began anew after it.
    """

    stamp_ns: int
    T_world_cam: Matrix
    message: Any
    is_past: bool = False


class PathHistory:
    """All poses so far. Beyond a maximum they are thinned out evenly; the newest is always included."""

    def __init__(self, max_poses: int) -> None:
        self._max_poses = max_poses
        self._stride = 1
        self._count = 0
        self._kept: list[_Place] = []
        self._newest: _Place | None = None
        self._num_corrections = 0

    def append(self, stamp_ns: int, T_world_cam: Matrix, message: Any) -> None:
        """Add a pose."""
        self._newest = _Place(stamp_ns, T_world_cam, message)
        if self._count % self._stride == 0:
            self._kept.append(self._newest)
        self._count += 1
        if len(self._kept) >= self._max_poses:  # ``poses`` may add the newest
            self._kept = self._kept[::2]
            self._stride *= 2

    def poses(self, context: PublishContext) -> list[Any]:
        """Returns the poses as messages, in order, as the graph of ``context.slam`` corrects them."""
        places, graph = self._places(), context.slam.graph
        if places and graph.num_corrections != self._num_corrections:
            for place, T_world_cam in zip(places, _corrected(places, graph)):
                T_map_cam = context.located.T_map_world @ T_world_cam
                place.message = poses.pose_stamped(context.factory, T_map_cam, place.stamp_ns, context.map_frame)
            self._num_corrections = graph.num_corrections
        return [place.message for place in places]

    def end_time(self, graph: KeyframeGraph) -> None:
        """Keep the poses so far where the graph has them now: it will not know them, because stamps begin anew."""
        places = self._places()
        for place, T_world_cam in zip(places, _corrected(places, graph)):
            place.T_world_cam, place.is_past = T_world_cam, True
        self._num_corrections = -1  # the messages are older

    def _places(self) -> list[_Place]:
        is_last = self._newest is None or (self._kept and self._kept[-1] is self._newest)
        return list(self._kept) if is_last or self._newest is None else [*self._kept, self._newest]


def _corrected(places: Sequence[_Place], graph: KeyframeGraph) -> Matrix:
    """Returns [N, 4, 4] where poses of the path are after all corrections."""
    result = np.array([place.T_world_cam for place in places]).reshape(-1, 4, 4)
    moves = np.array([not place.is_past for place in places], dtype=bool)
    stamps_ns = np.array([place.stamp_ns for place in places], dtype=np.int64)
    result[moves] = graph.corrected(stamps_ns[moves], result[moves])
    return result


class Outputs:
    """The publishers of a node. Publishes only; ``MapLifecycle`` decides about maps and time.

    ``publish_processed`` and ``use`` may be called from any thread, everything else from the worker's thread.

    Attributes:
        num_poses: number of poses published so far.
    """

    def __init__(self, node: Node, options: NodeOptions, frames: RobotFrames) -> None:
        """Advertise every topic.

        Args:
            node: the node that publishes.
            options: the node's options.
            frames: publish the transforms.

        Raises:
            ViewerError: the viewer is wanted, and not installed.
        """
        self.num_poses = 0
        self._newest: PublishContext | None = None
        self._node = node
        self._options = options
        self._frames = frames
        self._factory = RclpyMessages()
        self._publishers = [(output, self._create(output.type_name, output.topic, output.qos)) for output in OUTPUTS]
        self._processed = self._create('std_msgs/msg/Header', 'processed', POSE_QOS)
        self._floor_plan = FloorPlan(ThrottledWarnings(node.get_logger()))
        self._viewer: ViewerFeed | None = None
        if options.viewer_port:
            self._viewer = ViewerFeed.start(options.viewer_host, options.viewer_port, node.get_logger())
        self.begin_map()

    def use(self, options: NodeOptions) -> None:
        """Apply changed rates and limits."""
        self._options = options

    def begin_map(self) -> None:
        """Start a new map: drop the path, the velocity and what late subscribers would be sent; take back path and graph."""
        if self._newest is not None and self._node.context.ok():
            for output, publisher in self._publishers:
                if output.nothing is not None and output.topic in self._due_s:
                    publisher.publish(output.nothing(self._newest))
        self._path = PathHistory(self._options.max_path_poses)
        self._motion = MotionEstimator(self._options.stddev_position, self._options.stddev_orientation)
        self._newest = None
        self._due_s: dict[str, float] = {}
        self._published_ns: dict[str, int] = {}
        self._frames.begin_map()
        self._floor_plan.begin_map()
        if self._viewer is not None:
            self._viewer.begin_map()

    def end_time(self, slam: Slam) -> None:
        """Prepare for stamps that begin anew: no velocity is reported to the next pose, and the path so far stays where it is."""
        self._motion.interrupt()
        self._path.end_time(slam.graph)

    def refresh(self) -> None:
        """Publish the latched topics once more, because the map has changed without a frame."""
        self._published_ns.clear()

    def publish(self, frame: RgbdFrame, result: FrameResult, located: Located | None, slam: Slam) -> None:
        """Publish what is due for a frame, all with its stamp.

        An uncertain frame goes to the topics that carry covariances; a lost one to none. For both the transform from map
        to odom stays what it was, with the new stamp, so that a robot with odometry can go on.

        Args:
            frame: the frame.
            result: its result.
            located: its camera in the coordinate frames of ROS; None if that is not known.
            slam: SLAM in its state after the frame.
        """
        if result.T_world_cam is None or result.is_relocalised:
            self._motion.interrupt()
        if result.T_world_cam is not None and located is not None and self._node.context.ok():
            self._publish_pose(located, result.T_world_cam, result, slam)
        if not result.status.is_trusted and self._node.context.ok():
            self._frames.hold(result.stamp_ns, result.T_world_odom)
        self.publish_processed(result.stamp_ns)
        if self._viewer is not None:
            self._viewer.take(frame, result, slam)

    def publish_processed(self, stamp_ns: int) -> None:
        """Announce on ``~/processed`` that nothing more will be published for the frame of this stamp."""
        if self._node.context.ok():
            self._processed.publish(stamps.header(self._factory, stamp_ns, self._options.map_frame))

    @property
    def has_late_subscriber(self) -> bool:
        """True if a latched topic has a subscriber but its newest message was not published, or the viewer asks for something."""
        newest, now_s = self._newest, time.monotonic()
        if self._viewer is not None and self._viewer.is_asked:
            return True
        return newest is not None and any(
            output.qos is LATCHED_QOS
            and self._published_ns.get(output.topic) != newest.stamp_ns
            and self._is_due(output, publisher, now_s)
            for output, publisher in self._publishers
        )

    def serve_late_subscribers(self, slam: Slam) -> None:
        """Publish the newest message of each latched topic that someone subscribed to after the last frame; answer the viewer."""
        if self._viewer is not None:
            self._viewer.answer(slam)
        if self._newest is not None and self._node.context.ok() and self.has_late_subscriber:
            self._newest.is_idle = True
            self._publish_due(self._newest, [row for row in self._publishers if row[0].qos is LATCHED_QOS])

    def occupancy_grid(self, slam: Slam) -> Any:
        """Return the grid of all keyframes as a message; None, after a warning, if there is none."""
        if self._newest is None:
            return None
        return self._floor_plan.message(slam, self._newest.located, self._options, self._factory, is_complete=True)

    def close(self) -> None:
        """End the viewer."""
        if self._viewer is not None:
            self._viewer.close()

    def _publish_pose(self, located: Located, T_world_cam: Matrix, result: FrameResult, slam: Slam) -> None:
        context = PublishContext(
            located=located,
            T_world_cam=T_world_cam,
            motion=self._motion.observe(located, result),
            slam=slam,
            path=self._path,
            floor_plan=self._floor_plan,
            options=self._options,
            factory=self._factory,
        )
        if not result.status.is_trusted:
            self._publish_due(context, [row for row in self._publishers if row[0].trigger is Trigger.POSE])
            return
        self._newest = context
        self._path.append(context.stamp_ns, T_world_cam, context.pose)
        self._frames.publish(located)
        self._publish_due(context, self._publishers)
        self.num_poses += 1

    def _publish_due(self, context: PublishContext, rows: Sequence[tuple[Output, Publisher]]) -> None:
        now_s = time.monotonic()  # the same for all, so that renders of equal rate show the same frame
        for output, publisher in rows:
            if self._is_due(output, publisher, now_s):
                rate_hz = output.rate_hz(self._options)
                self._due_s[output.topic] = now_s + (1 / rate_hz if rate_hz else 0.0)
                self._published_ns[output.topic] = context.stamp_ns
                message = output.message(context)
                if message is not None:
                    publisher.publish(message)

    def _create(self, type_name: str, topic: str, qos: QoSProfile) -> Publisher:
        return self._node.create_publisher(message_class(type_name), f'~/{topic}', qos)

    def _is_due(self, output: Output, publisher: Publisher, now_s: float) -> bool:
        """True if someone subscribes and the rate allows it. A message that nobody receives takes as long to make as any other."""
        return publisher.get_subscription_count() > 0 and now_s >= self._due_s.get(output.topic, 0.0)
