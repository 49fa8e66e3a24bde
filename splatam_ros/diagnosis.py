"""Why no frames come, in one sentence."""

from __future__ import annotations

from collections.abc import Sequence

from msg_adapters.synchronizer import SyncStatistics
from splatam_ros.inputs import Input
from splatam_ros.parameters import NodeOptions


def why_no_frames(inputs: Sequence[Input], statistics: SyncStatistics, options: NodeOptions) -> str:
    """What to tell the user whose node gets no frames: the most basic thing that is wrong.

    Args:
        inputs: camera info, colour and depth.
        statistics: of the synchronizer.
        options: the node's.
    """
    if unpublished := [item.topic for item in inputs if item.num_publishers == 0]:
        return f'no publisher on {_and(unpublished)}; start the camera, or remap: --ros-args -r rgb/image:=/its/topic'
    if incompatible := [item.topic for item in inputs if item.is_incompatible]:
        return (
            f'the publisher of {_and(incompatible)} offers an incompatible QoS (best effort) and '
            f'input_reliability is {options.input_reliability}; set it to auto or best_effort'
        )
    if silent := [item.topic for item in inputs if item.received == 0]:
        return f'{_and(silent)} {"is" if len(silent) == 1 else "are"} published, but no message has come'
    if statistics.received_info == 0:
        return 'camera info comes, but none that can be used; see the warning about it'
    if statistics.sets == 0 and statistics.newest_gap_ns is not None:
        return (
            f'colour and depth come, but nothing pairs: the stamps of the newest two are '
            f'{abs(statistics.newest_gap_ns) / 1e9:.3f} s apart, and {_allowed(options)}'
        )
    return 'nothing new comes, or nothing that can be used; warnings say what was left out'


def _allowed(options: NodeOptions) -> str:
    if options.sync_mode == 'exact':
        return 'sync.mode is exact; approximate allows sync.max_interval'
    return f'sync.max_interval is {options.sync_max_interval:g} s'


def _and(topics: Sequence[str]) -> str:
    return ' and '.join(', '.join(topics).rsplit(', ', 1))
