"""A minimal node for comparison: it publishes a pose for each pair of images without decoding them. See ``node_overhead.py``."""

from __future__ import annotations

import sys

from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image

from splatam_ros.process import StopRequest, ros


class Echo(Node):
    """Subscribes to the topics of the SLAM node."""

    def __init__(self, topic: str) -> None:
        super().__init__('echo')
        self._halves: set[tuple[int, int]] = set()
        self._publisher = self.create_publisher(PoseStamped, topic, 10)
        self.create_subscription(CameraInfo, 'rgb/camera_info', lambda message: None, 10)
        self.create_subscription(Image, 'rgb/image', self._image, 10)
        self.create_subscription(Image, 'depth/image', self._image, 10)

    def _image(self, message: Image) -> None:
        key = (message.header.stamp.sec, message.header.stamp.nanosec)
        if key in self._halves:
            self._halves.remove(key)
            self._publisher.publish(PoseStamped(header=message.header))
        else:
            self._halves.add(key)


def main() -> None:
    """Publish on the topic named on the command line until stopped."""
    with StopRequest() as stop, ros(()):
        node = Echo(sys.argv[1])
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while not stop.requested:
            executor.spin_once(timeout_sec=0.1)
        executor.shutdown()
        node.destroy_node()


if __name__ == '__main__':
    main()
