"""A ROS graph for one test, with the processes under test and a node of the test."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rclpy
from domains import reserve_domain
from processes import TIMEOUT_S, Patience, Process
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Header

from splatam_core.resources import config_dir

ROOT = Path(__file__).resolve().parents[2]
FRAMES = 12  # of the small recording that most tests play
RELIABLE = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)


def environment(domain: int, log_folder: Path) -> dict[str, str]:
    return {
        **os.environ,
        'ROS_DOMAIN_ID': str(domain),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'ROS_PYTHON_CHECK_FIELDS': '1',
        'ROS_LOG_DIR': str(log_folder),
        'PYTHONUNBUFFERED': '1',
    }


class Graph:
    """A ROS graph on its own domain."""

    def __init__(self, folder: Path) -> None:
        self.domain, self._reservation = reserve_domain()
        self.folder = folder
        self._processes: list[Process] = []
        self._context: Context | None = None
        os.environ.update(environment(self.domain, folder))
        os.environ.setdefault('FASTRTPS_DEFAULT_PROFILES_FILE', str(config_dir() / 'fastdds_large_data.xml'))

    # --- processes ---

    def start(self, *arguments: str, stdin: int = subprocess.DEVNULL) -> Process:
        variables = environment(self.domain, self.folder)
        variables.pop('FASTRTPS_DEFAULT_PROFILES_FILE')  # they must find it themselves
        process = Process(arguments, variables, self.folder / f'process_{len(self._processes)}.log', stdin)
        self._processes.append(process)
        return process

    def play(self, *arguments: str, stdin: int = subprocess.DEVNULL) -> Process:
        return self.start('-m', 'splatam_ros.player.main', *arguments, stdin=stdin)

    def play_in_step(self, *arguments: str, processed: str = '/splatam/processed') -> Process:
        """Start a player that waits for the node and for this test, which hears all that is published even if it is put aside."""
        heard = self.publisher(Header, '/heard')
        self.node.create_subscription(Header, processed, heard.publish, RELIABLE)
        return self.play(*arguments, '--rate', 'max', '--wait-for', '/heard')

    def run_node(self, *ros_arguments: str, **parameters: Any) -> Process:
        return self.start('-m', 'splatam_ros.node.main', *node_arguments(*ros_arguments, **parameters))

    # --- the node of the test ---

    @property
    def node(self) -> Node:
        if self._context is None:
            self._context = Context()
            rclpy.init(context=self._context, domain_id=self.domain)
            self._node = Node('test', context=self._context, use_global_arguments=False)
            self._executor = SingleThreadedExecutor(context=self._context)
            self._executor.add_node(self._node)
        return self._node

    def spin_until(
        self, condition: Callable[[], object], timeout_s: float = TIMEOUT_S, explain: Callable[[], str] = lambda: ''
    ) -> None:
        assert self.node
        patience = Patience(timeout_s)
        while not condition():
            assert not patience.is_over, f'not so within {timeout_s} s. {explain()}'
            self._executor.spin_once(timeout_sec=Patience.LOOK_S)

    def spin_for(self, seconds: float) -> None:
        """Spin for a time in which something must not happen."""
        patience = Patience(seconds)
        while not patience.is_over:
            self._executor.spin_once(timeout_sec=Patience.LOOK_S)

    def settled(self, count: Callable[[], int], quiet_s: float = 0.5) -> int:
        """Spin until a count has not changed for some time, so that what was on its way has arrived. Returns the count."""
        last, quiet = count(), Patience(quiet_s)

        def is_quiet() -> bool:
            nonlocal last
            if count() != last:
                last = count()
                quiet.restart()
            return quiet.is_over

        self.spin_until(is_quiet, explain=lambda: f'the count is {count()} and grows')
        return last

    def collect(self, message_class: type, topic: str, qos: QoSProfile = RELIABLE, raw: bool = False) -> list[Any]:
        """Subscribe; the list grows while the graph spins."""
        messages: list[Any] = []
        self.node.create_subscription(message_class, topic, messages.append, qos, raw=raw)
        return messages

    def publisher(self, message_class: type, topic: str, qos: QoSProfile = RELIABLE) -> Publisher:
        return self.node.create_publisher(message_class, topic, qos)

    def close(self) -> None:
        for process in self._processes:
            process.end()
        if self._context is not None:
            self._executor.shutdown()
            self._node.destroy_node()
            rclpy.try_shutdown(context=self._context)
        self._reservation.close()


def node_arguments(*ros_arguments: str, **parameters: Any) -> list[str]:
    """Returns arguments that set parameters; ``a__b`` stands for ``a.b``."""
    settings = {name.replace('__', '.'): value for name, value in parameters.items()}
    words = [word for name, value in settings.items() for word in ('-p', f'{name}:={_yaml(value)}')]
    return ['--ros-args', *words, *ros_arguments]


def _yaml(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)
