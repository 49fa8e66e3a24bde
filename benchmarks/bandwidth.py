"""The bandwidth of every topic of a running node: bytes of each message and bytes per second, inputs and outputs.

    python benchmarks/bandwidth.py SOURCE [--preset realtime] [--width 320] [--rate 10] [--max-frames N] [-p NAME:=VALUE]

A recording is published like a camera's images, at a fixed rate. Another process subscribes to each topic of the graph and
counts serialized messages, as they go over the network; a network adds about 3 % of headers. Seconds are those of the node's
own clock at the publisher, from the first to the last message of the recording, so a machine that is busy changes the
numbers only where the node drops frames (see the column of messages). Choose a rate that the node keeps up with. The compressed
images are not sent: the recording is encoded as image_transport's plugins do (JPEG of quality 95, PNG of millimetres).
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from header import print_header
from live import RELIABLE, Graph, convert, graph
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message

from msg_adapters.compressed import compressed_color_message, compressed_depth_message
from msg_adapters.factory import RclpyMessages, message_class
from splatam_core.datasets.registry import open_sequence

INPUTS = {
    '/rgb/image': 'sensor_msgs/msg/Image', '/depth/image': 'sensor_msgs/msg/Image', '/rgb/camera_info': 'sensor_msgs/msg/CameraInfo'
}  # fmt: skip
NODE = '/splatam/'
DISCOVERY_S = 15.0
LATCHED = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
IGNORED = ('/rosout', '/parameter_events')


@dataclass(eq=False)
class Traffic:
    """What one topic carried: the size of each message in bytes, and when it was published, ns."""

    sizes: list[int] = field(default_factory=list)
    published_ns: list[int] = field(default_factory=list)

    def add(self, size: int, published_ns: int) -> None:
        """Count a message."""
        self.sizes.append(size)
        self.published_ns.append(published_ns)


def subscribe(opened: Graph, topic: str, type_name: str, qos: QoSProfile) -> Traffic:
    """Count the messages of a topic while the graph spins."""
    traffic = Traffic()

    def receive(data: bytes, info: dict[str, int]) -> None:
        traffic.add(len(data), info['source_timestamp'])

    # rclpy accepts a callback that takes the message's info; its annotation does not know it.
    opened.node.create_subscription(message_class(type_name), topic, receive, qos, raw=True)  # type: ignore[arg-type]
    return traffic


def outputs(opened: Graph) -> dict[str, str]:
    """Returns the topics of the graph that are no inputs, with their types."""
    found = {topic: types[0] for topic, types in opened.node.get_topic_names_and_types()}
    return {topic: kind for topic, kind in found.items() if topic not in INPUTS and topic not in IGNORED}


def is_latched(opened: Graph, topic: str) -> bool:
    """Returns True if a publisher keeps its last message for late subscribers."""
    found = opened.node.get_publishers_info_by_topic(topic)
    return any(info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for info in found)


def listen_to_all(opened: Graph) -> dict[str, Traffic]:
    """Subscribe to the inputs, and to whatever the node publishes."""
    traffic = {topic: subscribe(opened, topic, kind, RELIABLE) for topic, kind in INPUTS.items()}
    opened.spin_until(lambda: NODE + 'processed' in outputs(opened), DISCOVERY_S)
    opened.spin_for(1.0)
    for topic, kind in outputs(opened).items():
        if any(info.topic_type == kind for info in opened.node.get_publishers_info_by_topic(topic)):
            traffic[topic] = subscribe(opened, topic, kind, LATCHED if is_latched(opened, topic) else RELIABLE)
    return traffic


def run(args: argparse.Namespace, bag: Path, folder: Path) -> tuple[dict[str, Traffic], float]:
    """Play the recording once. Returns what each topic carried, and for how many seconds."""
    parameters: dict[str, Any] = dict(entry.split(':=', 1) for entry in args.parameters)
    with graph(folder / 'graph') as opened:
        opened.start_node(args.preset, **parameters)
        traffic = listen_to_all(opened)
        camera = opened.start_camera(bag, folder / 'frames', '--rate', str(args.rate))
        opened.spin_until(lambda: not camera.is_running, 600)
        camera.require(0)
        opened.spin_for(1.0)
    first, *_, last = traffic['/rgb/image'].published_ns
    return traffic, (last - first) / 1e9


def compressed(bag: Path) -> dict[str, Traffic]:
    """Returns what the images would be if they were sent compressed, as image_transport's plugins do."""
    factory, color, depth = RclpyMessages(), Traffic(), Traffic()
    sequence = open_sequence(str(bag))
    for index in range(len(sequence)):
        frame = sequence[index]
        for traffic, message in (
            (color, compressed_color_message(factory, frame.rgb, frame.stamp_ns, 'camera')),
            (depth, compressed_depth_message(factory, frame.depth_m, frame.stamp_ns, 'camera')),
        ):
            traffic.add(len(serialize_message(message)), frame.stamp_ns)
    return {'/rgb/image/compressed': color, '/depth/image/compressedDepth': depth}


def rows(traffic: dict[str, Traffic], seconds: float) -> list[str]:
    """Returns a line of the table for each topic, the largest first."""

    def total(topic: str) -> int:
        return sum(traffic[topic].sizes)

    lines = []
    for topic in sorted(traffic, key=total, reverse=True):
        sizes = traffic[topic].sizes
        if sizes:
            growth = f'{min(sizes):,} to {max(sizes):,}' if min(sizes) != max(sizes) else f'{sizes[0]:,}'
            lines.append(
                f'| `{topic}` | {len(sizes)} | {len(sizes) / seconds:.1f} | {growth} | {statistics.mean(sizes):,.0f} '
                f'| {total(topic) / seconds / 1000:,.1f} |'
            )
        else:
            lines.append(f'| `{topic}` | 0 | 0 | – | – | 0 |')
    return lines


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('source', help="a recording, or 'synthetic'")
    parser.add_argument('--preset', default='realtime')
    parser.add_argument('--width', type=int, default=320)
    parser.add_argument('--rate', type=float, default=10.0)
    parser.add_argument('--max-frames', type=int)
    parser.add_argument('-p', dest='parameters', action='append', default=[], metavar='NAME:=VALUE',
                        help='a parameter of the node, in the form that --ros-args takes')  # fmt: skip
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        convert(args.source, bag := Path(scratch) / 'bag', args.width, args.max_frames)
        if_compressed = compressed(bag)
        traffic, seconds = run(args, bag, Path(scratch))
    print_header(f'{Path(args.source).name} at {args.rate:g} Hz, preset `{args.preset}`, {args.width} pixels wide', 1)
    print(f'{seconds:.1f} s; sizes are those of the serialized messages.\n')
    print('| topic | messages | per second | bytes of a message | mean | kB/s |')
    print('|---|---|---|---|---|---|')
    num_frames = len(next(iter(if_compressed.values())).sizes)
    for line in (*rows(traffic, seconds), *rows(if_compressed, num_frames / args.rate)):
        print(line)


if __name__ == '__main__':
    main()
