"""Which waiting colour and depth message belong together: a pure function of the two queues.

The answer depends on the stamps alone, not on the order of arrival, as long as each stream's own stamps
increase: where a message still to come could change it, it is 'not yet'.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum, auto
from typing import NamedTuple


class Key(NamedTuple):
    """When a message was taken: nanoseconds within an epoch. Epochs follow one another."""

    epoch: int
    stamp_ns: int


class _Verdict(Enum):
    PAIR = auto()
    SKIP = auto()
    WAIT = auto()


def first_pair(color: Sequence[Key], depth: Sequence[Key], max_interval_ns: int, is_final: bool = False) -> tuple[Key, Key] | None:
    """The earliest colour and depth that belong together, as far as can be known.

    A pair is at most ``max_interval_ns`` apart, and neither a message between the two nor the next one of the
    older stream fits better. An exact match is known at once; others wait for the messages that could
    fit better, unless these are known not to come.

    Args:
        color: keys of the waiting colour messages, increasing.
        depth: keys of the waiting depth messages, increasing.
        max_interval_ns: largest distance of partners; 0 pairs equal stamps only.
        is_final: nothing more will come.
    """
    i = j = 0
    while i < len(color) and j < len(depth):
        color_is_older = color[i] <= depth[j]
        next_color, next_depth = color[i : i + 2], depth[j : j + 2]
        older, other = (next_color, next_depth) if color_is_older else (next_depth, next_color)
        verdict = _judge(older, other, max_interval_ns, is_final)
        if verdict is _Verdict.PAIR:
            return color[i], depth[j]
        if verdict is _Verdict.WAIT:
            return None
        i, j = (i + 1, j) if color_is_older else (i, j + 1)
    return None


def _judge(older: Sequence[Key], other: Sequence[Key], max_interval_ns: int, is_final: bool) -> _Verdict:
    """Whether the first of both are a pair, or the older of them will have no partner.

    Each holds the next message of its stream and, if that is known, the one after it.
    """
    gap = _distance(older[0], other[0])
    if gap > max_interval_ns:
        return _Verdict.SKIP
    if gap == 0:
        return _Verdict.PAIR
    if len(older) < 2:
        return _Verdict.PAIR if is_final else _Verdict.WAIT
    rival_gap = _distance(older[1], other[0])
    if rival_gap >= gap:
        return _Verdict.PAIR
    # The rival fits better; but if it has a still better partner of its own, everybody gets one.
    is_rival_content = len(other) > 1 and _distance(older[1], other[1]) < rival_gap
    return _Verdict.PAIR if is_rival_content else _Verdict.SKIP


def _distance(a: Key, b: Key) -> float:
    return abs(a.stamp_ns - b.stamp_ns) if a.epoch == b.epoch else math.inf
