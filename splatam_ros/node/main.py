"""``splatam_node``: the process of the node, with signals, order of shutdown and exit codes."""

from __future__ import annotations

import argparse
import logging
import sys
import textwrap
import traceback
from collections.abc import Sequence

from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.logging import get_logger

from splatam_core.errors import SplatamError, printable
from splatam_core.output import unfailing_output
from splatam_core.settings import Setting
from splatam_ros.node.node import SplatamNode
from splatam_ros.node.parameters import NODE_SETTINGS
from splatam_ros.process import RosError, StopRequest, ros, split_arguments
from splatam_ros.throttled_warnings import ThrottledWarnings, describe

PROGRAM = 'splatam_node'
EXIT_OK, EXIT_FAILED, EXIT_USAGE = 0, 1, 2
SPIN_S = 0.1  # longest time until a signal is noticed
HELP_COLUMNS, HELP_INDENT = 100, '      '


class RosLog(logging.Handler):
    """Passes the core's log records to the node's logger."""

    def __init__(self, logger: RcutilsLogger) -> None:
        super().__init__()
        self._logger = logger

    def emit(self, record: logging.LogRecord) -> None:
        """Log a record at the nearest ROS severity."""
        text = printable(record.getMessage())
        if record.levelno >= logging.ERROR:
            self._logger.error(text)
        elif record.levelno >= logging.WARNING:
            self._logger.warning(text)
        else:
            self._logger.info(text)


def run(for_ros: Sequence[str], stop: StopRequest) -> int:
    """Run the node until it is finished or a signal arrives. Returns the exit code.

    Raises:
        SplatamError: the node cannot start.
    """
    with ros(for_ros):
        node = _start(stop)
        logging.getLogger().addHandler(RosLog(node.get_logger()))
        is_fine = False
        try:
            executor = SingleThreadedExecutor()
            executor.add_node(node)
            _spin(executor, node, stop)
            executor.remove_node(node)
        finally:
            is_fine = node.close()
    return EXIT_OK if is_fine else EXIT_FAILED


def _start(stop: StopRequest) -> SplatamNode:
    try:
        return SplatamNode(stop)
    except SplatamError:
        raise
    except Exception as error:  # noqa: BLE001 - of rclpy, say; one line is enough
        get_logger(PROGRAM).debug(''.join(traceback.format_exception(error)))
        raise RosError(f'the node cannot start: {describe(error)}') from None


def _spin(executor: SingleThreadedExecutor, node: SplatamNode, stop: StopRequest) -> None:
    """Run the callbacks until the end. One that fails costs its message or call, never the node."""
    warnings = ThrottledWarnings(node.get_logger())
    while not (stop.requested or node.is_finished):
        try:
            executor.spin_once(timeout_sec=SPIN_S)
        except ExternalShutdownException:
            return
        except Exception as error:  # noqa: BLE001 - the other callbacks may be fine
            warnings.warn_of('callback', 'a callback failed', error)


def make_parser() -> argparse.ArgumentParser:
    """Returns the parser of the arguments that are not for ROS; there is only ``--help``."""
    lines = [
        f'  {setting.name} ({setting.shown_default}{f", {setting.unit}" if setting.unit else ""})\n'
        + textwrap.fill(_help(setting), HELP_COLUMNS, initial_indent=HELP_INDENT, subsequent_indent=HELP_INDENT)
        for setting in NODE_SETTINGS
    ]
    return argparse.ArgumentParser(
        PROGRAM,
        usage='%(prog)s [--ros-args -p NAME:=VALUE ... -r rgb/image:=/TOPIC ...]',
        description='RGB-D SLAM on the topics rgb/image, depth/image and rgb/camera_info.',
        epilog='parameters (default, unit); the SLAM settings have the prefix slam. and are not listed here:\n' + '\n'.join(lines),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def _help(setting: Setting) -> str:
    return setting.help + (f' One of {setting.shown_choices}.' if setting.choices else '')


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the node. Returns the exit code: 0 = success, 1 = SLAM or saving failed, 2 = cannot start."""
    own, for_ros = split_arguments(sys.argv[1:] if arguments is None else arguments)
    make_parser().parse_args(own)
    with unfailing_output(results=False), StopRequest() as stop:
        try:
            return run(for_ros, stop)
        except SplatamError as error:
            print(f'{PROGRAM}: error: {error}', file=sys.stderr)
            return EXIT_USAGE


if __name__ == '__main__':
    sys.exit(main())
