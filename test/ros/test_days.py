"""What the node remembers does not grow with time: a million frames, half a day at 25 Hz, through all its bookkeeping."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from msg_adapters.synchronizer import RgbdSynchronizer
from splatam_core.errors import FrameError
from splatam_core.types import FrameResult, StageTimings, Status
from splatam_ros.frames.buffer import MAX_FRAMES, MAX_POSES, TransformBuffer, TransformError
from splatam_ros.node.diagnostics import FrameCounters
from splatam_ros.node.gate import FrameGate
from splatam_ros.node.outputs import PathHistory
from splatam_ros.node.stamp_filter import StampFilter
from splatam_ros.throttled_warnings import ThrottledWarnings

FRAMES = 1_000_000
PERIOD_NS = 40_000_000
SKIPPED = (type, np.ndarray, str, bytes, int, float, bool, type(None), type(len), type(lambda: None))


def size(root: object) -> int:
    """Returns the bytes of an object and all that it holds."""
    seen: set[int] = set()
    waiting, total = deque([root]), 0
    while waiting:
        item = waiting.popleft()
        if id(item) in seen:
            continue
        seen.add(id(item))
        total += sys.getsizeof(item)
        if not isinstance(item, SKIPPED):
            waiting.extend(children(item))
    return total


def children(item: Any) -> Iterable[object]:
    if isinstance(item, dict):
        return [*item.keys(), *item.values()]
    if isinstance(item, (list, tuple, set, frozenset, deque)):
        return item
    slots = [getattr(item, name) for name in getattr(type(item), '__slots__', ()) if hasattr(item, name)]
    return [*slots, *getattr(item, '__dict__', {}).values()]


class Node:
    """Everything in the node that sees each frame, without SLAM and without ROS."""

    def __init__(self) -> None:
        self.synchronizer = RgbdSynchronizer('approximate')
        self.warnings = ThrottledWarnings(SimpleNamespace(warning=lambda text: None, debug=lambda text: None))  # type: ignore[arg-type]
        self.filter = StampFilter(10**9, lambda found, last_ns: self.warnings.warn('wrong stamp', str(found.stamp_ns)))
        self.gate = FrameGate(20.0)
        self.counters = FrameCounters()
        self.path = PathHistory(2000)

    def show(self, number: int) -> None:
        """A frame of a million: some have wrong stamps, miss an image, are lost, refused or fail."""
        stamp_ns = 10**18 + number * PERIOD_NS
        if number % 1000 == 7:
            stamp_ns += 86400 * 10**9 * (1 if number % 2000 == 7 else -1)
        self.synchronizer.add_info(stamp_ns, number)
        found = self.synchronizer.add_color(stamp_ns, number)
        if number % 10:
            found += self.synchronizer.add_depth(stamp_ns + number % 3 * 10**6, number)
        for pair in found:
            for right in self.filter.add(pair):
                if self.gate.admits(right.resets, right.stamp_ns):
                    self.process(number, right.stamp_ns)

    def process(self, number: int, stamp_ns: int) -> None:
        if number % 50 == 1:
            error = FrameError(f'frame {number}') if number % 100 == 1 else ZeroDivisionError(f'frame {number}')
            self.counters.add_bad(error)
            self.warnings.warn_of(type(error).__name__, f'frame {stamp_ns} skipped', error)
            return
        status = Status.LOST if number % 17 == 0 else Status.TRACKED
        self.counters.add(FrameResult(number, stamp_ns, status, None, False, 9, 1.0, 1.0, '', StageTimings()), 'camera')
        self.path.append((stamp_ns, 0.0))


@pytest.mark.slow
def test_memory_after_a_million_frames_is_that_after_ten_thousand() -> None:
    node, sizes = Node(), []
    for number in range(FRAMES):
        node.show(number)
        if number in (FRAMES // 100, FRAMES // 10, FRAMES - 1):
            sizes.append(size(node))
    assert node.counters.total > FRAMES / 2 and node.counters.failed > FRAMES / 500
    assert len(node.path.poses) <= 2000
    assert max(sizes) < sizes[0] * 1.5 + 200_000, sizes  # the path grows until it is thinned out, to 2000 poses


def test_transforms_of_others_are_bounded() -> None:
    """Some programs publish a frame for each thing that they see, and some clocks stand still."""
    buffer, T = TransformBuffer(), np.eye(4)
    for number in range(3 * MAX_FRAMES):
        buffer.add('map', f'thing_{number}', number, T)
        buffer.add('odom', 'base', 10**9 + number, T)
    assert len(buffer._moving) == MAX_FRAMES
    assert np.array_equal(buffer.lookup('odom', 'base', 10**9 + 2 * MAX_FRAMES), T)  # one that is still published stays
    for number in range(2 * MAX_POSES + 10):
        buffer.add('odom', 'base', 10**9 + 3 * MAX_FRAMES + number, T)
    assert len(buffer._moving['base'][1]._poses) <= 2 * MAX_POSES
    for number in range(MAX_FRAMES):
        buffer.set_static('base', f'static_{number}', T)
    buffer.set_static('base', 'static_0', T)
    with pytest.raises(TransformError, match='static frames are known already'):
        buffer.set_static('base', 'one_too_many', T)
