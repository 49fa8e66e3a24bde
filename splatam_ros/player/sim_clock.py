"""Publishes ``/clock`` from the recording's time."""

from __future__ import annotations

import time
from collections.abc import Collection

from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from msg_adapters import stamps
from splatam_ros.player.pacing import PlaybackClock

DEPTH = 100  # so that a subscriber that is busy misses no time that precedes a message


class SimClock:
    """Publishes ``/clock`` periodically, just before messages of some topics, or both.

    Time goes back only at a restart, and never passes the end of what is played.
    """

    def __init__(self, node: Node, clock: PlaybackClock, end_ns: int, rate_hz: float | None, before: Collection[str]) -> None:
        """Prepare.

        Args:
            node: publishes; it gets a publisher only if ``/clock`` is needed.
            clock: tells the recording time; it runs on where a message is published late.
            end_ns: recording time of the end of what is played.
            rate_hz: updates per second of wall time; None = no periodic updates.
            before: recorded topics before whose messages ``/clock`` is published.
        """
        self._publisher = node.create_publisher(Clock, '/clock', DEPTH) if rate_hz or before else None
        self._clock = clock
        self._end_ns = end_ns
        self._period_s = 1 / rate_hz if rate_hz else float('inf')
        self._before = before
        self._due_s = 0.0
        self._last_ns = 0

    @property
    def period_s(self) -> float:
        """Wall time between periodic updates; infinite without."""
        return self._period_s

    def restart(self) -> None:
        """Allow time to go back once."""
        self._last_ns = 0

    def tick(self) -> None:
        """Publish the periodic update if it is due."""
        now_s = time.monotonic()
        if self._period_s < float('inf') and now_s >= self._due_s:
            self._due_s = now_s + self._period_s
            self._publish(min(self._clock.now_ns(), self._end_ns))

    def before_message(self, topic: str, time_ns: int) -> None:
        """Publish the time of a message that is about to be published, if its topic asks for it."""
        if topic in self._before:
            self._publish(time_ns)

    def _publish(self, time_ns: int) -> None:
        if self._publisher is not None:
            self._last_ns = max(self._last_ns, time_ns)
            message = Clock()
            message.clock.sec, message.clock.nanosec = stamps.from_ns(self._last_ns)
            self._publisher.publish(message)
