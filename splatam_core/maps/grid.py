"""A floor plan of a map: an occupancy grid seen from above, for navigation, and its files for ROS' map_server.

Depth images, measured or rendered from the map, are carved into voxels. A voxel that a camera looks through is free, one
that holds the surface it sees is a hit. A cell of the grid is occupied if its column of voxels, between a lowest and a
highest height over the floor, holds a surface; it is free if most of the column was looked through; else it is unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from splatam_core.atomic_io import replace_text, replaced
from splatam_core.device import pose_tensor
from splatam_core.errors import ExportError
from splatam_core.geometry import se3
from splatam_core.geometry.camera import PinholeCamera
from splatam_core.rasterizer import Gaussians, Rasterizer

Array = NDArray[np.float64]

OCCUPIED, FREE, UNKNOWN = 100, 0, -1
"""Values of a cell, as in nav_msgs/OccupancyGrid."""

MAX_VOXELS = 1 << 27
"""Four bytes each. At 5 cm and 18 layers this is a square of 136 m."""

BLOCK_CELLS = 64
"""Memory grows by so many cells at a time, so that it is not copied for each view."""

LAYERS_OF_A_VIEW = 64
"""As many layers as a view takes memory for while it is carved, at least."""

SHADES = {OCCUPIED: 0, FREE: 254, UNKNOWN: 205}
"""Of map_server: a pixel of shade s is occupied with probability (255 - s) / 255."""

MIN_HITS = 2
"""Views that must see a surface in a voxel."""

MIN_HIT_SHARE = 0.1
"""A voxel through which the other views look is noise, unless at least this share of all of them hits it."""

MIN_FREE_SHARE = 0.6
"""Share of a column's voxels that must have been looked through for a free cell."""

MAX_TILT_DEG = 40.0
"""Largest angle between the floor's normal and the mean upward direction of the images."""

HEIGHT_PERCENT = 0.1, 99.9
"""Of the surface that is seen: lower and higher points are errors of depth."""

FLOOR_TRIALS, FLOOR_TOLERANCE_M, MIN_FLOOR_SHARE, MAX_SHARE_BELOW = 60, 0.03, 0.02, 0.02


@dataclass(frozen=True, slots=True)
class GridSettings:
    """What a grid shows.

    Attributes:
        resolution_m: side length of a cell.
        min_height_m: lowest height over the floor at which something is an obstacle.
        max_height_m: highest such height; the robot's height.
        range_m: depth beyond this is ignored.
    """

    resolution_m: float = 0.05
    min_height_m: float = 0.1
    max_height_m: float = 1.0
    range_m: float = 4.0

    @property
    def layers(self) -> int:
        """Number of voxels in a cell's column."""
        return max(1, round((self.max_height_m - self.min_height_m) / self.resolution_m))

    @property
    def layer_m(self) -> float:
        """Height of a voxel."""
        return (self.max_height_m - self.min_height_m) / self.layers


@dataclass(frozen=True, slots=True, eq=False)
class DepthView:
    """A depth image and where it was taken.

    Attributes:
        depth_m: [H, W] along the optical axis; 0 = unknown.
        T_world_cam: [4, 4] pose.
    """

    depth_m: NDArray[np.float32]
    T_world_cam: Array


@dataclass(frozen=True, slots=True, eq=False)
class Volume:
    """Occupancy in three dimensions.

    Attributes:
        voxels: [rows, columns, layers] int8: OCCUPIED, FREE or UNKNOWN.
        resolution_m: side length of a voxel.
        low: column, row and layer of the first voxel, counted from the origin of the grid's axes.
        T_grid_world: see ``Grid``.
    """

    voxels: NDArray[np.int8]
    resolution_m: float
    low: tuple[int, int, int]
    T_grid_world: Array


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """An occupancy grid.

    Attributes:
        cells: [rows, columns] int8: OCCUPIED, FREE or UNKNOWN; the first row has the smallest y.
        resolution_m: side length of a cell.
        origin_m: x and y of the corner of the first cell.
        T_grid_world: [4, 4] the map's world in the grid's axes: x forward at the first view, z up, z = 0 on the floor.
    """

    cells: NDArray[np.int8]
    resolution_m: float
    origin_m: tuple[float, float]
    T_grid_world: Array


def points_of(view: DepthView, camera: PinholeCamera, range_m: float, stride: int = 1) -> Array:
    """Return the surface that a view sees, [N, 3] in the world.

    Args:
        view: the view.
        camera: of its image.
        range_m: depth beyond this is left out.
        stride: take every n-th row and column.
    """
    depth_m = view.depth_m[::stride, ::stride]
    v, u = np.nonzero((depth_m > 0) & (depth_m <= range_m))
    z = depth_m[v, u].astype(np.float64)
    in_camera = np.stack([(stride * u - camera.cx) / camera.fx * z, (stride * v - camera.cy) / camera.fy * z, z], axis=1)
    return in_camera @ view.T_world_cam[:3, :3].T + view.T_world_cam[:3, 3]


def find_floor(views: Sequence[DepthView], camera: PinholeCamera, range_m: float) -> Array:
    """Find the floor: the largest plane that is about level in the images, and below which there is hardly anything.

    Planes through the surface at single pixels (Fischler and Bolles, "Random sample consensus", 1981), each fitted to the points
    near it.

    Args:
        views: the views; their images are about upright on average.
        camera: of the images.
        range_m: depth beyond this is left out.

    Returns:
        T_grid_world [4, 4].

    Raises:
        ExportError: no floor was seen.
    """
    up = -np.mean([view.T_world_cam[:3, 1] for view in views], axis=0) if views else np.zeros(3)
    parts = [_surfels(view, camera, range_m) for view in views]
    points, normals = (np.concatenate([part[index] for part in parts] or [np.zeros((0, 3))]) for index in (0, 1))
    if len(points) < 100 or np.linalg.norm(up) < 0.1:
        raise ExportError('there is no grid: the poses see too little of the map')
    up /= np.linalg.norm(up)
    chosen = np.flatnonzero(normals @ up > np.cos(np.radians(MAX_TILT_DEG)))
    rng = np.random.default_rng(0)
    best, floor = MIN_FLOOR_SHARE * len(points), None
    for index in rng.permutation(chosen)[:FLOOR_TRIALS]:
        plane = _fitted(points, points[index], normals[index])
        if plane is None or plane[1] @ up < np.cos(np.radians(MAX_TILT_DEG)):
            continue
        height = (points - plane[0]) @ plane[1]
        count = float((np.abs(height) < FLOOR_TOLERANCE_M).sum())
        if count > best and (height < -4 * FLOOR_TOLERANCE_M).mean() < MAX_SHARE_BELOW:
            best, floor = count, plane
    if floor is None:
        raise ExportError('there is no grid: no floor was seen, so it is not known where up is')
    return upright(floor[1], floor[0], views[0].T_world_cam)


def _surfels(view: DepthView, camera: PinholeCamera, range_m: float) -> tuple[Array, Array]:
    """Return points [N, 3] in the world and their normals, from pixels a fortieth of the image apart."""
    step = max(1, camera.width // 40)
    depth_m = view.depth_m[::step, ::step].astype(np.float64)
    v, u = np.mgrid[: depth_m.shape[0], : depth_m.shape[1]] * float(step)
    grid = np.stack([(u - camera.cx) / camera.fx * depth_m, (v - camera.cy) / camera.fy * depth_m, depth_m], axis=-1)
    right, down = grid[:-1, 1:] - grid[:-1, :-1], grid[1:, :-1] - grid[:-1, :-1]
    normals = np.cross(down, right)  # towards the camera
    is_known = (depth_m > 0) & (depth_m <= range_m)
    is_known = is_known[:-1, :-1] & is_known[:-1, 1:] & is_known[1:, :-1]
    normals = normals[is_known] / np.maximum(np.linalg.norm(normals[is_known], axis=1, keepdims=True), 1e-12)
    R, eye = view.T_world_cam[:3, :3], view.T_world_cam[:3, 3]
    return grid[:-1, :-1][is_known] @ R.T + eye, normals @ R.T


def _fitted(points: Array, point: Array, normal: Array) -> tuple[Array, Array] | None:
    """Return the plane, a point and its normal, that fits the points near a first guess; None if there are few of them."""
    for tolerance_m in (4 * FLOOR_TOLERANCE_M, 2 * FLOOR_TOLERANCE_M, FLOOR_TOLERANCE_M):
        near = points[np.abs((points - point) @ normal) < tolerance_m]
        if len(near) < 50:
            return None
        point = near.mean(axis=0)
        fitted = np.linalg.eigh(np.cov((near - point).T))[1][:, 0]
        normal = fitted * np.sign(fitted @ normal)
    return point, normal


def upright(up: Array, on_floor: Array, T_world_cam: Array) -> Array:
    """Return T_grid_world [4, 4] for a known floor: z up and 0 on the floor, x where a camera looks, its foot the origin.

    Args:
        up: [3] direction in the world.
        on_floor: [3] a point of the floor.
        T_world_cam: [4, 4] the camera.
    """
    z = up / np.linalg.norm(up)
    forward = T_world_cam[:3, 2] - (T_world_cam[:3, 2] @ z) * z
    if np.linalg.norm(forward) < 0.1:  # it looks straight down or up: the image's upward direction is forward
        forward = -T_world_cam[:3, 1] + (T_world_cam[:3, 1] @ z) * z
    x = forward / np.linalg.norm(forward)
    T_grid_world = np.eye(4)
    T_grid_world[:3, :3] = np.stack([x, np.cross(z, x), z])
    eye = T_world_cam[:3, 3]
    T_grid_world[:3, 3] = -T_grid_world[:3, :3] @ (eye - ((eye - on_floor) @ z) * z)
    return T_grid_world


def rendered_views(
    gaussians: Gaussians, rasterizer: Rasterizer, camera: PinholeCamera, poses: Array, progress: Callable[[range], Iterable[int]]
) -> list[DepthView]:
    """Render the depth of a map along a path.

    Args:
        gaussians: the map, on the rasterizer's device.
        rasterizer: renders the map.
        camera: the camera to render with.
        poses: [N, 4, 4] T_world_cam.
        progress: wraps the loop over the poses, to display progress.
    """
    views, map_only = [], gaussians.detached()
    for index in progress(range(len(poses))):
        with torch.no_grad():
            pose = pose_tensor(se3.inverse(poses[index]), map_only.means.device)
            views.append(DepthView(rasterizer.render(map_only, camera, pose).depth().numpy(force=True), poses[index]))
    return views


@dataclass(frozen=True, slots=True, eq=False)
class LocalGrid:
    """What one view says about the voxels in front of it. Voxels lie on the lattice of whole cells of the grid's axes.

    Attributes:
        low: column and row of the first cell.
        hits: [rows, columns, layers] whether the view sees a surface in the voxel.
        passes: [rows, columns, layers] whether it looks through the voxel.
    """

    low: tuple[int, int]
    hits: NDArray[np.bool_]
    passes: NDArray[np.bool_]


Window = tuple[NDArray[np.int64], NDArray[np.int64]]
"""Column and row of the first cell, and one past the last."""


def grid_of(views: Sequence[DepthView], camera: PinholeCamera, T_grid_world: Array, settings: GridSettings) -> Grid:
    """Make an occupancy grid of depth images.

    Args:
        views: the views.
        camera: of the images.
        T_grid_world: [4, 4] of ``find_floor`` or ``upright``.
        settings: what the grid shows.

    Raises:
        ExportError: nothing is in range, or the grid would be too large.
    """
    return _voxels_of(views, camera, T_grid_world, settings).grid(T_grid_world)


def volume_of(
    views: Sequence[DepthView], camera: PinholeCamera, T_grid_world: Array, resolution_m: float, range_m: float
) -> Volume:
    """Make an occupancy volume of depth images, from the lowest to the highest surface that they see.

    Args:
        views: the views.
        camera: of the images.
        T_grid_world: [4, 4] of ``find_floor`` or ``upright``.
        resolution_m: side length of a voxel.
        range_m: depth beyond this is ignored.

    Raises:
        ExportError: nothing is in range, or the volume would be too large.
    """
    parts = [points_of(view, camera, range_m, stride=4) @ T_grid_world[2, :3] + T_grid_world[2, 3] for view in views]
    heights_m = np.concatenate(parts or [np.zeros(0)])
    if not len(heights_m):
        raise ExportError('there is no volume: nothing is within range')
    lowest, highest = np.floor(np.percentile(heights_m, HEIGHT_PERCENT) / resolution_m).astype(int)
    settings = GridSettings(resolution_m, lowest * resolution_m, (highest + 1) * resolution_m, range_m)
    return _voxels_of(views, camera, T_grid_world, settings).volume(T_grid_world)


def _voxels_of(views: Sequence[DepthView], camera: PinholeCamera, T_grid_world: Array, settings: GridSettings) -> Voxels:
    if not len(views):
        raise ExportError('there is no grid: no pose to look from')
    voxels = Voxels(settings)
    voxels.reserve([window_of(T_grid_world @ view.T_world_cam, camera, settings) for view in views])
    for view in views:
        voxels.add(carve(view, camera, T_grid_world, settings))
    return voxels


def window_of(T_grid_cam: Array, camera: PinholeCamera, settings: GridSettings) -> Window:
    """Return the cells that a camera [4, 4] may see within range: those of the box around its view."""
    u, v = (np.array([0, size - 1, 0, size - 1]) for size in (camera.width, camera.height))
    v = v[[0, 0, 1, 1]]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(4)], axis=1)
    corners = settings.range_m * rays @ T_grid_cam[:3, :3].T + T_grid_cam[:3, 3]
    seen = np.vstack([corners, T_grid_cam[:3, 3]])[:, :2] / settings.resolution_m
    return np.floor(seen.min(axis=0)).astype(np.int64), np.floor(seen.max(axis=0)).astype(np.int64) + 1


def carve(view: DepthView, camera: PinholeCamera, T_grid_world: Array, settings: GridSettings) -> LocalGrid:
    """Return what a view says about the voxels in front of it.

    Raises:
        ExportError: there are too many.
    """
    T_grid_cam = T_grid_world @ view.T_world_cam
    low, high = window_of(T_grid_cam, camera, settings)
    columns, rows = (int(size) for size in high - low)
    _check_size(columns, rows, max(settings.layers, LAYERS_OF_A_VIEW))
    shape = (rows, columns, settings.layers)
    world = points_of(view, camera, settings.range_m)
    points = world @ T_grid_world[:3, :3].T + T_grid_world[:3, 3]
    column, row = (np.floor(points[:, axis] / settings.resolution_m).astype(np.int64) - low[axis] for axis in (0, 1))
    layer = np.floor((points[:, 2] - settings.min_height_m) / settings.layer_m).astype(np.int64)
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns) & (layer >= 0) & (layer < settings.layers)
    hits = np.zeros(shape, bool)
    hits[row[inside], column[inside], layer[inside]] = True
    passes = np.zeros(shape, bool)
    T_cam_grid = se3.inverse(T_grid_cam)
    x, y = (settings.resolution_m * (low[axis] + np.arange(count) + 0.5) for axis, count in ((0, columns), (1, rows)))
    for layer_index in range(settings.layers):
        z = settings.min_height_m + (layer_index + 0.5) * settings.layer_m
        passes[:, :, layer_index] = _looks_through(view, camera, T_cam_grid, (x, y, z), settings)
    return LocalGrid((int(low[0]), int(low[1])), hits, passes)


def _looks_through(
    view: DepthView, camera: PinholeCamera, T_cam_grid: Array, centres: tuple[Array, Array, float], settings: GridSettings
) -> NDArray[np.bool_]:
    """Return [rows, columns] whether a view sees something behind the voxels of a layer with these centres."""
    x, y, z = centres
    base = T_cam_grid[:3, 3] + T_cam_grid[:3, 2] * z
    in_camera = base + T_cam_grid[:3, 0] * x[None, :, None] + T_cam_grid[:3, 1] * y[:, None, None]
    depth = in_camera[..., 2]
    with np.errstate(divide='ignore', invalid='ignore'):
        u = np.rint(in_camera[..., 0] / depth * camera.fx + camera.cx)
        v = np.rint(in_camera[..., 1] / depth * camera.fy + camera.cy)
    visible = (depth > 0.1) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    measured = np.zeros_like(depth)
    measured[visible] = view.depth_m[v[visible].astype(int), u[visible].astype(int)]
    return visible & (depth <= settings.range_m) & (measured > depth + settings.resolution_m)


def _check_size(columns: int, rows: int, layers: int) -> None:
    """Checks that so many voxels fit into memory.

    Raises:
        ExportError: they do not.
    """
    if columns * rows * layers > MAX_VOXELS:
        raise ExportError(
            f'a grid of {columns}x{rows} cells with {layers} layers is too large: choose a larger resolution or a smaller range'
        )


class Voxels:
    """Counts, for each voxel above the floor, the views that hit a surface in it and those that look through it."""

    def __init__(self, settings: GridSettings) -> None:
        self._settings = settings
        self._low = np.zeros(2, np.int64)
        self._hits = np.zeros((0, 0, settings.layers), np.uint16)
        self._passes = np.zeros_like(self._hits)
        self._cells = np.zeros((0, 0), np.int8)
        self._stale: Window | None = None  # cells whose counts have changed since they were computed

    def check_room(self, windows: Sequence[Window]) -> Window:
        """Return the cells that would be held with those of some windows.

        Raises:
            ExportError: there would be too many.
        """
        held = [(self._low, self._low + np.array(self._cells.shape[::-1]))] if self._cells.size else []
        low, high = _around([*held, *windows])
        low, high = low // BLOCK_CELLS * BLOCK_CELLS, -(-high // BLOCK_CELLS) * BLOCK_CELLS
        columns, rows = (int(size) for size in high - low)
        _check_size(columns, rows, self._settings.layers)
        return low, high

    def reserve(self, windows: Sequence[Window]) -> None:
        """Make room for the cells of some windows.

        Raises:
            ExportError: there would be too many.
        """
        low, high = self.check_room(windows)
        new_columns, new_rows = (int(size) for size in high - low)
        rows, columns = self._cells.shape
        if (new_rows, new_columns) == (rows, columns):
            return
        before, offset, self._low = (self._hits, self._passes, self._cells), self._low - low, low
        shape = new_rows, new_columns, self._settings.layers
        self._hits, self._passes = np.zeros(shape, np.uint16), np.zeros(shape, np.uint16)
        self._cells = np.full(shape[:2], UNKNOWN, np.int8)
        if rows:
            place = slice(offset[1], offset[1] + rows), slice(offset[0], offset[0] + columns)
            self._hits[place], self._passes[place], self._cells[place] = before

    def add(self, local: LocalGrid, sign: int = 1) -> None:
        """Count what a view says; with sign -1, take it back."""
        rows, columns = local.hits.shape[:2]
        if not rows or not columns:
            return
        low = np.array(local.low)
        window = low, low + np.array([columns, rows])
        self.reserve([window])
        place = self._place(window)
        for counts, seen in ((self._hits, local.hits), (self._passes, local.passes)):
            if sign > 0:
                counts[place] += seen
            else:
                counts[place] -= seen
        self._stale = window if self._stale is None else _around([self._stale, window])

    def grid(self, T_grid_world: Array) -> Grid:
        """Return the cells, without unknown margins.

        Raises:
            ExportError: every cell is unknown.
        """
        if self._stale is not None:
            place, self._stale = self._place(self._stale), None
            self._cells[place] = _cells(self._hits[place], self._passes[place])
        cell = self._settings.resolution_m
        origin_m = float(cell * self._low[0]), float(cell * self._low[1])
        return _trimmed(Grid(self._cells, cell, origin_m, T_grid_world))

    def volume(self, T_grid_world: Array) -> Volume:
        """Return the voxels themselves.

        Raises:
            ExportError: every voxel is unknown.
        """
        is_surface, was_through = _seen(self._hits, self._passes)
        if not (is_surface.any() or was_through.any()):
            raise ExportError('there is no volume: nothing is within range')
        voxels = np.where(is_surface, OCCUPIED, np.where(was_through, FREE, UNKNOWN)).astype(np.int8)
        layer = round(self._settings.min_height_m / self._settings.layer_m)
        low = int(self._low[0]), int(self._low[1]), layer
        return Volume(voxels, self._settings.resolution_m, low, T_grid_world)

    def _place(self, window: Window) -> tuple[slice, slice]:
        """Returns the rows and columns of a window."""
        (column, row), (end_column, end_row) = window[0] - self._low, window[1] - self._low
        return slice(row, end_row), slice(column, end_column)


def _around(windows: Sequence[Window]) -> Window:
    """Return the smallest window that holds some others."""
    return np.min([low for low, _ in windows], axis=0), np.max([high for _, high in windows], axis=0)


def _cells(hits: NDArray[np.uint16], passes: NDArray[np.uint16]) -> NDArray[np.int8]:
    """Return the cells [rows, columns] of counts [rows, columns, layers]."""
    is_surface, was_through = _seen(hits, passes)
    is_free = was_through.mean(axis=2) >= MIN_FREE_SHARE
    return np.where(is_surface.any(axis=2), OCCUPIED, np.where(is_free, FREE, UNKNOWN)).astype(np.int8)


def _seen(hits: NDArray[np.uint16], passes: NDArray[np.uint16]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return whether voxels hold a surface, and whether they do not and were looked through."""
    is_surface = (hits >= MIN_HITS) & (hits >= np.float32(MIN_HIT_SHARE) * (hits.astype(np.float32) + passes))
    return is_surface, (passes > 0) & ~is_surface


def _trimmed(grid: Grid) -> Grid:
    """Return the grid without its unknown margins.

    Raises:
        ExportError: every cell is unknown.
    """
    known = grid.cells != UNKNOWN
    if not known.any():
        raise ExportError('there is no grid: nothing is within range at these heights over the floor')
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    x, y = (origin + first * grid.resolution_m for origin, first in zip(grid.origin_m, (columns[0], rows[0])))
    cells = grid.cells[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return Grid(np.ascontiguousarray(cells), grid.resolution_m, (float(x), float(y)), grid.T_grid_world)


def write_map_server(path: Path, grid: Grid) -> Path:
    """Write a grid as map_server's pair of files. Existing files are replaced only when the new ones are complete.

    Args:
        path: the ``.yaml`` file; the picture is beside it.
        grid: the grid.

    Returns:
        The picture's path.
    """
    shades = np.zeros(grid.cells.shape, np.uint8)
    for value, shade in SHADES.items():
        shades[grid.cells == value] = shade
    rows, columns = grid.cells.shape
    picture = path.with_suffix('.pgm')
    with replaced(picture) as temporary, temporary.open('wb') as file:
        file.write(f'P5\n# {grid.resolution_m} m/pix\n{columns} {rows}\n255\n'.encode('ascii'))
        file.write(shades[::-1].tobytes())  # the first row of a picture has the largest y
    matrix = '\n'.join('#   ' + ' '.join(f'{value:9.6f}' for value in row) for row in grid.T_grid_world)
    replace_text(
        path,
        '# Axes: x forward at the first view, z up, z = 0 on the floor.\n'
        f'# The world of map.ply in these axes, T_grid_world:\n{matrix}\n'
        f'image: {picture.name}\nmode: trinary\nresolution: {grid.resolution_m}\n'
        f'origin: [{grid.origin_m[0]:.6f}, {grid.origin_m[1]:.6f}, 0.0]\n'
        'negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n',
    )
    return picture
