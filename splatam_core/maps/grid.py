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

MAX_VOXELS = 1 << 28
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


def grid_of(views: Iterable[DepthView], camera: PinholeCamera, T_grid_world: Array, settings: GridSettings) -> Grid:
    """Make an occupancy grid of depth images.

    Args:
        views: the views.
        camera: of the images.
        T_grid_world: [4, 4] of ``find_floor`` or ``upright``.
        settings: what the grid shows.

    Raises:
        ExportError: nothing is in range, or the grid would be too large.
    """
    seen = [(view, T_grid_world @ view.T_world_cam) for view in views]
    eyes = np.array([T_grid_cam[:2, 3] for _, T_grid_cam in seen]).reshape(-1, 2)
    if not len(eyes):
        raise ExportError('there is no grid: no pose to look from')
    cell, band = settings.resolution_m, settings.max_height_m - settings.min_height_m
    low = np.floor((eyes.min(axis=0) - settings.range_m) / cell) * cell
    columns, rows = (int(n) for n in np.ceil((eyes.max(axis=0) + settings.range_m - low) / cell))
    layers = max(1, round(band / cell))
    if columns * rows * layers > MAX_VOXELS:
        raise ExportError(f'a grid of {columns}x{rows} cells with {layers} layers is too large: choose a larger --resolution')
    voxels = _Voxels(low, cell, settings, (rows, columns, layers))
    for view, T_grid_cam in seen:
        voxels.add(view, T_grid_cam, camera, T_grid_world)
    return _trimmed(Grid(voxels.cells(), cell, (float(low[0]), float(low[1])), T_grid_world))


class _Voxels:
    """Counts, for each voxel above the grid, the views that hit a surface in it and those that look through it."""

    def __init__(self, low: Array, cell: float, settings: GridSettings, shape: tuple[int, int, int]) -> None:
        self._low, self._cell, self._settings = low, cell, settings
        self._height = (settings.max_height_m - settings.min_height_m) / shape[2]
        self._hits, self._passes = np.zeros(shape, np.uint16), np.zeros(shape, np.uint16)
        self._floor = np.zeros(shape[:2], np.uint16)

    def add(self, view: DepthView, T_grid_cam: Array, camera: PinholeCamera, T_grid_world: Array) -> None:
        """Count a view."""
        world = points_of(view, camera, self._settings.range_m)
        points = world @ T_grid_world[:3, :3].T + T_grid_world[:3, 3]
        column, row = (np.floor((points[:, axis] - self._low[axis]) / self._cell).astype(int) for axis in (0, 1))
        layer = np.floor((points[:, 2] - self._settings.min_height_m) / self._height).astype(int)
        rows, columns, layers = self._hits.shape
        inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
        surface = inside & (layer >= 0) & (layer < layers)
        _count(self._hits, (row[surface], column[surface], layer[surface]))
        floor = inside & (layer < 0)
        _count(self._floor, (row[floor], column[floor]))
        self._carve(view, T_grid_cam, camera)

    def _carve(self, view: DepthView, T_grid_cam: Array, camera: PinholeCamera) -> None:
        """Count the voxels in front of the surface that the view sees."""
        T_cam_grid = se3.inverse(T_grid_cam)
        reach = int(np.ceil(self._settings.range_m / self._cell))
        middle = np.floor((T_grid_cam[:2, 3] - self._low) / self._cell).astype(int)
        rows, columns, layers = self._hits.shape
        y = np.arange(max(middle[1] - reach, 0), min(middle[1] + reach, rows))
        x = np.arange(max(middle[0] - reach, 0), min(middle[0] + reach, columns))
        centres_x, centres_y = (self._low[axis] + (index + 0.5) * self._cell for axis, index in ((0, x), (1, y)))
        for layer in range(layers):
            z = self._settings.min_height_m + (layer + 0.5) * self._height
            corner = T_cam_grid[:3, 3] + T_cam_grid[:3, 2] * z
            plane = corner + T_cam_grid[:3, 0] * centres_x[None, :, None] + T_cam_grid[:3, 1] * centres_y[:, None, None]
            depth = plane[..., 2]
            with np.errstate(divide='ignore', invalid='ignore'):
                u = np.rint(plane[..., 0] / depth * camera.fx + camera.cx)
                v = np.rint(plane[..., 1] / depth * camera.fy + camera.cy)
            visible = (depth > 0.1) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
            measured = np.zeros_like(depth)
            measured[visible] = view.depth_m[v[visible].astype(int), u[visible].astype(int)]
            through = visible & (depth <= self._settings.range_m) & (measured > depth + self._cell)
            self._passes[y[0] : y[-1] + 1, x[0] : x[-1] + 1, layer] += through

    def cells(self) -> NDArray[np.int8]:
        """Returns the cells [rows, columns]."""
        hits, passes = self._hits.astype(np.float32), self._passes.astype(np.float32)
        is_surface = (self._hits >= MIN_HITS) & (hits >= MIN_HIT_SHARE * (hits + passes))
        was_through = (self._passes > 0) & ~is_surface
        is_free = was_through.mean(axis=2) >= MIN_FREE_SHARE
        cells = np.where(is_free, FREE, UNKNOWN)
        return np.where(is_surface.any(axis=2), OCCUPIED, cells).astype(np.int8)


def _count(counts: NDArray[np.uint16], places: tuple[NDArray[np.int64], ...]) -> None:
    """Adds 1 to each place that a view names, however often it does."""
    counts.reshape(-1)[np.unique(np.ravel_multi_index(places, counts.shape))] += 1


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
