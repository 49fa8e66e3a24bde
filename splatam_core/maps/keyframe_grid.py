"""An occupancy grid that grows with a map: each keyframe is carved once, and its part of the grid moves with the keyframe.

What a view says about the voxels before it is kept, packed in bits. When the pose of a keyframe is corrected, its part is taken
back and put where the keyframe is now; it is not carved again.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatam_core.errors import ExportError
from splatam_core.geometry import se3
from splatam_core.mapping.posed import PosedView
from splatam_core.maps.grid import MIN_HITS, DepthView, Grid, GridSettings, LocalGrid, Voxels, carve, window_of

Array = NDArray[np.float64]

SAME_VIEW_M, SAME_VIEW_RAD = 0.3, np.radians(12)
"""A keyframe that has moved and turned less than this from as many others as a surface needs says nothing new."""

SAME_POSE_CELLS, SAME_POSE_RAD = 0.25, np.radians(0.5)
"""A correction that is smaller than this is not worth the work."""


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """What a keyframe contributes.

    Attributes:
        low: see ``LocalGrid``.
        shape: rows, columns, layers.
        bits: hits and passes, packed.
        T_grid_cam: [4, 4] where it was carved.
        placed_at: [4, 4] where it is counted.
    """

    low: tuple[int, int]
    shape: tuple[int, ...]
    bits: NDArray[np.uint8]
    T_grid_cam: Array
    placed_at: Array

    @classmethod
    def of(cls, local: LocalGrid, T_grid_cam: Array) -> _Part:
        """Packs what a view says, without unknown margins."""
        known = np.any(local.hits | local.passes, axis=2)
        rows, columns = (np.flatnonzero(known.any(axis=axis)) for axis in (1, 0))
        row, column = (slice(index[0], index[-1] + 1) if len(index) else slice(0, 0) for index in (rows, columns))
        kept = np.stack([local.hits[row, column], local.passes[row, column]])
        low = local.low[0] + (column.start or 0), local.low[1] + (row.start or 0)
        return cls(low, kept.shape[1:], np.packbits(kept), T_grid_cam, T_grid_cam)

    def local(self, settings: GridSettings) -> LocalGrid:
        """Returns what it says, at the place where it is counted."""
        count = 2 * int(np.prod(self.shape))
        hits, passes = np.unpackbits(self.bits, count=count).astype(bool).reshape(2, *self.shape)
        carved = LocalGrid(self.low, hits, passes)
        if self.placed_at is self.T_grid_cam:
            return carved
        return moved(carved, self.placed_at @ se3.inverse(self.T_grid_cam), settings)


def moved(local: LocalGrid, T: Array, settings: GridSettings) -> LocalGrid:
    """Return a local grid after a motion [4, 4] in the grid's axes: turned about the vertical, and shifted.

    Each voxel takes what is nearest to its centre. A tilt is left out: corrections do not change which way is up.
    """
    cell, (rows, columns, layers) = settings.resolution_m, local.hits.shape
    yaw = np.arctan2(T[1, 0] - T[0, 1], T[0, 0] + T[1, 1])
    R = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    begin = cell * np.array(local.low)
    corners = begin + cell * np.array([[0, 0], [columns, 0], [0, rows], [columns, rows]])
    middle = corners.mean(axis=0)  # a tilt moves it, too; so it goes where the full motion takes it
    height = settings.min_height_m + settings.layers * settings.layer_m / 2
    target = T[:3, :3] @ [*middle, height] + T[:3, 3]
    turned = (corners - middle) @ R.T + target[:2]
    low = np.floor(turned.min(axis=0) / cell).astype(np.int64)
    high = np.floor(turned.max(axis=0) / cell).astype(np.int64) + 1
    centres = np.stack(np.meshgrid(*(cell * (np.arange(low[axis], high[axis]) + 0.5) for axis in (0, 1))), axis=-1)
    source = ((centres - target[:2]) @ R + middle - begin) / cell
    column, row = (np.floor(source[..., axis]).astype(np.int64) for axis in (0, 1))
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    shift = round(float(target[2] - height) / settings.layer_m)
    found = []
    for seen in (local.hits, local.passes):
        voxels = np.zeros((*inside.shape, layers), bool)
        voxels[inside] = _shifted(seen[row[inside], column[inside]], shift)
        found.append(voxels)
    return LocalGrid((int(low[0]), int(low[1])), *found)


def _shifted(columns: NDArray[np.bool_], layers: int) -> NDArray[np.bool_]:
    """Return columns of voxels [N, layers] moved upwards."""
    result = np.zeros_like(columns)
    count = columns.shape[1]
    if abs(layers) < count:
        result[:, max(0, layers) : count + min(0, layers)] = columns[:, max(0, -layers) : count - max(0, layers)]
    return result


class KeyframeGrid:
    """The floor plan of the keyframes of a map.

    Attributes:
        T_grid_world: [4, 4] the world in the grid's axes, z up and 0 on the floor.
        settings: what the grid shows.
        left_out: why some of the keyframes are not in the grid, after ``update``; '' if all are.
    """

    def __init__(self, T_grid_world: Array, settings: GridSettings) -> None:
        self.T_grid_world, self.settings, self.left_out = T_grid_world, settings, ''
        self._voxels = Voxels(settings)
        self._parts: dict[int, _Part] = {}
        self._skipped: dict[int, Array] = {}  # frames whose view others have, at this pose

    def update(self, keyframes: Iterable[PosedView], most: int) -> bool:
        """Take in keyframes that are new or were corrected. Those that the map has dropped stay as they were.

        A keyframe that is too far away for a grid that holds it, too, is left out.

        Args:
            keyframes: in the host's memory, those of the map.
            most: largest number of keyframes to carve or to move in this call.

        Returns:
            True if the grid changed.

        Raises:
            ExportError: not even one keyframe fits into the grid.
        """
        work, refused = 0, []
        for keyframe in keyframes:
            if work >= most:
                break
            try:
                work += self._take(keyframe)
            except ExportError as error:
                refused.append(error)
        if refused and not self._parts:
            raise refused[0]
        self.left_out = f'{len(refused)} keyframes are left out: {refused[0]}' if refused else ''
        return work > 0

    def _take(self, keyframe: PosedView) -> bool:
        """Takes in a keyframe. Returns whether there was something to do.

        Raises:
            ExportError: the grid would be too large.
        """
        T_grid_cam = self.T_grid_world @ se3.inverse(keyframe.T_cam_world.numpy().astype(np.float64))
        if keyframe.frame in self._parts:
            return self._place(keyframe.frame, T_grid_cam)
        if self._is_known(keyframe.frame, T_grid_cam):
            return False
        self._carve(keyframe, T_grid_cam)
        return True

    def grid(self) -> Grid:
        """Return the grid.

        Raises:
            ExportError: every cell is unknown.
        """
        return self._voxels.grid(self.T_grid_world)

    def _carve(self, keyframe: PosedView, T_grid_cam: Array) -> None:
        view = keyframe.view
        self._voxels.check_room([window_of(T_grid_cam, view.camera, self.settings)])
        depth_m = np.where(view.valid.numpy(), view.depth.numpy(), np.float32(0))
        T_world_cam = se3.inverse(self.T_grid_world) @ T_grid_cam
        local = carve(DepthView(depth_m, T_world_cam), view.camera, self.T_grid_world, self.settings)
        self._voxels.add(local)
        self._parts[keyframe.frame] = _Part.of(local, T_grid_cam)

    def _place(self, frame: int, T_grid_cam: Array) -> bool:
        """Moves the part of a keyframe to where the keyframe is now. Returns whether it had to."""
        part = self._parts[frame]
        distance_m, angle = _apart(part.placed_at, T_grid_cam)
        if distance_m < SAME_POSE_CELLS * self.settings.resolution_m and angle < SAME_POSE_RAD:
            return False
        new = _Part(part.low, part.shape, part.bits, part.T_grid_cam, T_grid_cam)
        self._voxels.add(new.local(self.settings))  # first: it may be refused, and then nothing has changed
        self._voxels.add(part.local(self.settings), -1)
        self._parts[frame] = new
        return True

    def _is_known(self, frame: int, T_grid_cam: Array) -> bool:
        """Whether enough other keyframes have this view."""
        before = self._skipped.get(frame)
        if before is not None and _apart(before, T_grid_cam)[0] < SAME_VIEW_M:
            return True
        num_alike = 0
        for part in self._parts.values():
            distance_m, angle = _apart(part.placed_at, T_grid_cam)
            num_alike += distance_m / SAME_VIEW_M + angle / SAME_VIEW_RAD < 1
            if num_alike == MIN_HITS:
                self._skipped[frame] = T_grid_cam
                return True
        return False


def _apart(T_a: Array, T_b: Array) -> tuple[float, float]:
    """Returns the distance in metres and the angle in radians between two poses."""
    cosine = (np.einsum('ij,ij->', T_a[:3, :3], T_b[:3, :3]) - 1) / 2
    return float(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3])), float(np.arccos(np.clip(cosine, -1, 1)))
