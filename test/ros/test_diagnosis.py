"""Reasons why no frames are received, found on the real graph."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import pytest
from builtin_interfaces.msg import Time
from camera import Camera, run_node
from graph import Graph
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header

from msg_adapters import camera_info
from msg_adapters.camera_info import CameraParameters
from msg_adapters.factory import RclpyMessages
from splatam_core.datasets.synthetic import SyntheticSequence
from splatam_ros.node.frame_assembler import FrameAssembler
from splatam_ros.node.gate import FrameGate
from splatam_ros.node.input_watchdog import why_no_frames
from splatam_ros.node.parameters import node_options
from splatam_ros.subscription import MonitoredSubscription
from splatam_ros.throttled_warnings import ThrottledWarnings

STREAMS = ((CameraInfo, '/rgb/camera_info'), (Image, '/rgb/image'), (Image, '/depth/image'))


class Receiver:
    """The inputs of a node, without the node."""

    def __init__(self, graph: Graph, **options: Any) -> None:
        self.options = node_options(options)
        self.node = graph.node
        self.rejected: list[int] = []
        warnings = ThrottledWarnings(graph.node.get_logger())
        self.assembler = FrameAssembler(self.options, warnings, FrameGate(self.options.max_rate_hz), self.rejected.append)
        self.inputs = [
            MonitoredSubscription(graph.node, message_class, topic, add, reliability=self.options.input_reliability, keep_all=False)
            for message_class, topic, add in (
                (CameraInfo, 'rgb/camera_info', self.assembler.add_info),
                (Image, 'rgb/image', self.assembler.add_color),
                (Image, 'depth/image', self.assembler.add_depth),
            )
        ]

    def why(self) -> str:
        return why_no_frames(self.node, self.inputs, self.assembler.statistics, self.options)


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
    assert 'topics of that type: /rgb/image; remap: -r depth/image:=/rgb/image' in receiver.why()
    depth = graph.publisher(Image, '/depth/image')
    graph.spin_until(lambda: 'have publishers, but no message was received' in receiver.why(), explain=receiver.why)
    color.publish(image(100))
    depth.publish(image(350))
    graph.spin_until(lambda: '/rgb/camera_info has a publisher, but no message' in receiver.why(), explain=receiver.why)
    info.publish(CameraInfo())
    graph.spin_until(lambda: 'none that can be used' in receiver.why(), explain=receiver.why)
    camera = CameraParameters(64, 48, 50.0, 50.0, 31.5, 23.5)
    info.publish(camera_info.info_message(RclpyMessages(), camera, 0))
    graph.spin_until(lambda: 'nothing pairs' in receiver.why(), explain=receiver.why)
    assert '0.250 s apart' in receiver.why() and 'sync.max_interval is 0.02 s' in receiver.why()
    receiver.options = replace(receiver.options, no_data_timeout=0.2)
    graph.spin_for(0.3)
    stamps_ms = itertools.count(400)

    def only_depth_has_stopped() -> bool:
        color.publish(image(next(stamps_ms)))
        return 'nothing was received on /depth/image for' in receiver.why()

    graph.spin_until(only_depth_has_stopped, explain=receiver.why)


def test_another_type_on_the_topic(graph: Graph) -> None:
    for message_class, topic in ((CameraInfo, '/rgb/camera_info'), (CompressedImage, '/rgb/image'), STREAMS[2]):
        graph.publisher(message_class, topic)
    node = graph.run_node(preset='quick', no_data_timeout=1.0)
    carries = 'no frame for 1 s: /rgb/image has type sensor_msgs/msg/CompressedImage, expected sensor_msgs/msg/Image'
    node.wait_says(carries, 'remap, or set rgb_transport')


def test_sim_time_without_a_clock(graph: Graph) -> None:
    receiver = Receiver(graph)
    publishers = [graph.publisher(message_class, topic) for message_class, topic in STREAMS]
    graph.spin_until(lambda: 'have publishers, but no message' in receiver.why(), explain=receiver.why)
    graph.node.set_parameters([Parameter('use_sim_time', value=True)])
    assert receiver.why().startswith('use_sim_time is true and /clock has no publisher')
    clock = graph.publisher(Clock, '/clock', QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    graph.spin_until(lambda: '/clock has a publisher, but no message' in receiver.why(), explain=receiver.why)

    def tick() -> bool:
        clock.publish(Clock(clock=Time(sec=5)))
        return 'have publishers, but no message' in receiver.why()

    graph.spin_until(tick, explain=receiver.why)
    assert publishers


def test_a_node_by_sim_time_says_that_the_clock_stands(graph: Graph) -> None:
    """The watchdog uses the steady clock. Images carry their own stamps, so they are processed all the same."""
    node = run_node(graph, use_sim_time=True, no_data_timeout=1.0)
    camera, done = Camera(graph), graph.collect(Header, '/splatam/processed')
    camera.wait_matched()
    node.wait_says('no frame for 1 s: use_sim_time is true and /clock has no publisher')
    frame = SyntheticSequence(seed=0, noise=False, frames=12, width=64)[0]
    camera.send(frame)
    graph.spin_until(lambda: done, explain=lambda: node.text)


def test_names_are_those_after_remapping(graph: Graph) -> None:
    node = graph.run_node('-r', 'rgb/image:=/camera/color', '-r', '__ns:=/robot', preset='quick', no_data_timeout=1.0)
    node.wait_says('no publisher on /robot/rgb/camera_info, /camera/color and /robot/depth/image')


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
        assert '(reliability)' in receiver.why() and 'set it to auto or best_effort' in receiver.why()


@pytest.mark.parametrize(('overridden', 'option'), [('best_effort', 'reliable'), ('reliable', 'auto')])
def test_qos_overrides_have_the_last_word(graph: Graph, overridden: str, option: str) -> None:
    """They take precedence over input_reliability."""
    override = f'qos_overrides./rgb/image.subscription.reliability:={overridden}'
    node = graph.run_node('-p', override, preset='quick', input_reliability=option, no_data_timeout=1.0)
    color = Camera(graph, ReliabilityPolicy.BEST_EFFORT).publisher('rgb')
    if overridden == 'best_effort':
        graph.spin_until(color.get_subscription_count, explain=lambda: node.text)
    else:
        node.wait_says('no frame for 1 s: the publisher of /rgb/image', 'incompatible QoS (reliability)')
