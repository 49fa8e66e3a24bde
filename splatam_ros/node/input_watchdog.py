"""Finds out why no frames are received, and explains it in one sentence."""

from __future__ import annotations

import time
from collections.abc import Sequence

from rclpy.node import Node

from msg_adapters.synchronizer import SyncStatistics
from splatam_ros.node.parameters import NodeOptions
from splatam_ros.subscription import MonitoredSubscription

CLOCK = '/clock'
NUM_SUGGESTIONS = 4


class InputWatchdog:
    """Warns once when no frames are received, with the reason, and again when the reason changes.

    Attributes:
        problem: the reason given last; empty while frames are received.
    """

    def __init__(self, node: Node, inputs: Sequence[MonitoredSubscription]) -> None:
        self.problem = ''
        self._node = node
        self._inputs = inputs
        self._since_s = self._checked_s = time.monotonic()

    def postpone(self) -> None:
        """Restart the timeout, e.g. because SLAM is still busy with earlier frames."""
        self._since_s = time.monotonic()

    def report_frame(self) -> None:
        """Note that a frame was received."""
        self.postpone()
        self.problem = ''

    def check(self, statistics: SyncStatistics, options: NodeOptions) -> None:
        """Warn if no frame was received for longer than ``no_data_timeout``. Call regularly."""
        now_s, timeout_s = time.monotonic(), options.no_data_timeout
        if not timeout_s or now_s - self._since_s <= timeout_s:
            return
        if self.problem and now_s - self._checked_s < timeout_s:
            return
        before, self.problem = self.problem, why_no_frames(self._node, self._inputs, statistics, options)
        self._checked_s = now_s
        if _without_numbers(self.problem) != _without_numbers(before):
            self._node.get_logger().warning(f'no frame for {timeout_s:g} s: {self.problem}')


def why_no_frames(node: Node, inputs: Sequence[MonitoredSubscription], statistics: SyncStatistics, options: NodeOptions) -> str:
    """Returns the most basic reason why no frames are received, for the user.

    Args:
        node: the node, for its clock.
        inputs: subscriptions to camera info, colour and depth.
        statistics: statistics of the synchronizer.
        options: the node's options.
    """
    if unpublished := [item for item in inputs if item.num_publishers == 0]:
        domain_id = node.context.get_domain_id()
        return f'no publisher on {_topics(unpublished)}; {_suggestion(unpublished[0], domain_id)}'
    if mistyped := [item for item in inputs if item.other_type]:
        item = mistyped[0]
        return f'{item.topic} has type {item.other_type}, expected {item.type_name}; remap, or set {_transport(item)}'
    if incompatible := [item for item in inputs if item.incompatible_policy]:
        return (
            f'the publisher of {_topics(incompatible)} offers an incompatible QoS '
            f'({incompatible[0].incompatible_policy}); input_reliability is {options.input_reliability}, '
            'set it to auto or best_effort, or use qos_overrides'
        )
    if empty := [item for item in inputs if item.received == 0]:
        verb = 'has a publisher' if len(empty) == 1 else 'have publishers'
        return _why_clock_stands(node) or f'{_topics(empty)} {verb}, but no message was received'
    if statistics.received_info == 0:
        return 'camera info is received, but none that can be used; see the warning about it'
    now_s = time.monotonic()
    if stopped := [item for item in inputs[1:] if now_s - item.last_received_s > options.no_data_timeout]:
        why = '; '.join(filter(None, ['though there is a publisher', _why_clock_stands(node)]))
        stopped_s = now_s - max(item.last_received_s for item in stopped)
        return f'nothing was received on {_topics(stopped)} for {stopped_s:.0f} s, {why}'
    if statistics.newest_gap_ns is not None and abs(statistics.newest_gap_ns) > statistics.max_interval_ns:
        return (
            f'colour and depth are received, but nothing pairs: the stamps of the newest two are '
            f'{abs(statistics.newest_gap_ns) / 1e9:.3f} s apart, and {_allowed(options, statistics)}'
        )
    return 'no new images are received, or none that can be used; see the warnings'


def _suggestion(item: MonitoredSubscription, domain_id: int) -> str:
    found = item.candidates()
    if not found:
        return f'no topic has type {item.type_name}: is the camera or the recording running, with this ROS_DOMAIN_ID, {domain_id}?'
    more = f' and {len(found) - NUM_SUGGESTIONS} more' if len(found) > NUM_SUGGESTIONS else ''
    return f'topics of that type: {", ".join(found[:NUM_SUGGESTIONS])}{more}; remap: -r {item.name}:={found[0]}'


def _why_clock_stands(node: Node) -> str:
    """Returns why sim time does not run; empty if it runs or is not used."""
    if not node.get_parameter('use_sim_time').value or node.get_clock().now().nanoseconds:
        return ''
    state = 'has a publisher, but no message was received' if node.count_publishers(CLOCK) else 'has no publisher'
    return f'use_sim_time is true and {CLOCK} {state}: start the simulation, or play with --clock'


def _transport(item: MonitoredSubscription) -> str:
    return 'rgb_transport' if 'rgb' in item.name else 'depth_transport'


def _allowed(options: NodeOptions, statistics: SyncStatistics) -> str:
    if options.sync_mode == 'exact':
        return 'sync.mode is exact; approximate allows sync.max_interval'
    return f'sync.max_interval is {statistics.max_interval_ns / 1e9:g} s'


def _topics(inputs: Sequence[MonitoredSubscription]) -> str:
    return ' and '.join(', '.join(item.topic for item in inputs).rsplit(', ', 1))


def _without_numbers(text: str) -> str:
    """Returns the part of a message that stays the same as long as the reason does."""
    return ''.join(character for character in text if not character.isdigit())
