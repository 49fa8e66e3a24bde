"""Decides which waiting colour and depth messages belong together: a pure function of the two queues.

The result depends only on the stamps, not on the order of arrival, as long as the stamps of each stream
increase. If a later message could change the result, there is no result yet.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum, auto
from typing import NamedTuple


class Key(NamedTuple):
    """The time of a message: nanoseconds within an epoch. Later epochs have larger numbers."""

    epoch: int
    stamp_ns: int


class _Verdict(Enum):
    PAIR = auto()
    SKIP = auto()
    WAIT = auto()


def first_pair(color: Sequence[Key], depth: Sequence[Key], max_interval_ns: int, is_final: bool = False) -> tuple[Key, Key] | None:
    """Returns the earliest colour and depth message that belong together; None if none is certain yet.

    A pair is at most ``max_interval_ns`` apart, and neither a message between the two nor the next one of the
    older stream fits better. An exact match is certain at once. Other pairs wait for the messages that could
    fit better, unless ``is_final``.

    Args:
        color: keys of the waiting colour messages, increasing.
        depth: keys of the waiting depth messages, increasing.
        max_interval_ns: largest distance of partners; 0 pairs equal stamps only.
        is_final: True if no more messages will come.
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
    """Decide whether the first messages of both streams are a pair, or the older of them will have no partner.

    Each sequence holds the next message of its stream and, if it has arrived, the one after it.
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
    # The rival fits better. But if it has an even better partner, all of them are paired.
    rival_fits_elsewhere = len(other) > 1 and _distance(older[1], other[1]) < rival_gap
    return _Verdict.PAIR if rival_fits_elsewhere else _Verdict.SKIP


def _distance(a: Key, b: Key) -> float:
    return abs(a.stamp_ns - b.stamp_ns) if a.epoch == b.epoch else math.inf
