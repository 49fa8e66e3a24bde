"""A tree of coordinate frames over time: what tf2's buffer is for, in numpy, so that it works where tf2 is absent.

``T_parent_child`` is the pose of the child in its parent: ``p_parent = T_parent_child @ p_child``.
"""

from __future__ import annotations

import threading
from bisect import bisect_left
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from splatam_core.errors import SplatamError
from splatam_core.geometry import se3

Matrix = NDArray[np.float64]

KEEP_NS = 60 * 10**9  # of a moving frame's past
MAX_GAP_NS = 500_000_000  # between two poses that may be interpolated; 2 Hz is slow for odometry
JUMP_NS = 10**9  # further back in time than messages overtake each other: the clock was set back
MAX_DEPTH = 100  # frames from leaf to root; more are a loop


class TransformError(SplatamError):
    """A transform that is not known: which, and why."""


class History:
    """Poses of one frame in its parent, by stamp."""

    def __init__(self) -> None:
        self._poses: list[tuple[int, Matrix]] = []

    def add(self, stamp_ns: int, T_parent_child: Matrix) -> None:
        """Take a pose; forget what is too old, and everything when time has jumped back."""
        if self._poses and stamp_ns < self._poses[-1][0] - JUMP_NS:
            self._poses.clear()
        at = self._index(stamp_ns)
        is_known = at < len(self._poses) and self._poses[at][0] == stamp_ns
        self._poses[at : at + is_known] = [(stamp_ns, T_parent_child)]
        if self._poses[0][0] < stamp_ns - 2 * KEEP_NS:  # rarely, since it copies the rest
            del self._poses[: self._index(stamp_ns - KEEP_NS)]

    def at(self, stamp_ns: int) -> Matrix:
        """[4, 4] at a stamp, interpolated, never extrapolated.

        Raises:
            TransformError: the stamp is outside what is known, or in a gap of it.
        """
        after = self._index(stamp_ns)
        if after == len(self._poses):
            raise TransformError(f'the newest is {(stamp_ns - self._poses[-1][0]) / 1e9:.3f} s older')
        after_ns, T_after = self._poses[after]
        if after_ns == stamp_ns:
            return T_after
        if after == 0:
            raise TransformError(f'the oldest is {(after_ns - stamp_ns) / 1e9:.3f} s newer')
        before_ns, T_before = self._poses[after - 1]
        if after_ns - before_ns > MAX_GAP_NS:
            raise TransformError(f'it is in a gap of {(after_ns - before_ns) / 1e9:.3f} s')
        return se3.interpolate(T_before, T_after, (stamp_ns - before_ns) / (after_ns - before_ns))

    def ends_before(self, stamp_ns: int) -> bool:
        """Whether the stamp is yet to come."""
        return not self._poses or self._poses[-1][0] < stamp_ns

    def _index(self, stamp_ns: int) -> int:
        return bisect_left(self._poses, stamp_ns, key=itemgetter(0))


class TransformTree:
    """Frames, each with one parent, fixed to it or moving. Thread-safe."""

    def __init__(self) -> None:
        self._fixed: dict[str, tuple[str, Matrix]] = {}
        self._moving: dict[str, tuple[str, History]] = {}
        self._changed = threading.Condition()

    def fix(self, parent: str, child: str, T_parent_child: Matrix) -> None:
        """Fix a frame to its parent, from now on and for all times."""
        with self._changed:
            self._fixed[child] = parent, T_parent_child
            self._changed.notify_all()

    def move(self, parent: str, child: str, stamp_ns: int, T_parent_child: Matrix) -> None:
        """Say where a frame is in its parent at a stamp."""
        with self._changed:
            if self._moving.get(child, (None,))[0] != parent:
                self._moving[child] = parent, History()
            self._moving[child][1].add(stamp_ns, T_parent_child)
            self._changed.notify_all()

    def fixed_parent(self, child: str) -> str | None:
        """The frame that a frame is fixed to, if it is."""
        with self._changed:
            return self._fixed.get(child, (None,))[0]

    def root(self, frame: str) -> str:
        """The last frame on the way up along fixed links."""
        with self._changed:
            for _ in range(MAX_DEPTH):
                if frame not in self._fixed:
                    break
                frame = self._fixed[frame][0]
            return frame

    def lookup(self, target: str, source: str, stamp_ns: int = 0, timeout_s: float = 0.0) -> Matrix:
        """[4, 4] ``T_target_source`` at a stamp; waits for the newest poses on the way if they are yet to come.

        Args:
            target: frame to transform into.
            source: frame to transform from.
            stamp_ns: when; no matter between frames that are fixed to each other.
            timeout_s: longest wait.

        Raises:
            TransformError: the frames are not connected, or not known at the stamp.
        """
        with self._changed:
            self._changed.wait_for(lambda: not self._is_due(target, source, stamp_ns), timeout_s)
            up, down = self._path(target, source)
            return se3.inverse(self._compose(down, stamp_ns)) @ self._compose(up, stamp_ns)

    def _is_due(self, target: str, source: str, stamp_ns: int) -> bool:
        """Whether a pose on the way is yet to come."""
        try:
            up, down = self._path(target, source)
        except TransformError:
            return False
        moving = [self._moving[child][1] for child in (*up, *down) if child not in self._fixed]
        return any(history.ends_before(stamp_ns) for history in moving)

    def _path(self, target: str, source: str) -> tuple[list[str], list[str]]:
        """The frames below the nearest common ancestor: those from the source up, and those from the target up."""
        above_source, above_target = self._ancestors(source), self._ancestors(target)
        common = next((frame for frame in above_source if frame in above_target), None)
        if common is None:
            raise TransformError(f"no transform connects '{source}' to '{target}'")
        return above_source[: above_source.index(common)], above_target[: above_target.index(common)]

    def _ancestors(self, frame: str) -> list[str]:
        """The frame, and those above it."""
        found = [frame]
        while (link := self._fixed.get(found[-1]) or self._moving.get(found[-1])) is not None:
            found.append(link[0])
            if len(found) > MAX_DEPTH:
                raise TransformError(f"the transforms above '{frame}' form a loop")
        return found

    def _compose(self, frames: list[str], stamp_ns: int) -> Matrix:
        """Pose of the first of these in the parent of the last."""
        T: Matrix = np.eye(4)
        for frame in frames:
            T = self._pose(frame, stamp_ns) @ T
        return T

    def _pose(self, child: str, stamp_ns: int) -> Matrix:
        if child in self._fixed:
            return self._fixed[child][1]
        parent, history = self._moving[child]
        try:
            return history.at(stamp_ns)
        except TransformError as error:
            raise TransformError(f"'{child}' in '{parent}' is not known at the stamp: {error}") from None
