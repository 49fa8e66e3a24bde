"""Why no frames come: told from the real graph."""

from __future__ import annotations

import pytest
from graph import Graph
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image

from msg_adapters import camera_info
from msg_adapters.camera_info import CameraParameters
from msg_adapters.factory import RclpyMessages
from splatam_ros.diagnosis import why_no_frames
from splatam_ros.inputs import Input
from splatam_ros.intake import Intake
from splatam_ros.parameters import NODE_SETTINGS, NodeOptions
from splatam_ros.throttled_warnings import ThrottledWarnings


class Receiver:
    """The node's inputs without the node."""

    def __init__(self, graph: Graph, **options: object) -> None:
        defaults = {setting.name.replace('.', '_'): setting.default for setting in NODE_SETTINGS}
        self.options = NodeOptions(**{**defaults, **options})
        self.intake = Intake(self.options, ThrottledWarnings(graph.node.get_logger()))
        self.inputs = [
            Input(graph.node, message_class, topic, add, reliability=self.options.input_reliability, keep_all=False)
            for message_class, topic, add in (
                (CameraInfo, 'rgb/camera_info', self.intake.info),
                (Image, 'rgb/image', self.intake.color),
                (Image, 'depth/image', self.intake.depth),
            )
        ]

    def why(self) -> str:
        return why_no_frames(self.inputs, self.intake.statistics, self.options)


def image(stamp_ms: int) -> Image:
    message = Image()
    message.header.stamp.nanosec = stamp_ms * 1_000_000
    return message


def test_each_cause_is_told_apart(graph: Graph) -> None:
    receiver = Receiver(graph)
    assert 'no publisher on /rgb/camera_info, /rgb/image and /depth/image' in receiver.why()
    color = graph.publisher(Image, '/rgb/image')
    info = graph.publisher(CameraInfo, '/rgb/camera_info')
    graph.spin_until(lambda: 'no publisher on /depth/image;' in receiver.why(), explain=receiver.why)
    depth = graph.publisher(Image, '/depth/image')
    graph.spin_until(lambda: 'are published, but no message has come' in receiver.why(), explain=receiver.why)
    color.publish(image(100))
    depth.publish(image(350))
    graph.spin_until(lambda: '/rgb/camera_info is published, but no message' in receiver.why(), explain=receiver.why)
    info.publish(CameraInfo())
    graph.spin_until(lambda: 'none that can be used' in receiver.why(), explain=receiver.why)
    camera = CameraParameters(64, 48, 50.0, 50.0, 31.5, 23.5)
    info.publish(camera_info.info_message(RclpyMessages(), camera, 0))
    graph.spin_until(lambda: 'nothing pairs' in receiver.why(), explain=receiver.why)
    assert '0.250 s apart' in receiver.why() and 'sync.max_interval is 0.02 s' in receiver.why()


@pytest.mark.parametrize(('reliability', 'is_heard'), [('auto', True), ('best_effort', True), ('reliable', False)])
def test_best_effort_publishers(graph: Graph, reliability: str, is_heard: bool) -> None:
    receiver = Receiver(graph, input_reliability=reliability)
    qos = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    publishers = [graph.publisher(Image, '/rgb/image', qos), graph.publisher(Image, '/depth/image', qos)]
    graph.publisher(CameraInfo, '/rgb/camera_info', qos)
    if is_heard:
        graph.spin_until(lambda: all(publisher.get_subscription_count() for publisher in publishers))
        for publisher in publishers:
            publisher.publish(image(100))
        graph.spin_until(lambda: all(item.received for item in receiver.inputs[1:]))
    else:
        graph.spin_until(lambda: 'incompatible QoS' in receiver.why(), explain=receiver.why)
        assert 'set it to auto or best_effort' in receiver.why()
