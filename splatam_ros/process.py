"""Shared by the processes of node and player: transport, signals, start and end of ROS."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType, TracebackType

import rclpy
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.signals import SignalHandlerOptions

from splatam_core.errors import SplatamError
from splatam_core.interruption import on_stop_signals
from splatam_core.resources import config_dir

PROFILE_VARIABLE = 'FASTRTPS_DEFAULT_PROFILES_FILE'


class RosError(SplatamError):
    """A ROS argument, parameter or topic cannot be used."""


class StopRequest:
    """Turns ``STOP_SIGNALS`` into a request to stop, so that the program can finish its work. Repeated signals are ignored.

    The handlers of rclpy would shut the context down at once, and nothing could be published any more.
    Use it as a context manager in the main thread.
    """

    def __init__(self) -> None:
        self.signal: signal.Signals | None = None
        self._since_s = 0.0
        self._handling = on_stop_signals(self._request)

    @property
    def requested(self) -> bool:
        """True if a signal has arrived."""
        return self.signal is not None

    @property
    def elapsed_s(self) -> float:
        """Time since the first signal; 0 before it."""
        return time.monotonic() - self._since_s if self.requested else 0.0

    def __enter__(self) -> StopRequest:
        self._handling.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None) -> None:
        self._handling.__exit__(kind, error, traceback)

    def _request(self, number: int, frame: FrameType | None) -> None:
        if self.signal is None:
            self._since_s = time.monotonic()
            self.signal = signal.Signals(number)


def split_arguments(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split a command line into the program's own arguments and those for ROS (from ``--ros-args`` to ``--``).

    They are kept apart because rcl takes every ``a:=b`` for itself, even the player's ``--remap a:=b``.
    """
    own: list[str] = []
    for_ros: list[str] = []
    current = own
    for argument in arguments:
        if argument == '--ros-args':
            current = for_ros
        current.append(argument)
        if argument == '--' and current is for_ros:
            current = own
    return own, for_ros


@contextmanager
def ros(arguments: Sequence[str]) -> Iterator[None]:
    """Initialize ROS for the duration of a ``with``: with a transport for large images, without signal handlers.

    Args:
        arguments: the command line's arguments for ROS.

    Raises:
        RosError: the ROS arguments cannot be parsed.
    """
    os.environ.setdefault(PROFILE_VARIABLE, str(config_dir() / 'fastdds_large_data.xml'))
    try:
        rclpy.init(args=['', *arguments], signal_handler_options=SignalHandlerOptions.NO)
    except rclpy_implementation.UnknownROSArgsError as error:  # its text is the list of unknown arguments
        hint = 'a rule is -p NAME:=VALUE or -r NAME:=NAME, in quotes if it has spaces'
        raise RosError(f'ROS arguments: not understood: {error}; {hint}') from None
    except RuntimeError as error:  # rclpy's errors have no narrower public base
        raise RosError(f'ROS arguments: {_first_sentence(error)}') from None
    try:
        yield
    finally:
        rclpy.try_shutdown()


def _first_sentence(error: Exception) -> str:
    """Returns rcl's message without its preamble and without the source locations at its end."""
    return str(error).split(', at /')[0].removeprefix('failed to initialize rcl: ')
