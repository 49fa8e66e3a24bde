"""The camera's topics: subscribes to the three streams and passes on the frames assembled from them."""

from __future__ import annotations

import time
from collections.abc import Callable

from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from msg_adapters.synchronizer import SyncStatistics
from splatam_core.types import RgbdFrame
from splatam_ros.node.frame_assembler import FrameAssembler
from splatam_ros.node.parameters import NodeOptions
from splatam_ros.subscription import MonitoredSubscription

QUIET_S = 1.0  # after this long without an image, waiting images are paired, and publishers that left count as gone
LONG_QUIET_S = 10.0  # the same if one image lacks a partner: a paused player may be about to send it
TRANSPORTS = {
    'raw': ('', Image),
    'compressed': ('/compressed', CompressedImage),
    'compressedDepth': ('/compressedDepth', CompressedImage),
}


class CameraInput:
    """Subscribes to camera info, colour and depth. Runs on the executor's thread.

    Attributes:
        subscriptions: camera info, colour and depth, in this order.
    """

    def __init__(self, node: Node, options: NodeOptions, assembler: FrameAssembler, on_frame: Callable[[RgbdFrame], None]) -> None:
        """Subscribe.

        Args:
            node: the node that subscribes.
            options: the node's options.
            assembler: turns the messages into frames.
            on_frame: called with each frame; may block.
        """
        self._assembler = assembler
        self._on_frame = on_frame
        self._had_publishers = False
        rgb_suffix, rgb_class = TRANSPORTS[options.rgb_transport]
        depth_suffix, depth_class = TRANSPORTS[options.depth_transport]
        streams = (  # of messages that arrive together, the executor takes the first subscription's first
            (CameraInfo, 'rgb/camera_info', self._receive_info),
            (rgb_class, f'rgb/image{rgb_suffix}', self._receive_color),
            (depth_class, f'depth/image{depth_suffix}', self._receive_depth),
        )
        self.subscriptions = [
            MonitoredSubscription(
                node, message_class, topic, on_message,
                reliability=options.input_reliability, keep_all=options.keeps_all,
            )
            for message_class, topic, on_message in streams
        ]  # fmt: skip

    @property
    def topics(self) -> list[str]:
        """Names on the graph, after remapping."""
        return [item.topic for item in self.subscriptions]

    @property
    def statistics(self) -> SyncStatistics:
        """Counts of received, paired and dropped messages."""
        return self._assembler.statistics

    @property
    def is_stalled(self) -> bool:
        """True if images wait for a better partner, or a frame for the next one, that does not come.

        A player may be waiting for our answer.
        """
        waiting = self._assembler.statistics
        if self._assembler.is_stalled:
            return self._quiet_s > QUIET_S
        if not (waiting.waiting_color and waiting.waiting_depth):
            return False
        return self._quiet_s > (QUIET_S if waiting.waiting_color == waiting.waiting_depth else LONG_QUIET_S)

    @property
    def has_ended(self) -> bool:
        """True if the publishers of the images were there and are gone, and their images have been received."""
        images = self.subscriptions[1:]
        has_publishers = any(item.num_publishers for item in images)
        # Publishers may come and go while the executor waits for SLAM; their images are received all the same.
        self._had_publishers |= has_publishers or any(item.received for item in images)
        return self._had_publishers and not has_publishers and self._quiet_s > QUIET_S

    def flush(self) -> None:
        """Pass on the frames that can be assembled without further messages; unpaired images are dropped."""
        self._pass_on(self._assembler.flush())

    def report_drops(self) -> None:
        """Warn about the messages that were dropped since the last report."""
        self._assembler.report_drops()

    def close(self) -> None:
        """Unsubscribe."""
        for item in self.subscriptions:
            item.close()

    @property
    def _quiet_s(self) -> float:
        """Time since the last image."""
        return time.monotonic() - max(item.last_received_s for item in self.subscriptions[1:])

    def _receive_info(self, message: CameraInfo) -> None:
        self._pass_on(self._assembler.add_info(message))

    def _receive_color(self, message: Image | CompressedImage) -> None:
        self._pass_on(self._assembler.add_color(message))

    def _receive_depth(self, message: Image | CompressedImage) -> None:
        self._pass_on(self._assembler.add_depth(message))

    def _pass_on(self, frames: list[RgbdFrame]) -> None:
        for frame in frames:
            self._on_frame(frame)
