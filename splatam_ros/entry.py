"""Entry points of the executables. They do not import ROS, so that a missing ROS is reported in one line."""

from __future__ import annotations

import sys
from importlib import import_module

_EXIT_USAGE = 2
_EXIT_INTERRUPTED = 130  # by the convention of shells: 128 + SIGINT


def node() -> int:
    """``splatam_node``."""
    return _main('splatam_ros.node.main')


def player() -> int:
    """``splatam_bag_player``."""
    return _main('splatam_ros.player.main')


def _main(module: str) -> int:
    try:
        main = import_module(module).main
    except ModuleNotFoundError as error:
        if (error.name or '').split('.')[0] not in ('rclpy', 'rcl_interfaces', 'sensor_msgs'):
            raise
        print(
            f"splatam_ros: no ROS 2 in this Python ({error}): pip install 'splatam_ros[ros]', or source /opt/ros/jazzy/setup.bash",
            file=sys.stderr,
        )
        return _EXIT_USAGE
    except KeyboardInterrupt:  # during the import, which takes seconds; there is nothing to clean up yet
        return _EXIT_INTERRUPTED
    return main()
