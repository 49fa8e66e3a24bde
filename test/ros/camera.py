"""A camera for tests, and the node with fast settings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from graph import Graph
from numpy.typing import NDArray
from processes import Process
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header

from msg_adapters import camera_info, images, stamps
from msg_adapters.factory import RclpyMessages
from splatam_core.datasets.synthetic import SyntheticSequence
from splatam_core.types import RgbdFrame

# These tests are about messages, not maps: few steps, and a low limit below which tracking counts as lost.
QUICK = {
    'tracking.iterations': 6, 'mapping.iterations': 3, 'mapping.every': 1, 'tracking.min_inlier_fraction': 0.1,
    'threads': 1,
}  # fmt: skip
SLAM = {f'slam__{name.replace(".", "__")}': value for name, value in QUICK.items()}
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
MAKE = RclpyMessages()
CAMERA_FRAME = 'camera_optical_frame'
STREAMS = ('info', 'rgb', 'depth')


def run_node(graph: Graph, *ros_arguments: str, **parameters: Any) -> Process:
    # On a busy machine the first frame takes long; tests of the warning set their own timeout.
    return graph.run_node(*ros_arguments, **{'preset': 'quick', 'no_data_timeout': 60.0, **SLAM, **parameters})


def stamps_of(messages: list[Any]) -> list[int]:
    return [stamps.message_stamp_ns(message) for message in messages]


class Camera:
    """A camera that sends what the test tells it to."""

    TOPICS: Mapping[str, tuple[type, str]] = {
        'info': (CameraInfo, '/rgb/camera_info'), 'rgb': (Image, '/rgb/image'), 'depth': (Image, '/depth/image'),
    }  # fmt: skip

    def __init__(self, graph: Graph, reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE) -> None:
        qos = QoSProfile(depth=100, reliability=reliability)
        self._graph = graph
        self._publishers = {stream: graph.publisher(*topic, qos) for stream, topic in self.TOPICS.items()}

    def publisher(self, stream: str) -> Publisher:
        return self._publishers[stream]

    @property
    def is_matched(self) -> bool:
        return all(publisher.get_subscription_count() for publisher in self._publishers.values())

    def wait_matched(self) -> None:
        self._graph.spin_until(lambda: self.is_matched)

    def send(self, frame: RgbdFrame, *, depth_delay_ns: int = 0, only: Sequence[str] = STREAMS, **changes: Any) -> None:
        """Send a frame's messages, or some of them; ``rgb__encoding='x'`` changes a field of one."""
        messages = self.messages(frame, frame.stamp_ns + depth_delay_ns)
        for name, value in changes.items():
            message, _, attribute = name.partition('__')
            setattr(messages[message], attribute, value)
        self.publish(messages, only)

    def publish(self, messages: Mapping[str, Any], only: Sequence[str] = STREAMS) -> None:
        for name in only:
            self._publishers[name].publish(messages[name])

    def messages(self, frame: RgbdFrame, depth_stamp_ns: int) -> dict[str, Any]:
        return {
            'info': info_message(frame),
            'rgb': images.color_message(MAKE, frame.rgb, frame.stamp_ns, CAMERA_FRAME),
            'depth': images.depth_message(MAKE, frame.depth_m, depth_stamp_ns, CAMERA_FRAME),
        }


class CompressedCamera(Camera):
    """A camera that sends images as image_transport's plugins do. ``color`` is jpeg or png, ``depth`` 16UC1 or 32FC1."""

    TOPICS = {
        'info': (CameraInfo, '/rgb/camera_info'), 'rgb': (CompressedImage, '/rgb/image/compressed'),
        'depth': (CompressedImage, '/depth/image/compressedDepth'),
    }  # fmt: skip
    PARAMETERS = {'rgb_transport': 'compressed', 'depth_transport': 'compressedDepth'}
    color = 'jpeg'
    depth = '16UC1'

    def messages(self, frame: RgbdFrame, depth_stamp_ns: int) -> dict[str, Any]:
        rgb, depth_m, frame_id = frame.rgb, frame.depth_m, CAMERA_FRAME
        return {
            'info': info_message(frame),
            'rgb': images.compressed_color_message(MAKE, rgb, frame.stamp_ns, frame_id, self.color),
            'depth': images.compressed_depth_message(MAKE, depth_m, depth_stamp_ns, frame_id, self.depth),
        }


def info_message(frame: RgbdFrame) -> CameraInfo:
    c = frame.camera
    parameters = camera_info.CameraParameters(c.width, c.height, c.fx, c.fy, c.cx, c.cy, frame_id=CAMERA_FRAME)
    return camera_info.info_message(MAKE, parameters, frame.stamp_ns)


class Live:
    """A running node and a camera that feeds it frame by frame; waits for each frame to be processed."""

    def __init__(self, graph: Graph, *ros_arguments: str, camera_class: type[Camera] = Camera, **parameters: Any) -> None:
        self.graph = graph
        self.camera = camera_class(graph)
        self.done = graph.collect(Header, '/splatam/processed')
        self.poses = graph.collect(PoseStamped, '/splatam/pose')
        self.node = run_node(graph, *ros_arguments, **parameters)
        self.wait(lambda: self.camera.is_matched)
        self.wait(lambda: all(map(graph.node.count_publishers, ('/splatam/processed', '/splatam/pose'))))

    def wait(self, condition: Callable[[], object]) -> None:
        """Spin until the condition holds; fails if the node ends."""
        self.graph.spin_until(lambda: condition() or not self.node.is_running, explain=lambda: self.node.text)
        assert self.node.is_running, self.node.text

    def wait_says(self, *parts: str) -> None:
        self.wait(lambda: self.node.says(*parts))

    def show(self, frame: RgbdFrame, **options: Any) -> PoseStamped | None:
        """Send a frame, and return its pose; None if it has none."""
        self.camera.send(frame, **options)
        self.wait_done(frame.stamp_ns)
        return self.pose_of(frame.stamp_ns)

    def wait_done(self, stamp_ns: int) -> None:
        self.wait(lambda: self.done and stamps.to_ns(self.done[-1].stamp) == stamp_ns)

    def pose_of(self, stamp_ns: int) -> PoseStamped | None:
        """Returns the pose of a processed frame. It was published before ``~/processed``, so it is among the next messages."""
        for _ in range(4):
            for pose in reversed(self.poses):
                if stamps.message_stamp_ns(pose) == stamp_ns:
                    return pose
            self.graph.spin_for(0.05)
        return None


def position(pose: PoseStamped) -> NDArray[np.float64]:
    p = pose.pose.position
    return np.array([p.x, p.y, p.z])


def still(frames: SyntheticSequence, number: int) -> RgbdFrame:
    """Returns a frame of a camera that does not move, so that tracking cannot fail."""
    return replace(frames[0], stamp_ns=10**9 + number * 10**8)
