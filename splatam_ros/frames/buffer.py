"""A buffer of coordinate transforms over time. It replaces tf2's buffer, so that the node works without tf2.

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

KEEP_NS = 60 * 10**9  # how much of a moving frame's past is kept
MAX_GAP_NS = 500_000_000  # longest gap that is interpolated; 2 Hz is slow for odometry
JUMP_NS = 10**9  # messages overtake each other by less; a larger step back means that the clock was set back
MAX_POSES = 60_000  # of one frame: a minute at 1 kHz
MAX_FRAMES = 1000  # far more than robots have; some publish a new name for each thing they see
MAX_DEPTH = 100  # frames from leaf to root; more means a loop


class TransformError(SplatamError):
    """A transform is not known; the message says which one and why."""


class History:
    """Poses of one frame in its parent, ordered by stamp."""

    def __init__(self) -> None:
        self._poses: list[tuple[int, Matrix]] = []

    def add(self, stamp_ns: int, T_parent_child: Matrix) -> None:
        """Add a pose. Old poses are dropped, and all poses are dropped when time jumps back."""
        if self._poses and stamp_ns < self._poses[-1][0] - JUMP_NS:
            self._poses.clear()
        at = self._index(stamp_ns)
        is_known = at < len(self._poses) and self._poses[at][0] == stamp_ns
        self._poses[at : at + is_known] = [(stamp_ns, T_parent_child)]
        if self._poses[0][0] < stamp_ns - 2 * KEEP_NS:  # rarely, because it copies the remaining poses
            del self._poses[: self._index(stamp_ns - KEEP_NS)]
        if len(self._poses) > 2 * MAX_POSES:
            del self._poses[:-MAX_POSES]

    def at(self, stamp_ns: int) -> Matrix:
        """Returns the [4, 4] pose at a stamp. It is interpolated, never extrapolated.

        Raises:
            TransformError: the stamp is outside the known range, or in a gap that is too long.
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
        """Returns True if every known pose is older than the stamp."""
        return not self._poses or self._poses[-1][0] < stamp_ns

    def _index(self, stamp_ns: int) -> int:
        return bisect_left(self._poses, stamp_ns, key=itemgetter(0))


class TransformBuffer:
    """A tree of frames. Each frame has one parent, and is static or moving in it. Thread-safe.

    It holds at most ``MAX_FRAMES`` static frames, the first ones, and as many moving ones, those received last.
    """

    def __init__(self) -> None:
        self._static: dict[str, tuple[str, Matrix]] = {}
        self._moving: dict[str, tuple[str, History]] = {}
        self._changed = threading.Condition()

    def set_static(self, parent: str, child: str, T_parent_child: Matrix) -> None:
        """Set a transform that holds at all times.

        Raises:
            TransformError: there are too many frames.
        """
        with self._changed:
            if child not in self._static and len(self._static) >= MAX_FRAMES:
                raise TransformError(f'{MAX_FRAMES} static frames are known already')
            self._static[child] = parent, T_parent_child
            self._changed.notify_all()

    def add(self, parent: str, child: str, stamp_ns: int, T_parent_child: Matrix) -> None:
        """Add the pose of a moving frame at a stamp."""
        with self._changed:
            link = self._moving.pop(child, None)
            if link is None or link[0] != parent:
                link = parent, History()
            self._moving[child] = link  # the last in order
            if len(self._moving) > MAX_FRAMES:
                del self._moving[next(iter(self._moving))]
            link[1].add(stamp_ns, T_parent_child)
            self._changed.notify_all()

    def static_parent(self, child: str) -> str | None:
        """Returns the parent of a static frame; None if the frame is not static."""
        with self._changed:
            return self._static[child][0] if child in self._static else None

    def static_root(self, frame: str) -> str:
        """Returns the topmost frame that is reached from a frame over static transforms."""
        with self._changed:
            for _ in range(MAX_DEPTH):
                if frame not in self._static:
                    break
                frame = self._static[frame][0]
            return frame

    def lookup(self, target: str, source: str, stamp_ns: int = 0, timeout_s: float = 0.0) -> Matrix:
        """Returns the [4, 4] ``T_target_source`` at a stamp. Waits while a pose on the path is older than the stamp.

        Args:
            target: frame to transform into.
            source: frame to transform from.
            stamp_ns: time of the transform; has no effect if all transforms on the path are static.
            timeout_s: longest wait.

        Raises:
            TransformError: the frames are not connected, or a pose on the path is not known at the stamp.
        """
        with self._changed:
            self._changed.wait_for(lambda: not self._is_pending(target, source, stamp_ns), timeout_s)
            up, down = self._path(target, source)
            return se3.inverse(self._compose(down, stamp_ns)) @ self._compose(up, stamp_ns)

    def _is_pending(self, target: str, source: str, stamp_ns: int) -> bool:
        """Returns True if a pose on the path has not arrived yet."""
        try:
            up, down = self._path(target, source)
        except TransformError:
            return False
        moving = [self._moving[child][1] for child in (*up, *down) if child not in self._static]
        return any(history.ends_before(stamp_ns) for history in moving)

    def _path(self, target: str, source: str) -> tuple[list[str], list[str]]:
        """Returns the frames from the source, and from the target, up to their nearest common ancestor (excluded)."""
        above_source, above_target = self._ancestors(source), self._ancestors(target)
        common = next((frame for frame in above_source if frame in above_target), None)
        if common is None:
            raise TransformError(f"no transform connects '{source}' to '{target}'")
        return above_source[: above_source.index(common)], above_target[: above_target.index(common)]

    def _ancestors(self, frame: str) -> list[str]:
        """Returns the frame itself and every frame above it."""
        found = [frame]
        while (link := self._static.get(found[-1]) or self._moving.get(found[-1])) is not None:
            found.append(link[0])
            if len(found) > MAX_DEPTH:
                raise TransformError(f"the transforms above '{frame}' form a loop")
        return found

    def _compose(self, frames: list[str], stamp_ns: int) -> Matrix:
        """Returns the [4, 4] pose of the first frame in the parent of the last frame."""
        T: Matrix = np.eye(4)
        for frame in frames:
            T = self._pose(frame, stamp_ns) @ T
        return T

    def _pose(self, child: str, stamp_ns: int) -> Matrix:
        if child in self._static:
            return self._static[child][1]
        parent, history = self._moving[child]
        try:
            return history.at(stamp_ns)
        except TransformError as error:
            raise TransformError(f"'{child}' in '{parent}' is not known at the stamp: {error}") from None
