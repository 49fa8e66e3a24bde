"""What a view of the map is on the device: splats, and for each tile the list of those that touch it, nearest first."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
from torch import Tensor

from splatam_core.errors import RasterizerError
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.rasterizer.base import Gaussians
from splatam_core.rasterizer.triton import kernels

BLOCK = 1024 if kernels.INTERPRETED else 256  # Gaussians a program
MAX_TILES = 4095  # on a side: 12 bits hold them
_MAX_SHORT = 2**15 - 1


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What a forward pass leaves for its backward pass. All of it on the device.

    Attributes:
        camera: the image's.
        pose: [4, 4] world to camera, float32.
        splats: [N, 8] u, v, falloff, opacity, r, g, b, z.
        counts: [N] int32, tiles that each Gaussian touches.
        starts: [N] int64, where its entries start before they are sorted by tile.
        order: [N] int64, Gaussians by depth.
        entries: [capacity] int32, Gaussians tile by tile, front to back.
        slots: [capacity] int64, where each entry was before they were sorted by tile.
        begins: [tiles + 1] int32, where each tile's entries begin.
        total: [1] int64, how many entries there should be.
        tile: pixels on a side of a tile.
        tiles_x: tiles in a row.
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
        """Entries there is room for."""
        return len(self.entries)

    @property
    def num_tiles(self) -> int:
        """Tiles of the image."""
        return len(self.begins) - 1


class Capacity:
    """How much room tile lists get, without waiting for the device on every view.

    The number of entries is read back one view late, while the device works on; room is kept for two fifths more than the most
    seen lately. The first view, and one of many more Gaussians or pixels than before, waits for its number. A view that needs
    more than it got is drawn all the same, slowly: its tiles walk the whole depth order.
    """

    def __init__(self) -> None:
        self._room = 0
        self._most = 0.0  # entries lately
        self._measured = (0, 0)  # Gaussians and tiles of the last view that was waited for
        self._reading: tuple[Tensor, torch.cuda.Event | None] | None = None

    def of(self, total: Tensor, num_gaussians: int, num_tiles: int) -> int:
        """Entries to make room for.

        Args:
            total: [1] int64 entries of this view, on the device.
            num_gaussians: to draw.
            num_tiles: of the image.
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
        return self._room

    def _read(self) -> int | None:
        """The entries of the view that is being read back, once the number has arrived."""
        if self._reading is None:
            return None
        total, arrival = self._reading
        if arrival is not None and not arrival.query():
            return None
        self._reading = None
        return int(total)

    def _take(self, entries: int) -> None:
        self._most = max(float(entries), 0.99 * self._most)
        if not 1.1 * self._most < self._room < 3 * self._most:
            self._room = max(1024, round(1.4 * self._most))


def _read_back(total: Tensor) -> tuple[Tensor, torch.cuda.Event | None]:
    if not total.is_cuda:
        return total.clone(), None
    host = torch.empty(1, dtype=torch.int64, pin_memory=True)
    host.copy_(total, non_blocking=True)
    event = torch.cuda.Event()
    event.record()
    return host, event


class Lister:
    """Makes views. The memory comes from torch's caching allocator, which hands the same blocks out again and again."""

    def __init__(self, tile: int, capacity: Capacity) -> None:
        self._tile = tile
        self._capacity = capacity
        self._tile_ids: Tensor | None = None  # 0 to the number of tiles

    def view(self, gaussians: Gaussians, camera: PinholeCamera, pose: Tensor) -> View:
        """Project, sort by depth, list per tile: stable sorts, so that equal depths keep the order of the map.

        Depths of N Gaussians and tile numbers of 16 bits make shorter keys than both together for each entry.

        Args:
            gaussians: isotropic, contiguous.
            camera: the image to draw.
            pose: [4, 4] world to camera, contiguous, on the same device.

        Raises:
            RasterizerError: the image is too large.
        """
        tiles_x, tiles_y = (-(-size // self._tile) for size in (camera.width, camera.height))
        if max(tiles_x, tiles_y) > MAX_TILES:
            raise RasterizerError(
                f'a {camera.width}x{camera.height} image is too large; the triton rasterizer draws up to '
                f'{MAX_TILES * self._tile} pixels on a side'
            )
        splats, depths, rects, counts = _projected(gaussians, camera, pose, self._tile)
        order = torch.sort(depths, stable=True).indices
        ends = torch.cumsum(counts[order], dim=0, dtype=torch.int64)
        # A copy, since where a slice ends up in memory may vary, and kernels are compiled anew for other alignments.
        total = ends[-1:].clone() if len(order) else ends.new_zeros(1)
        capacity = self._capacity.of(total, len(order), tiles_x * tiles_y)
        starts, tiles, ids = _listed(order, ends, counts, rects, capacity, tiles_x, tiles_x * tiles_y)
        tiles, slots = torch.sort(tiles, stable=True)
        begins = torch.searchsorted(tiles, self._all_tiles(tiles, tiles_x * tiles_y), out_int32=True)
        return View(camera, pose, splats, counts, starts, order, ids[slots], slots, begins, total, self._tile, tiles_x)

    def _all_tiles(self, like: Tensor, num_tiles: int) -> Tensor:
        """[tiles + 1], made once."""
        made = self._tile_ids
        if made is None or len(made) != num_tiles + 1 or made.device != like.device:
            self._tile_ids = made = torch.arange(num_tiles + 1, dtype=like.dtype, device=like.device)
        return made


def _projected(gaussians: Gaussians, camera: PinholeCamera, pose: Tensor, tile: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Splats [N, 8], depths [N], rects [N, 2], counts [N]."""
    n, means = len(gaussians), gaussians.means
    splats, depths = means.new_empty(n, 8), means.new_empty(n)
    rects, counts = means.new_empty(n, 2, dtype=torch.int32), means.new_empty(n, dtype=torch.int32)
    kernels.launch(
        kernels.project, triton.cdiv(n, BLOCK),
        means, gaussians.log_scales, gaussians.logit_opacities, gaussians.rgb, pose, splats, depths, rects, counts,
        n, camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, TILE=tile, BLOCK=BLOCK, warps=4,
    )  # fmt: skip
    return splats, depths, rects, counts


def _listed(
    order: Tensor, ends: Tensor, counts: Tensor, rects: Tensor, capacity: int, tiles_x: int, num_tiles: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Starts [N]; tile and Gaussian of each entry [capacity], nearest first, the tile past the last where there is none."""
    dtype = torch.int16 if num_tiles <= _MAX_SHORT else torch.int32
    tiles = torch.full((capacity,), num_tiles, dtype=dtype, device=order.device)
    ids, starts = torch.empty(capacity, dtype=torch.int32, device=order.device), torch.empty_like(order)
    kernels.launch(
        kernels.list_tiles, triton.cdiv(len(order), BLOCK),
        order, ends, counts, rects, starts, tiles, ids, len(order), capacity, tiles_x, BLOCK=BLOCK, warps=4,
    )  # fmt: skip
    return starts, tiles, ids
