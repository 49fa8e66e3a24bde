"""Why no frames come: found out, and said in one sentence."""

from __future__ import annotations

import time
from collections.abc import Sequence

from rclpy.node import Node

from msg_adapters.synchronizer import SyncStatistics
from splatam_ros.node.parameters import NodeOptions
from splatam_ros.subscription import Input

CLOCK = '/clock'
NUM_SUGGESTIONS = 4


class Silence:
    """Watches whether frames come, and says once why they do not, again when the cause changes.

    Attributes:
        why: what was said last; empty while frames come.
    """

    def __init__(self, node: Node, inputs: Sequence[Input]) -> None:
        self.why = ''
        self._node = node
        self._inputs = inputs
        self._since_s = self._checked_s = time.monotonic()

    def postpone(self) -> None:
        """Frames that came before are still worked on."""
        self._since_s = time.monotonic()

    def end(self) -> None:
        """A frame has come."""
        self.postpone()
        self.why = ''

    def check(self, statistics: SyncStatistics, options: NodeOptions) -> None:
        """Say why, if it has been silent for longer than allowed."""
        now_s, timeout_s = time.monotonic(), options.no_data_timeout
        if not timeout_s or now_s - self._since_s <= timeout_s or (self.why and now_s - self._checked_s < timeout_s):
            return
        before, self.why = self.why, why_no_frames(self._node, self._inputs, statistics, options)
        self._checked_s = now_s
        if _without_numbers(self.why) != _without_numbers(before):
            self._node.get_logger().warning(f'no frame for {timeout_s:g} s: {self.why}')


def why_no_frames(node: Node, inputs: Sequence[Input], statistics: SyncStatistics, options: NodeOptions) -> str:
    """What to tell the user whose node gets no frames: the most basic thing that is wrong.

    Args:
        node: the node, for its clock.
        inputs: camera info, colour and depth.
        statistics: of the synchronizer.
        options: the node's.
    """
    if unpublished := [item for item in inputs if item.num_publishers == 0]:
        domain_id = node.context.get_domain_id()
        return f'no publisher on {_topics(unpublished)}; {_what_there_is(unpublished[0], domain_id)}'
    if mistyped := [item for item in inputs if item.other_type]:
        item = mistyped[0]
        return f'{item.topic} carries {item.other_type}, expected {item.type_name}; remap, or set {_transport(item)}'
    if incompatible := [item for item in inputs if item.incompatible_policy]:
        return (
            f'the publisher of {_topics(incompatible)} offers an incompatible QoS '
            f'({incompatible[0].incompatible_policy}); input_reliability is {options.input_reliability}, '
            'set it to auto or best_effort, or use qos_overrides'
        )
    silent = [item for item in inputs if item.received == 0]
    if silent and (why := _why_clock_stands(node)):
        return why
    if silent:
        return f'{_topics(silent)} {"is" if len(silent) == 1 else "are"} published, but no message has come'
    if statistics.received_info == 0:
        return 'camera info comes, but none that can be used; see the warning about it'
    if stopped := [item for item in inputs[1:] if time.monotonic() - item.heard_s > options.no_data_timeout]:
        why = '; '.join(filter(None, ['though published', _why_clock_stands(node)]))
        return f'nothing has come on {_topics(stopped)} for {_silence_s(stopped):.0f} s, {why}'
    if statistics.newest_gap_ns is not None:
        return (
            f'colour and depth come, but nothing pairs: the stamps of the newest two are '
            f'{abs(statistics.newest_gap_ns) / 1e9:.3f} s apart, and {_allowed(options)}'
        )
    return 'nothing new comes, or nothing that can be used; warnings say what was left out'


def _what_there_is(item: Input, domain_id: int) -> str:
    found = item.candidates()
    if not found:
        return f'nobody publishes {item.type_name}: is the camera or the recording running, with this ROS_DOMAIN_ID, {domain_id}?'
    more = f' and {len(found) - NUM_SUGGESTIONS} more' if len(found) > NUM_SUGGESTIONS else ''
    return f'of that type there is {", ".join(found[:NUM_SUGGESTIONS])}{more}; remap: -r {item.name}:={found[0]}'


def _why_clock_stands(node: Node) -> str:
    if not node.get_parameter('use_sim_time').value or node.get_clock().now().nanoseconds:
        return ''
    publishers = 'is published, but says nothing' if node.count_publishers(CLOCK) else 'has no publisher'
    return f'use_sim_time is true and {CLOCK} {publishers}: start the simulation, or play with --clock'


def _transport(item: Input) -> str:
    return 'rgb_transport' if 'rgb' in item.name else 'depth_transport'


def _silence_s(stopped: Sequence[Input]) -> float:
    return time.monotonic() - max(item.heard_s for item in stopped)


def _allowed(options: NodeOptions) -> str:
    if options.sync_mode == 'exact':
        return 'sync.mode is exact; approximate allows sync.max_interval'
    return f'sync.max_interval is {options.sync_max_interval:g} s'


def _topics(inputs: Sequence[Input]) -> str:
    return ' and '.join(', '.join(item.topic for item in inputs).rsplit(', ', 1))


def _without_numbers(text: str) -> str:
    """What stays the same as long as the cause does."""
    return ''.join(character for character in text if not character.isdigit())
