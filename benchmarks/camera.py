"""A camera for benchmarks: publishes the images of a bag at a fixed rate and waits for no subscriber.

    python benchmarks/camera.py BAG LOG [--rate 30] [--frames N] [--now]

``splatam convert`` wrote BAG. It is read into memory first, as serialized messages, because a driver reads no files either.
Publishing starts a second after every topic has a subscriber: until the subscriber knows the publisher, too, images wait, and then
they arrive all at once.
LOG gets a line for each frame: its stamp, and the wall time at which the later of its two images was handed to ROS, in nanoseconds.
"""

from __future__ import annotations

import argparse
import struct
import sys
import time
from collections.abc import Iterator
from itertools import cycle, islice
from pathlib import Path

import rclpy
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy

from msg_adapters.factory import message_class
from msg_adapters.stamps import serialized_stamp_ns
from splatam_core.datasets.bag.recording import Recording
from splatam_core.datasets.bag.topics import DEPTH_TOPIC, INFO_TOPIC, RGB_TOPIC
from splatam_ros.process import StopRequest, ros

TOPICS = (INFO_TOPIC, RGB_TOPIC, DEPTH_TOPIC)
AS_DRIVERS_DO = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
DISCOVERY_S = 60.0
SETTLING_S = 1.0
Frame = dict[str, bytes]


def frames_of(recording: Recording) -> list[Frame]:
    """Returns the serialized messages of each stamp that has all three topics."""
    by_stamp: dict[int, Frame] = {}
    for message in recording.messages(TOPICS):
        by_stamp.setdefault(serialized_stamp_ns(message.data), {})[message.topic] = message.data
    return [frame for frame in by_stamp.values() if len(frame) == len(TOPICS)]


def stamped(data: bytes, stamp_ns: int) -> bytes:
    """Returns a serialized message (little endian) with its stamp replaced."""
    return data[:4] + struct.pack('<iI', *divmod(stamp_ns, 10**9)) + data[12:]


def due_times(rate_hz: float) -> Iterator[float]:
    """Yields the monotonic times, in seconds, at which frames are due. A late frame delays those after it."""
    due_s = time.monotonic()
    while True:
        yield due_s
        due_s = max(due_s + 1 / rate_hz, time.monotonic())


def publish(publishers: dict[str, Publisher], frames: list[Frame], args: argparse.Namespace, stop: StopRequest) -> Iterator[str]:
    """Publish the frames. Yields the lines of the log."""
    count = args.frames or len(frames)
    for frame, due_s in zip(islice(cycle(frames), count), due_times(args.rate)):
        while not stop.requested and (left_s := due_s - time.monotonic()) > 0:
            time.sleep(left_s)
        if stop.requested:
            return
        stamp_ns = time.time_ns() if args.now else serialized_stamp_ns(frame[RGB_TOPIC])
        for topic in TOPICS:
            data = stamped(frame[topic], stamp_ns) if args.now else frame[topic]
            handed_over_ns = time.time_ns()
            publishers[topic].publish(data)
        yield f'{stamp_ns} {handed_over_ns}\n'


def main() -> None:
    """Publish until done or stopped."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('bag', type=Path)
    parser.add_argument('log', type=Path)
    parser.add_argument('--rate', type=float, default=30.0)
    parser.add_argument('--frames', type=int, help='number of frames; the bag is repeated as needed (default: the whole bag, once)')
    parser.add_argument('--now', action='store_true', help='stamp with the time of publishing')
    args = parser.parse_args()
    with Recording(args.bag) as recording, StopRequest() as stop, ros(()):
        frames = frames_of(recording)
        node = rclpy.create_node('camera')
        classes = {topic: message_class(recording.topics[topic].type_name) for topic in TOPICS}
        publishers = {topic: node.create_publisher(classes[topic], topic, AS_DRIVERS_DO) for topic in TOPICS}
        deadline_s = time.monotonic() + DISCOVERY_S
        while not (stop.requested or all(item.get_subscription_count() for item in publishers.values())):
            if time.monotonic() > deadline_s:
                sys.exit(f'camera: nobody subscribes to {", ".join(TOPICS)}')
            time.sleep(0.05)
        time.sleep(SETTLING_S)
        with args.log.open('w') as log:
            log.writelines(publish(publishers, frames, args, stop))
        time.sleep(1.0)  # so that the subscribers can take the last messages


if __name__ == '__main__':
    main()
