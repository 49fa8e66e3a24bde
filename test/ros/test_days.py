"""What the node remembers does not grow with time: a million frames, half a day at 25 Hz, through all its bookkeeping."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from msg_adapters.synchronizer import RgbdSet, RgbdSynchronizer
from splatam_core.config import KeyframeConfig, load_config
from splatam_core.errors import FrameError
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.graph.keyframe_graph import KeyframeGraph
from splatam_core.graph.places import Places
from splatam_core.images.view import View
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.mapping.keyframes import KeyframeStore
from splatam_core.mapping.posed import PosedView
from splatam_core.tracking.motion import MotionModel
from splatam_core.types import FrameResult, RgbdFrame, StageTimings, Status
from splatam_ros.frames.buffer import MAX_FRAMES, MAX_POSES, TransformBuffer, TransformError
from splatam_ros.node.diagnostics import FrameCounters
from splatam_ros.node.gate import FrameGate
from splatam_ros.node.outputs import PathHistory
from splatam_ros.node.run_recorder import MAX_WAITING_FRAMES, Waiting
from splatam_ros.node.stamp_filter import StampFilter
from splatam_ros.player.pacing import Backlog, Lateness
from splatam_ros.throttled_warnings import ThrottledWarnings

FRAMES = 1_000_000
PERIOD_NS = 40_000_000
IDENTITY = np.eye(4)
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
    """Everything in the node that sees each frame, without the map, the files and ROS; tests of their own bound these."""

    def __init__(self) -> None:
        self.synchronizer = RgbdSynchronizer('approximate')
        self.warnings = ThrottledWarnings(SimpleNamespace(warning=lambda text: None, debug=lambda text: None))  # type: ignore[arg-type]
        self.filter = StampFilter(10**9, lambda found, last_ns: self.warnings.warn('wrong stamp', str(found.stamp_ns)))
        self.gate = FrameGate(20.0)
        self.counters = FrameCounters()
        self.path = PathHistory(2000)
        self.motion = MotionModel(constant_velocity=True)

    def show(self, number: int) -> None:
        """A frame of a million: some have wrong stamps, miss an image, are lost, refused or fail."""
        stamp_ns = 10**18 + number * PERIOD_NS
        if number % 1000 == 7:
            stamp_ns += 86400 * 10**9 * (1 if number % 2000 == 7 else -1)
        found = self.synchronized(number, stamp_ns) if number % 20 in (0, 2) else [RgbdSet(stamp_ns, number, number, number, 0, 0)]
        for pair in found:
            for right in self.filter.add(pair):
                if self.gate.admits(right.resets, right.stamp_ns):
                    self.process(number, right.stamp_ns)

    def synchronized(self, number: int, stamp_ns: int) -> list[RgbdSet]:
        """One frame of ten: for all it would take twice as long as everything else."""
        self.synchronizer.add_info(stamp_ns, number)
        found = self.synchronizer.add_color(stamp_ns, number)
        return found + self.synchronizer.add_depth(stamp_ns + number % 3 * 10**6, number) if number % 20 else found

    def process(self, number: int, stamp_ns: int) -> None:
        if number % 50 == 1:
            error = FrameError(f'frame {number}') if number % 100 == 1 else ZeroDivisionError(f'frame {number}')
            self.counters.add_bad(error)
            self.warnings.warn_of(type(error).__name__, f'frame {stamp_ns} skipped', error)
            return
        status = Status.LOST if number % 17 == 0 else Status.TRACKED
        self.counters.add(FrameResult(number, stamp_ns, status, None, False, 9, 1.0, 1.0, '', StageTimings()), 'camera')
        self.path.append(stamp_ns, IDENTITY, number)
        if number % 100 == 3:  # each takes as long as the rest of the bookkeeping for a hundred frames
            self.motion.observe(stamp_ns, self.motion.predict(stamp_ns))


@pytest.mark.slow
def test_memory_after_a_million_frames_is_that_after_ten_thousand() -> None:
    node, sizes = Node(), []
    for number in range(FRAMES):
        node.show(number)
        if number in (FRAMES // 100, FRAMES // 10, FRAMES - 1):
            sizes.append(size(node))
    assert node.counters.total > FRAMES / 2 and node.counters.failed > FRAMES / 500
    assert len(node.path._kept) <= 2000
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


def test_what_the_player_remembers_is_bounded() -> None:
    backlog, lateness = Backlog(needs_depth=True), Lateness()
    sizes = []
    count = Lateness.KEPT + 50_000
    for number in range(count):
        stamp_ns = 10**18 + number * PERIOD_NS
        backlog.color(stamp_ns)
        if number % 10:  # one in ten has no depth, and is no frame
            backlog.depth(stamp_ns + 10**6)
        if number % 3 == 2:
            backlog.answered(stamp_ns - 2 * PERIOD_NS)
        lateness.add(number % 7 / 1000)
        if number in (Lateness.KEPT, count - 1):
            sizes.append(size([backlog, lateness]))
    assert backlog.num_colors == count and backlog.num_unpaired > 0 and lateness.p95_ms == 6.0
    assert sizes[1] < sizes[0] + 100_000, sizes


def test_keyframes_of_a_long_way_are_bounded() -> None:
    """Places that are never seen again: the whole way stays covered, more thinly."""
    store, view = KeyframeStore(torch.device('cpu'), KeyframeConfig(budget=50)), View.__new__(View)
    object.__setattr__(view, 'depth', torch.ones(1, 1))
    for number in range(2000):
        T_cam_world = torch.eye(4)
        T_cam_world[2, 3] = -0.02 * number
        store.append(PosedView(view, T_cam_world))
    way_m = [-float(keyframe.T_cam_world[2, 3]) for keyframe in store]
    assert len(store) == 50 and way_m[0] == 0 and way_m[-1] == pytest.approx(0.02 * 1999)
    assert max(np.diff(way_m)) < 0.02 * 2000 / 50 * 4  # no gap of more than a few times the mean


def test_what_waits_for_a_full_disk_is_bounded() -> None:
    waiting = Waiting(load_config('quick'), GaussianMap(), (), Places(), KeyframeGraph(load_config('quick'), None), is_saved=False)
    camera = PinholeCamera(64, 48, 55.0, 55.0, 31.5, 23.5)
    frame = RgbdFrame(10**18, np.zeros((48, 64, 3), np.uint8), np.ones((48, 64), np.float32), camera)
    result = FrameResult(0, 10**18, Status.LOST, None, False, 9, 1.0, 1.0, '', StageTimings())
    kept = [waiting.add(frame, result) for _ in range(MAX_WAITING_FRAMES + 10)]
    assert sum(kept) == len(waiting.frames) == MAX_WAITING_FRAMES and not any(kept[MAX_WAITING_FRAMES:])
    assert waiting.frames[0][0].rgb.nbytes == 3 and waiting.frames[0][0].camera == camera  # the images do not wait
