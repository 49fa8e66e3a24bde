"""A view of the map on the device: splats, and for each tile the list of those that touch it, nearest first."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
from torch import Tensor

from splatam_core.errors import RasterizerError
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.rasterizer.base import Gaussians
from splatam_core.rasterizer.triton import kernels

BLOCK = 1024 if kernels.INTERPRETED else 256  # Gaussians per program
MAX_TILES = 4095  # on a side: 12 bits hold them
MAX_ENTRIES = 2**26
"""Pairs of a Gaussian and a tile in a view, as for the native rasterizer; their lists and gradients take 4 GB."""
_MAX_SHORT = 2**15 - 1


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What a forward pass stores for its backward pass, all of it on the device.

    Attributes:
        camera: the image to draw.
        pose: [4, 4] world to camera, float32.
        splats: [N, 8] u, v, falloff, opacity, r, g, b, z.
        counts: [N] int32, number of tiles that each Gaussian touches.
        starts: [N] int64, index of its first entry before the entries are sorted by tile.
        order: [N] int64, Gaussians sorted by depth.
        entries: [capacity] int32, Gaussians tile by tile, front to back.
        slots: [capacity] int64, index of each entry before the entries were sorted by tile.
        begins: [tiles + 1] int32, index of each tile's first entry.
        total: [1] int64, number of entries that the view needs; may exceed the capacity.
        tile: side of a tile in pixels.
        tiles_x: tiles per row.
    """

    camera: PinholeCamera
    pose: Tensor
    splats: Tensor
    counts: Tensor
    starts: Tensor
    order: Tensor
    entries: Tensor
    slots: Tensor
    begins: Tensor
    total: Tensor
    tile: int
    tiles_x: int

    @property
    def capacity(self) -> int:
        """Number of entries that can be stored."""
        return len(self.entries)

    @property
    def num_tiles(self) -> int:
        """Number of tiles of the image."""
        return len(self.begins) - 1


class Capacity:
    """Chooses the capacity of tile lists, without waiting for the device on every view.

    The number of entries is read back one view late, while the device works on. The capacity is 1.4 times the recent maximum.
    The host waits for the number of the first view, and of a view with many more Gaussians or pixels than before. A view that
    needs more than the capacity is still drawn correctly, but slowly: its tiles visit all Gaussians in depth order. After a
    view of more than ``MAX_ENTRIES``, the next one is refused.
    """

    def __init__(self) -> None:
        self._capacity_now = 0
        self._recent_maximum = 0.0  # entries
        self._measured = (0, 0)  # Gaussians and tiles of the last view that the host waited for
        self._reading: tuple[Tensor, torch.cuda.Event | None] | None = None

    def of(self, total: Tensor, num_gaussians: int, num_tiles: int) -> int:
        """Returns the capacity for a view, in entries.

        Args:
            total: [1] int64, entries of this view, on the device.
            num_gaussians: Gaussians to draw.
            num_tiles: tiles of the image.

        Raises:
            RasterizerError: the view, or the one before, has too many entries.
        """
        known_gaussians, known_tiles = self._measured
        if num_gaussians > 1.25 * known_gaussians or num_tiles > known_tiles:
            self._measured = max(num_gaussians, known_gaussians), max(num_tiles, known_tiles)
            self._reading = None
            self._take(int(total))
        elif (entries := self._read()) is not None:
            self._take(entries)
        if self._reading is None:
            self._reading = _read_back(total)
        return self._capacity_now

    def _read(self) -> int | None:
        """Returns the number of entries that is being read back, once it has arrived."""
        if self._reading is None:
            return None
        total, arrival = self._reading
        if arrival is not None and not arrival.query():
            return None
        self._reading = None
        return int(total)

    def _take(self, entries: int) -> None:
        if entries > MAX_ENTRIES:
            self._measured, self._reading = (0, 0), None  # the next view is measured before it is drawn
            raise RasterizerError(
                f'the Gaussians cover {entries} tiles of the image, and at most {MAX_ENTRIES} can be drawn: draw smaller images, '
                'or a map of smaller Gaussians'
            )
        self._recent_maximum = max(float(entries), 0.99 * self._recent_maximum)
        if not 1.1 * self._recent_maximum < self._capacity_now < 3 * self._recent_maximum:
            self._capacity_now = max(1024, round(1.4 * self._recent_maximum))


def _read_back(total: Tensor) -> tuple[Tensor, torch.cuda.Event | None]:
    if not total.is_cuda:
        return total.clone(), None
    host = torch.empty(1, dtype=torch.int64, pin_memory=True)
    host.copy_(total, non_blocking=True)
    event = torch.cuda.Event()
    event.record()
    return host, event


class Lister:
    """Makes views. Memory comes from torch's caching allocator, which reuses the same blocks."""

    def __init__(self, tile: int, capacity: Capacity) -> None:
        self._tile = tile
        self._capacity = capacity
        self._tile_ids: Tensor | None = None  # 0 to the number of tiles

    def view(self, gaussians: Gaussians, camera: PinholeCamera, pose: Tensor) -> View:
        """Projects, sorts by depth and lists per tile. The sorts are stable: Gaussians of equal depth keep the order of the map.

        Sorting N depths and then the entries by 16-bit tile numbers takes shorter keys than sorting the entries by both.

        Args:
            gaussians: isotropic, contiguous.
            camera: the image to draw.
            pose: [4, 4] world to camera, contiguous, on the same device.

        Raises:
            RasterizerError: the image is too large, or too many Gaussians cover too much of it.
        """
        tiles_x, tiles_y = (-(-size // self._tile) for size in (camera.width, camera.height))
        if max(tiles_x, tiles_y) > MAX_TILES:
            raise RasterizerError(
                f'a {camera.width}x{camera.height} image is too large; the triton rasterizer draws up to '
                f'{MAX_TILES * self._tile} pixels on a side'
            )
        projected = _project(gaussians, camera, pose, self._tile)
        order = torch.sort(projected.depths, stable=True).indices
        ends = torch.cumsum(projected.counts[order], dim=0, dtype=torch.int64)
        # A copy: the memory alignment of a slice varies, and kernels are compiled again for other alignments.
        total = ends[-1:].clone() if len(order) else ends.new_zeros(1)
        capacity = self._capacity.of(total, len(order), tiles_x * tiles_y)
        entries = _list_tiles(projected, order, ends, capacity, (tiles_x, tiles_y))
        tiles, slots = torch.sort(entries.tiles, stable=True)
        begins = torch.searchsorted(tiles, self._all_tiles(tiles, tiles_x * tiles_y), out_int32=True)
        return View(
            camera=camera, pose=pose, splats=projected.splats, counts=projected.counts, starts=entries.starts, order=order,
            entries=entries.ids[slots], slots=slots, begins=begins, total=total, tile=self._tile, tiles_x=tiles_x,
        )  # fmt: skip

    def _all_tiles(self, like: Tensor, num_tiles: int) -> Tensor:
        """Returns [tiles + 1] consecutive numbers, cached."""
        cached = self._tile_ids
        if cached is None or len(cached) != num_tiles + 1 or cached.device != like.device:
            self._tile_ids = cached = torch.arange(num_tiles + 1, dtype=like.dtype, device=like.device)
        return cached


@dataclass(frozen=True, slots=True, eq=False)
class _Projected:
    """Gaussians on the image; see ``kernels.project``.

    Attributes:
        splats: [N, 8] float32.
        depths: [N] float32.
        rects: [N, 2] int32.
        counts: [N] int32.
    """

    splats: Tensor
    depths: Tensor
    rects: Tensor
    counts: Tensor


@dataclass(frozen=True, slots=True, eq=False)
class _Entries:
    """Pairs of a tile and a Gaussian that touches it, nearest Gaussian first.

    Attributes:
        starts: [N] int64, index of each Gaussian's first entry.
        tiles: [capacity]; the number of tiles where there is no entry.
        ids: [capacity] int32.
    """

    starts: Tensor
    tiles: Tensor
    ids: Tensor


def _project(gaussians: Gaussians, camera: PinholeCamera, pose: Tensor, tile: int) -> _Projected:
    n, means = len(gaussians), gaussians.means
    result = _Projected(
        splats=means.new_empty(n, 8),
        depths=means.new_empty(n),
        rects=means.new_empty(n, 2, dtype=torch.int32),
        counts=means.new_empty(n, dtype=torch.int32),
    )
    kernels.launch(
        kernels.project, triton.cdiv(n, BLOCK), warps=4,
        means=means, log_scales=gaussians.log_scales, logit_opacities=gaussians.logit_opacities, rgb=gaussians.rgb, pose=pose,
        splats=result.splats, depths=result.depths, rects=result.rects, counts=result.counts, n=n,
        width=camera.width, height=camera.height, fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy,
        TILE=tile, BLOCK=BLOCK,
    )  # fmt: skip
    return result


def _list_tiles(projected: _Projected, order: Tensor, ends: Tensor, capacity: int, tiles: tuple[int, int]) -> _Entries:
    """Lists the tiles of each Gaussian. tiles: columns and rows of tiles; ends: [N] index behind the last entry, by depth."""
    num_tiles = tiles[0] * tiles[1]
    dtype = torch.int16 if num_tiles <= _MAX_SHORT else torch.int32
    result = _Entries(
        starts=torch.empty_like(order),
        tiles=torch.full((capacity,), num_tiles, dtype=dtype, device=order.device),
        ids=torch.empty(capacity, dtype=torch.int32, device=order.device),
    )
    kernels.launch(
        kernels.list_tiles, triton.cdiv(len(order), BLOCK), warps=4,
        order=order, ends=ends, counts=projected.counts, rects=projected.rects, starts=result.starts, tiles=result.tiles,
        ids=result.ids, n=len(order), capacity=capacity, tiles_x=tiles[0], BLOCK=BLOCK,
    )  # fmt: skip
    return result
