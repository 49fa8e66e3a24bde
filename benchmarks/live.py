"""Shared by the benchmarks of the running node: child processes, their CPU and memory use, and received messages."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from msg_adapters.stamps import serialized_stamp_ns
from splatam_ros.demo import graph_environment
from splatam_ros.process import ros

HERE = Path(__file__).parent
STOP_TIMEOUT_S = 60.0
RELIABLE = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)


class Child:
    """A process whose CPU and memory use are measured. Its output goes to a log file, to be read when something fails."""

    def __init__(self, command: list[str], log: Path) -> None:
        self.log = log
        self._command = command
        with log.open('wb') as output:
            self._process = subprocess.Popen(
                [sys.executable, *command], stdin=subprocess.DEVNULL, stdout=output, stderr=output,
                start_new_session=True,
            )  # fmt: skip

    @property
    def is_running(self) -> bool:
        """True until the process ends."""
        return self._process.poll() is None

    def require(self, exit_code: int) -> None:
        """Wait for the process to end.

        Raises:
            SystemExit: its exit code is another one.
        """
        if (code := self._process.wait(STOP_TIMEOUT_S)) != exit_code:
            sys.exit(f'{self._command} ended with exit code {code}; its output:\n{self.log.read_text()}')

    def stop(self) -> int:
        """Send SIGINT and wait. Returns the exit code."""
        if self.is_running:
            self._process.send_signal(signal.SIGINT)
            try:
                self._process.wait(STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self.kill()
        return self._process.wait()

    def kill(self) -> None:
        """Send SIGKILL and wait."""
        self._process.kill()
        self._process.wait()

    def cpu_s(self) -> float:
        """Returns the CPU time of all its threads so far, in seconds."""
        fields = Path(f'/proc/{self._process.pid}/stat').read_text().rpartition(')')[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')

    def rss_mb(self) -> float:
        """Returns its resident memory, in MiB."""
        pages = int(Path(f'/proc/{self._process.pid}/statm').read_text().split()[1])
        return pages * os.sysconf('SC_PAGE_SIZE') / 2**20


@dataclass(frozen=True, slots=True)
class Arrival:
    """When a message with a header was stamped, published and received.

    Attributes:
        stamp_ns: stamp of its header.
        published_ns: wall time at which the publisher handed it over.
        received_ns: wall time at which this process took it.
    """

    stamp_ns: int
    published_ns: int
    received_ns: int


class Graph:
    """The ROS graph of one benchmark: child processes, and a node that subscribes to their topics."""

    def __init__(self, node: Node, folder: Path) -> None:
        self.node = node
        self._folder = folder
        self._children: list[Child] = []
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)

    def start(self, *command: str) -> Child:
        """Run ``python command``."""
        child = Child(list(command), self._folder / f'{len(self._children)}.log')
        self._children.append(child)
        return child

    def start_node(self, preset: str, **parameters: object) -> Child:
        """Start the SLAM node; ``a__b`` stands for the parameter ``a.b``."""
        values = {'preset': preset, **{name.replace('__', '.'): value for name, value in parameters.items()}}
        words = [word for name, value in values.items() for word in ('-p', f'{name}:={value}')]
        return self.start('-m', 'splatam_ros.node.main', '--ros-args', *words)

    def start_player(self, bag: Path, *options: str) -> Child:
        """Start the player."""
        return self.start('-m', 'splatam_ros.player.main', str(bag), *options)

    def start_camera(self, bag: Path, log: Path, *options: str) -> Child:
        """Start the camera of ``camera.py``."""
        return self.start(str(HERE / 'camera.py'), str(bag), str(log), *options)

    def listen(self, topic: str, message_class: type = PoseStamped) -> list[Arrival]:
        """Subscribe; the list grows while the graph spins."""
        arrivals: list[Arrival] = []

        def receive(data: bytes, info: dict[str, int]) -> None:
            arrivals.append(Arrival(serialized_stamp_ns(data), info['source_timestamp'], time.time_ns()))

        # rclpy accepts a callback that takes the message's info; its annotation does not know it.
        self.node.create_subscription(message_class, topic, receive, RELIABLE, raw=True)  # type: ignore[arg-type]
        return arrivals

    def drain(self, topic: str, message_class: type) -> None:
        """Subscribe, so that the publisher has a subscriber, and keep nothing."""
        self.node.create_subscription(message_class, topic, lambda data: None, RELIABLE, raw=True)

    def spin_until(self, condition: Callable[[], object], timeout_s: float) -> bool:
        """Take messages until a condition is met. Returns False if that took longer than ``timeout_s``."""
        deadline_s = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline_s:
                return False
            self._executor.spin_once(timeout_sec=0.05)
        return True

    def spin_for(self, seconds: float) -> None:
        """Take messages for some time."""
        self.spin_until(lambda: False, seconds)

    def cpu_percent(self, child: Child, seconds: float) -> float:
        """Take messages for some time. Returns the CPU load of a process meanwhile, in percent of one core."""
        cpu_s, wall_s = child.cpu_s(), time.monotonic()
        self.spin_for(seconds)
        return 100 * (child.cpu_s() - cpu_s) / (time.monotonic() - wall_s)

    def close(self) -> None:
        """End every process."""
        for child in reversed(self._children):
            child.stop()
        self._executor.shutdown()
        self.node.destroy_node()


@contextmanager
def graph(folder: Path) -> Iterator[Graph]:
    """Opens a graph that is isolated from others, and ends its processes afterwards.

    Args:
        folder: where the processes' logs go.
    """
    folder.mkdir(parents=True, exist_ok=True)
    os.environ.update(graph_environment(os.environ, os.getpid()))
    with ros(()):
        opened = Graph(rclpy.create_node('benchmark'), folder)
        try:
            yield opened
        finally:
            opened.close()


def convert(source: str, bag: Path, width: int, max_frames: int | None = None) -> None:
    """Convert any source to a bag with the node's topic names."""
    cut = ['--max-frames', str(max_frames)] if max_frames else []
    command = ['-m', 'splatam_core.cli', 'convert', source, str(bag), '--width', str(width), *cut]
    subprocess.run([sys.executable, *command], check=True, stdout=subprocess.DEVNULL)


def milliseconds(values_ns: list[int]) -> list[float]:
    """Nanoseconds as milliseconds."""
    return [value / 1e6 for value in values_ns]
