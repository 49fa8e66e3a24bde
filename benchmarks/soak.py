"""The node over a long time beside a camera with faults: memory, frames, poses, and whatever failed.

    python benchmarks/soak.py [SOURCE] [--minutes 60] [--preset realtime] [--width 160] [--max-frames 300] [--cycle 120]

A recording is played in a loop at 30 Hz. Its stamps start again with each loop, so the node saves the run and starts a new
map. Every cycle of ``--cycle`` seconds has these faults; after each of them the node must give poses again:

- the camera is covered: black images without depth;
- one message in ten is lost, at random;
- the process of the camera (the player) is killed, and started again;
- ``~/save_map``, and ``~/load_map`` of a map that was saved before, while frames arrive.

The node drops frames that it has no time for, as with a live camera. Every output of the node has a subscriber. A frame is
counted as input if both of its images were handed to the node. At the end the node is told to stop, and its run is read.
"""

from __future__ import annotations

import argparse
import random
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from header import print_header
from live import Graph, convert, graph
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from msg_adapters.factory import message_class
from msg_adapters.stamps import serialized_stamp_ns
from splatam_core.datasets.bag.topics import DEPTH_TOPIC, INFO_TOPIC, RGB_TOPIC
from splatam_core.errors import SplatamError
from splatam_core.runs.layout import MAP
from splatam_core.runs.record import read_run
from splatam_ros.node.outputs import OUTPUTS
from splatam_ros.process import StopRequest

START_TIMEOUT_S = 60.0
SETTLING = 0.25  # fraction of the time in which memory may grow: caches, allocators, the first map
RECOVERY_S = 30.0  # three loops: a map that was loaded may not show what the camera sees until the next one
SERVICE_S = 30.0
AWAY_S = 3.0
COVERED_S = 4.0
LOSSY_S = 10.0
LOSS = 0.1
RELIABLE_DEPTH = 10
STOP_WITHIN_S = 8.0
PLAYED = '/camera'  # where the player publishes; the node hears what is passed on


@dataclass(frozen=True, slots=True)
class Sample:
    """Memory and frame counts at one time.

    Attributes:
        minutes: time since the first frame.
        rss_mb: resident memory of the node, MiB.
        player_mb: resident memory of the player, MiB.
        frames_in: input frames so far.
        processed: frames tracked or lost so far.
        poses: poses published so far.
        restarts: how often the player was started again so far.
    """

    minutes: float
    rss_mb: float
    player_mb: float
    frames_in: int
    processed: int
    poses: int
    restarts: int


class Counter:
    """Counts the messages of a topic."""

    def __init__(self, opened: Graph, topic: str, message_type: type) -> None:
        self.count = 0
        opened.node.create_subscription(message_type, topic, self._receive, RELIABLE_DEPTH, raw=True)

    def _receive(self, data: bytes) -> None:
        self.count += 1


class FaultyCable:
    """Passes the images of the player on to the node. Some are lost, or show a covered camera.

    Attributes:
        loss: fraction of the messages that are lost.
        is_covered: True to pass on zeros in place of pixels.
        frames: number of frames of which both images were passed on.
    """

    def __init__(self, opened: Graph) -> None:
        self.loss = 0.0
        self.is_covered = False
        self.frames = 0
        self._random = random.Random(0)
        self._newest: dict[str, int] = {}
        for topic, kind in ((INFO_TOPIC, CameraInfo), (RGB_TOPIC, Image), (DEPTH_TOPIC, Image)):
            opened.node.create_subscription(kind, PLAYED + topic, self._carrier(opened, topic, kind), RELIABLE_DEPTH, raw=True)

    def _carrier(self, opened: Graph, topic: str, kind: type) -> Callable[[bytes], None]:
        publisher, pixels = opened.node.create_publisher(kind, topic, RELIABLE_DEPTH), [0]

        def carry(data: bytes) -> None:
            if self._random.random() < self.loss:
                return
            if self.is_covered and kind is Image:
                pixels[0] = pixels[0] or _num_pixel_bytes(data)
                data = data[: -pixels[0]] + bytes(pixels[0])
            publisher.publish(data)
            if kind is Image:
                self._count(topic, serialized_stamp_ns(data))

        return carry

    def _count(self, topic: str, stamp_ns: int) -> None:
        self._newest[topic] = stamp_ns
        self.frames += self._newest.get(RGB_TOPIC) == self._newest.get(DEPTH_TOPIC)


def _num_pixel_bytes(data: bytes) -> int:
    """Returns how many bytes at the end of a serialized image are its pixels."""
    return len(deserialize_message(data, Image).data)


class Soak:
    """The node, the player, the faults between them, and what went wrong.

    Attributes:
        restarts: how often the player was started again.
        failures: one line for everything that is not as it should be.
        done: how often each fault was caused.
    """

    def __init__(self, opened: Graph, bag: Path, folder: Path, args: argparse.Namespace) -> None:
        self.restarts = 0
        self.failures: list[str] = []
        self.done: dict[str, int] = {}
        self._opened, self._bag, self._folder = opened, bag, folder
        self.cable = FaultyCable(opened)
        self.processed = Counter(opened, '/splatam/processed', Header)
        self.poses = Counter(opened, '/splatam/pose', message_class('geometry_msgs/msg/PoseStamped'))
        for output in OUTPUTS[1:]:
            opened.drain(f'/splatam/{output.topic}', message_class(output.type_name))
        self.run = folder / 'run'
        self._services = {name: opened.node.create_client(Trigger, f'/splatam/{name}') for name in ('save_map', 'load_map')}
        self._set = opened.node.create_client(SetParameters, '/splatam/set_parameters')
        self.node = opened.start_node(args.preset, save_path=self.run, slam__threads=1)
        self._play()
        if not opened.spin_until(lambda: self.processed.count, START_TIMEOUT_S):
            sys.exit(f'no frame was processed; the output of the node:\n{self.node.log.read_text()}')
        self.started_s = time.monotonic()

    @property
    def minutes(self) -> float:
        """Time since the first frame."""
        return (time.monotonic() - self.started_s) / 60

    def is_alive(self) -> bool:
        """Returns False, and notes the failure, if the node or the player has ended."""
        ended = [child for child in (self.node, self.player) if not child.is_running]
        for child in ended:
            last = child.log.read_text().splitlines()[-3:]
            self.failures.append(f'minute {self.minutes:.1f}: {"the node" if child is self.node else "the player"} ended: {last}')
        return not ended

    def sample(self) -> Sample:
        """Returns memory and counts now."""
        return Sample(
            minutes=self.minutes, rss_mb=self.node.rss_mb(), player_mb=self.player.rss_mb(), frames_in=self.cable.frames,
            processed=self.processed.count, poses=self.poses.count, restarts=self.restarts,
        )  # fmt: skip

    # --- the faults ---

    def cover(self) -> None:
        """Cover the camera."""
        self.cable.is_covered = True
        self._opened.spin_for(COVERED_S)
        self.cable.is_covered = False
        self._expect_poses('the camera was covered')

    def lose(self) -> None:
        """Lose one message in ten."""
        self.cable.loss = LOSS
        self._opened.spin_for(LOSSY_S)
        self.cable.loss = 0.0
        self._expect_poses('messages were lost')

    def restart(self) -> None:
        """Kill the player, and start it again."""
        self.player.kill()
        self._opened.spin_for(AWAY_S)
        self._play()
        self.restarts += 1
        self._expect_poses('the player was killed and started again')

    def save(self) -> None:
        """Save the map."""
        self._call('save_map')
        self._expect_poses('the map was saved')

    def load(self) -> None:
        """Load a copy of the map that was saved last."""
        kept = self._folder / 'kept.ply'
        if not kept.exists():
            self._call('save_map')
            shutil.copy2(self.run / MAP, kept)
            value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=str(kept))
            answer = self._set.call_async(SetParameters.Request(parameters=[Parameter(name='load_path', value=value)]))
            self._opened.spin_until(answer.done, SERVICE_S)
        self._call('load_map')
        self._expect_poses('a map was loaded')

    def stop(self) -> str:
        """Tell the node to stop, and read its run. Returns what happened."""
        if not self.node.is_running:
            return 'The node had ended.'
        cpu = f'node {100 * self.node.cpu_s() / (60 * self.minutes):.0f} %'
        begin = time.monotonic()
        code = self.node.stop()
        took_s = time.monotonic() - begin
        if code != 0 or took_s > STOP_WITHIN_S:
            self.failures.append(f'told to stop, the node ended after {took_s:.1f} s with exit code {code}')
        try:
            record = read_run(self.run)
            saved = f'{len(record.frames)} frames of the last loop and their map were saved'
        except (SplatamError, OSError) as error:
            saved = f'the run cannot be read: {error}'
            self.failures.append(saved)
        own = 100 * time.process_time() / (60 * self.minutes)
        shares = f'Share of a core: {cpu}, this program (camera and listener) {own:.0f} %.'
        return f'Told to stop, the node was gone after {took_s:.1f} s; {saved}. {shares}'

    def _play(self) -> None:
        remaps = [f'{topic}:={PLAYED}{topic}' for topic in (INFO_TOPIC, RGB_TOPIC, DEPTH_TOPIC)]
        self.player = self._opened.start_player(self._bag, '--loop', '--rate', '1', '--no-wait-for-subscribers', '--remap', *remaps)

    def _expect_poses(self, what: str) -> None:
        before = self.poses.count
        self.done[what] = self.done.get(what, 0) + 1
        if not self._opened.spin_until(lambda: self.poses.count > before, RECOVERY_S):
            self.failures.append(f'minute {self.minutes:.1f}: no pose within {RECOVERY_S:g} s after {what}')

    def _call(self, name: str) -> None:
        answer = self._services[name].call_async(Trigger.Request())
        if not self._opened.spin_until(answer.done, SERVICE_S):
            self.failures.append(f'minute {self.minutes:.1f}: ~/{name} did not answer within {SERVICE_S:g} s')
        elif not answer.result().success:
            self.failures.append(f'minute {self.minutes:.1f}: ~/{name}: {answer.result().message}')


def watch(soak: Soak, opened: Graph, args: argparse.Namespace, stop: StopRequest) -> list[Sample]:
    """Cause the faults in turn, and sample meanwhile, until the time is up, Ctrl-C is pressed, or node or player end."""
    faults = [soak.cover, soak.lose, soak.restart, soak.save, soak.load]
    samples = [soak.sample()]
    minutes, period_s = args.minutes, min(5.0, args.minutes * 60 / 20)
    due_s = gap_s = args.cycle / len(faults)
    number = 0
    while soak.minutes < minutes and not stop.requested:
        opened.spin_for(max(0.0, min(period_s, 60 * (minutes - soak.minutes))))
        if not soak.is_alive():
            break
        samples.append(soak.sample())
        print(samples[-1], file=sys.stderr, flush=True)
        if 60 * soak.minutes >= due_s and 60 * minutes - due_s > RECOVERY_S:
            faults[number % len(faults)]()
            number, due_s = number + 1, due_s + gap_s
    return samples


def slope(samples: list[Sample]) -> float:
    """Returns the growth of the node's memory after the settling time, in MiB per hour (least squares)."""
    settled = [sample for sample in samples if sample.minutes >= SETTLING * samples[-1].minutes]
    return 60 * float(np.polyfit([s.minutes for s in settled], [s.rss_mb for s in settled], 1)[0])


def print_table(samples: list[Sample], rows: int) -> None:
    """Print ``rows`` of the samples, including the first and the last, and a summary of all."""
    print('| minute | node MB | player MB | player started again | frames in | processed | with a pose |\n|' + '---|' * 7)
    for i in sorted(set(np.linspace(0, len(samples) - 1, rows).round().astype(int))):
        s = samples[i]
        print(
            f'| {s.minutes:.1f} | {s.rss_mb:.0f} | {s.player_mb:.0f} | {s.restarts} | {s.frames_in} | {s.processed} | {s.poses} |'
        )
    first, last = samples[0], samples[-1]
    frames_in, processed = last.frames_in - first.frames_in, last.processed - first.processed
    print(f'\nNode: {slope(samples):+.2f} MB an hour after the first {SETTLING:.0%} of the time, '
          f'{max(s.rss_mb for s in samples):.0f} MB at most. {frames_in} frames in, {processed} processed, '
          f'{last.poses - first.poses} of them with a pose, {frames_in - processed} dropped.')  # fmt: skip


def report(soak: Soak) -> None:
    """Print what was done, what the node said, and what failed."""
    lines = soak.node.log.read_text().splitlines()
    warnings = [line for line in lines if '[WARN]' in line]
    errors = [line for line in lines if '[ERROR]' in line]
    resets = sum('map reset' in line for line in lines)
    done = '; '.join(f'{what}: {count} times' for what, count in soak.done.items())
    print(f'\nMaps started anew: {resets}. {done}.' if done else f'\nMaps started anew: {resets}.')
    print(f'\nThe node wrote {len(warnings)} warnings and {len(errors)} errors' + (f', last: {errors[-1]}' if errors else '.'))
    print('\nFailed: ' + ('\n'.join(['', *(f'- {line}' for line in soak.failures)]) if soak.failures else 'nothing.'))


def main() -> None:
    """Play the recording and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('source', nargs='?', default='synthetic')
    parser.add_argument('--minutes', type=float, default=60.0)
    parser.add_argument('--preset', default='realtime')
    parser.add_argument('--width', type=int, default=160)
    parser.add_argument('--max-frames', type=int, default=300)
    parser.add_argument('--cycle', type=float, default=120.0, help='seconds from a fault to the next one of its kind')
    args = parser.parse_args()
    title = f'{Path(args.source).name}, {args.minutes:g} minutes of looping with faults, preset `{args.preset}`'
    print_header(f'{title}, {args.width} pixels wide, 30 Hz', 1)
    with tempfile.TemporaryDirectory() as scratch:
        convert(args.source, bag := Path(scratch) / 'bag', args.width, args.max_frames)
        with StopRequest() as stop, graph(Path(scratch) / 'logs') as opened:
            soak = Soak(opened, bag, Path(scratch), args)
            samples = watch(soak, opened, args, stop)
            stopped = soak.stop()
            print_table(samples, rows=16)
            print(f'\n{stopped}')
            report(soak)


if __name__ == '__main__':
    main()
