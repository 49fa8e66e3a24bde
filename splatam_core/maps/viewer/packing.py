"""Gaussians as a browser draws them: 32 bytes each, in chunks of which only the changed ones are sent again."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatam_core.geometry.se3 import rotation_from_quaternion
from splatam_core.types import MapSnapshot

SCALE = 10.0
"""Lengths are multiplied by this: covariances have 16 bits, in which the variance of a millimetre would be 17 steps."""

MAX_VARIANCE = 65504.0  # of 16 bits: a radius of 25 m
ROW = np.dtype([('mean', '<f4', 3), ('group', '<u4'), ('covariance', '<f2', 6), ('rgba', 'u1', 4)])
UPPER = np.triu_indices(3)
CAPACITY = 8192
"""Gaussians of a chunk. A browser copies its whole map when the number of Gaussians changes, so chunks are padded."""

MOVED_M, GREW, RECOLORED, CHANGED_SHARE = 2e-3, 0.05, 4, 0.01
"""What can be seen: metres, share of the variance, steps of colour or opacity; share of a chunk's Gaussians."""


Key = tuple[int, int]
"""Of a chunk: number of its group of frames, and of its first Gaussian in the group."""


def pack(snapshot: MapSnapshot) -> NDArray[np.void]:
    """Return Gaussians as rows [N] of ``ROW``: the layout of viser's buffers, with lengths times ``SCALE``."""
    rows = np.zeros(len(snapshot.means), ROW)
    rows['mean'] = snapshot.means * np.float32(SCALE)
    variances = SCALE**2 * np.exp(2 * np.minimum(snapshot.log_scales, 8.0))
    if snapshot.rotations is None:
        rows['covariance'][:, [0, 3, 5]] = np.minimum(variances, MAX_VARIANCE)
    else:
        R = rotation_from_quaternion(snapshot.rotations.astype(np.float64))
        covariances = (R * np.minimum(variances, MAX_VARIANCE)[:, None]) @ R.transpose(0, 2, 1)
        rows['covariance'] = covariances[:, UPPER[0], UPPER[1]]
    rows['rgba'][:, :3] = _bytes(snapshot.rgb)
    rows['rgba'][:, 3] = _bytes(snapshot.opacities)
    return rows


def _bytes(values: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class Changes:
    """What must be done to a browser's chunks.

    Attributes:
        changed: rows [CAPACITY] of each chunk that is new or differs, by key; padded with invisible ones.
        removed: keys of chunks that are no more.
    """

    changed: Mapping[Key, NDArray[np.void]]
    removed: tuple[Key, ...]


class Chunks:
    """Divides a map into chunks by the frames that added the Gaussians, and remembers what was sent of each.

    Gaussians keep their order, and pruning only makes a group of frames smaller; so a chunk stays the same set as long as
    nothing of it is pruned.
    """

    def __init__(self, capacity: int = CAPACITY) -> None:
        self._capacity = capacity
        self._first: list[int] = []  # frame with which each group begins
        self._newest = -1
        self._sent: dict[Key, NDArray[np.void]] = {}

    def update(self, rows: NDArray[np.void], added_by: NDArray[np.integer], *, exactly: bool = False) -> Changes:
        """Compare a map with what was sent.

        Args:
            rows: [N] of ``pack``.
            added_by: [N] number of the frame that added each, not decreasing.
            exactly: True to send what differs at all, False to send what can be seen to differ.
        """
        now = {key: self._padded(rows[begin:end]) for key, begin, end in self._ranges(added_by)}
        changed = {
            key: chunk
            for key, chunk in now.items()
            if key not in self._sent or (differs_at_all if exactly else differs_visibly)(chunk, self._sent[key])
        }
        removed = tuple(key for key in self._sent if key not in now)
        self._sent = {key: changed[key] if key in changed else self._sent[key] for key in now}
        return Changes(changed, removed)

    def clear(self) -> tuple[Key, ...]:
        """Forget everything, because a new map begins. Returns the keys of all chunks."""
        keys = tuple(self._sent)
        self._first, self._newest, self._sent = [], -1, {}
        return keys

    def _ranges(self, added_by: NDArray[np.integer]) -> list[tuple[Key, int, int]]:
        """Return key, first and one past the last index of each chunk."""
        frames, counts = np.unique(added_by, return_counts=True)
        size = int(counts[(frames >= self._first[-1]) & (frames <= self._newest)].sum()) if self._first else self._capacity
        for frame, count in zip(frames[frames > self._newest], counts[frames > self._newest]):
            if size + count > self._capacity:
                self._first.append(int(frame))
                size = 0
            size += int(count)
            self._newest = int(frame)
        bounds = [*np.searchsorted(added_by, self._first).tolist(), len(added_by)]
        return [
            ((group, begin - bounds[group]), begin, min(begin + self._capacity, bounds[group + 1]))
            for group in range(len(self._first))
            for begin in range(bounds[group], bounds[group + 1], self._capacity)
        ]

    def _padded(self, rows: NDArray[np.void]) -> NDArray[np.void]:
        padded = np.zeros(self._capacity, ROW)
        padded[: len(rows)] = rows
        return padded


def differs_at_all(chunk: NDArray[np.void], sent: NDArray[np.void]) -> bool:
    """Whether any bit differs."""
    return chunk.tobytes() != sent.tobytes()


def differs_visibly(chunk: NDArray[np.void], sent: NDArray[np.void]) -> bool:
    """Whether more than a few Gaussians have moved, grown or changed colour so that it can be seen."""
    moved = np.abs(chunk['mean'] - sent['mean']).max(axis=1) > SCALE * MOVED_M
    now, before = (rows['covariance'][:, [0, 3, 5]].astype(np.float32).sum(axis=1) for rows in (chunk, sent))
    grew = np.abs(now - before) > GREW * before
    recolored = np.abs(chunk['rgba'].astype(np.int16) - sent['rgba']).max(axis=1) > RECOLORED
    in_use = max(1, int((chunk['rgba'][:, 3] > 0).sum()))
    return int((moved | grew | recolored).sum()) > CHANGED_SHARE * in_use
