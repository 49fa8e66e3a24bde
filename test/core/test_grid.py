"""The floor plan of the synthetic room against its true one, its files by map_server's rules, and maps without a floor."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml
from numpy.typing import NDArray

from splatam_core.datasets.room import ROOM_SIZE_M, build_room, furniture
from splatam_core.datasets.synthetic import CAMERA, SyntheticSequence, measured
from splatam_core.errors import ExportError
from splatam_core.geometry import se3
from splatam_core.images.view import View
from splatam_core.mapping.posed import PosedView
from splatam_core.maps.grid import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    DepthView,
    Grid,
    GridSettings,
    LocalGrid,
    Volume,
    Voxels,
    find_floor,
    grid_of,
    points_of,
    rendered_views,
    upright,
    volume_of,
    write_map_server,
)  # fmt: skip
from splatam_core.maps.keyframe_grid import KeyframeGrid
from splatam_core.maps.octomap import write_octomap
from splatam_core.rasterizer import Gaussians, make_rasterizer

WIDTH, VIEWS, STEP = 160, 30, 4  # a full turn
CAM = CAMERA.resized(WIDTH, WIDTH * 3 // 4)
SETTINGS = GridSettings()
TOLERANCE_M = 0.02
"""The error of measured depth at 3 m: a cell whose edge is this near to a surface may be either."""


@dataclass(frozen=True, eq=False)
class Look:
    """What a camera saw of the room.

    Attributes:
        views: noisy depth; the world is the first camera's.
        T_room_world: [4, 4] that world in the room's axes.
    """

    views: list[DepthView]
    T_room_world: NDArray[np.float64]


@lru_cache(maxsize=2)
def look_around(tilt_deg: float) -> Look:
    """Turn around in the room with a camera that is tilted downwards."""
    path = SyntheticSequence(motion='fast', width=WIDTH).ground_truth().T_world_cam[: VIEWS * STEP : STEP]
    poses = path @ se3.exp(np.array([0, 0, 0, -np.radians(tilt_deg), 0, 0]))
    room, views = build_room(0), []
    for index, pose in enumerate(poses):
        cast = room.cast(CAM, pose)
        depth_m = measured(cast.depth_m, room.incidence(CAM, pose, cast), np.random.default_rng(index))
        views.append(DepthView(np.where(np.isfinite(depth_m), depth_m, 0), se3.inverse(poses[0]) @ pose))
    return Look(views, poses[0])


def is_solid(points: NDArray[np.float64], low_m: float, high_m: float) -> NDArray[np.bool_]:
    """Whether something stands or hangs at points [..., 2] of the floor, between two heights; outside there are walls."""
    solid = (np.abs(points) >= np.array(ROOM_SIZE_M[:2]) / 2).any(axis=-1)
    for box in furniture.boxes(np.random.default_rng([0, 1])):
        if abs(box.center[2] - (low_m + high_m) / 2) < (box.size[2] + high_m - low_m) / 2:
            local = (points - box.center[:2]) @ box.axes[:2, :2].T
            solid |= (np.abs(local) <= box.size[:2] / 2).all(axis=-1)
    for sphere in furniture.spheres():
        squared = sphere.radius**2 - (sphere.center[2] - np.clip(sphere.center[2], low_m, high_m)) ** 2
        solid |= ((points - sphere.center[:2]) ** 2).sum(axis=-1) <= squared
    return solid


def samples(grid: Grid, T_room_grid: NDArray[np.float64], margin_m: float) -> NDArray[np.float64]:
    """Points [rows, columns, 49, 2] of the room's floor, all over each cell and up to a margin beyond its edges."""
    inside = np.linspace(-margin_m, grid.resolution_m + margin_m, 7)
    rows, columns = grid.cells.shape
    x = grid.origin_m[0] + grid.resolution_m * np.arange(columns)[None, :, None, None] + inside[:, None]
    y = grid.origin_m[1] + grid.resolution_m * np.arange(rows)[:, None, None, None] + inside
    points = np.stack(np.broadcast_arrays(x, y), axis=-1).reshape(rows, columns, -1, 2)
    return points @ T_room_grid[:2, :2].T + T_room_grid[:2, 3]


def right_share(grid: Grid, T_room_grid: NDArray[np.float64]) -> float:
    """The share of the known cells that are right."""
    low_m, high_m = SETTINGS.min_height_m, SETTINGS.max_height_m
    may_be_occupied = is_solid(samples(grid, T_room_grid, TOLERANCE_M), low_m - TOLERANCE_M, high_m + TOLERANCE_M).any(axis=-1)
    within = samples(grid, T_room_grid, -TOLERANCE_M)
    must_be_occupied = is_solid(within, low_m + TOLERANCE_M, high_m - TOLERANCE_M).any(axis=-1)
    is_right = np.where(grid.cells == OCCUPIED, may_be_occupied, ~must_be_occupied)
    return float(is_right[grid.cells != UNKNOWN].mean())


def seen_known_share(grid: Grid, look: Look) -> float:
    """Of the cells whose floor or obstacles two views saw, the share that is known."""
    counts = np.zeros(grid.cells.shape, int)
    for view in look.views:
        world = points_of(view, CAM, SETTINGS.range_m)
        points = world @ grid.T_grid_world[:3, :3].T + grid.T_grid_world[:3, 3]
        column, row = (np.floor((points[:, axis] - grid.origin_m[axis]) / grid.resolution_m).astype(int) for axis in (0, 1))
        low = (
            (points[:, 2] < SETTINGS.max_height_m)
            & (row >= 0)
            & (row < counts.shape[0])
            & (column >= 0)
            & (column < counts.shape[1])
        )
        seen = np.zeros(counts.shape, bool)
        seen[row[low], column[low]] = True
        counts += seen
    return float((grid.cells != UNKNOWN)[counts >= 2].mean())


@pytest.mark.slow
@pytest.mark.parametrize('tilt_deg', [0, 20])
def test_the_plan_is_that_of_the_room(tilt_deg: float) -> None:
    look = look_around(tilt_deg)
    T_grid_world = find_floor(look.views, CAM, SETTINGS.range_m)
    T_room_grid = look.T_room_world @ se3.inverse(T_grid_world)
    assert np.degrees(np.arccos(T_room_grid[2, 2])) < 0.5 and abs(T_room_grid[2, 3]) < 0.02  # up, and the floor's height
    grid = grid_of(look.views, CAM, T_grid_world, SETTINGS)
    assert right_share(grid, T_room_grid) >= 0.97
    assert seen_known_share(grid, look) >= 0.9
    inside = (grid.cells != UNKNOWN).sum() * grid.resolution_m**2
    assert 10 < inside < ROOM_SIZE_M[0] * ROOM_SIZE_M[1] * 1.1  # square metres


def keyframes(look: Look, T_world_error: NDArray[np.float64] | None = None) -> list[PosedView]:
    """The views as keyframes; the later half is displaced by an error, as before a loop is closed."""
    found = []
    for index, view in enumerate(look.views):
        is_wrong = T_world_error is not None and index >= len(look.views) // 2
        T_world_cam = T_world_error @ view.T_world_cam if is_wrong else view.T_world_cam
        rgb8 = torch.zeros(CAM.height, CAM.width, 3, dtype=torch.uint8)
        found.append(PosedView.at(View(CAM, rgb8, torch.from_numpy(view.depth_m)), se3.inverse(T_world_cam), 5 * index))
    return found


@pytest.mark.slow
@pytest.mark.parametrize('tilt_deg', [0, 20])
def test_the_plan_of_keyframes_is_that_of_the_room_also_after_a_correction(tilt_deg: float) -> None:
    look = look_around(tilt_deg)
    T_grid_world = find_floor(look.views, CAM, SETTINGS.range_m)
    T_room_grid = look.T_room_world @ se3.inverse(T_grid_world)
    plan = KeyframeGrid(T_grid_world, SETTINGS)
    T_grid_error = se3.exp(np.array([0.4, -0.3, 0.08, 0, 0, np.radians(15)]))  # of the grid's axes: upright, as tracking keeps it
    T_world_error = se3.inverse(T_grid_world) @ T_grid_error @ T_grid_world
    wrong, right = keyframes(look, T_world_error), keyframes(look)
    while plan.update(wrong, most=7):  # a few at a time
        pass
    assert right_share(plan.grid(), T_room_grid) < 0.9  # walls are there twice
    assert plan.update(right, most=100) and not plan.update(right, most=100)
    corrected = plan.grid()
    assert right_share(corrected, T_room_grid) >= 0.97
    assert seen_known_share(corrected, look) >= 0.9
    assert not plan.update(right[:3], most=100)  # what the map has dropped stays


def test_a_keyframe_that_sees_nothing_new_is_left_out() -> None:
    view = DepthView(np.full((CAM.height, CAM.width), 2.0, np.float32), np.eye(4))
    (keyframe,) = keyframes(Look([view], np.eye(4)))
    T_grid_world = upright(np.array([0, -1.0, 0]), np.array([0, 1.2, 0]), np.eye(4))
    plan = KeyframeGrid(T_grid_world, SETTINGS)
    near = [PosedView.at(keyframe.view, se3.exp(np.array([0.02 * n, 0, 0, 0, 0.02, 0])), n) for n in (1, 2, 3)]
    assert plan.update([keyframe, near[0]], most=5)  # a surface must be seen twice
    assert (plan.grid().cells == OCCUPIED).any()
    assert not plan.update([keyframe, *near], most=5)


@pytest.mark.parametrize(
    'settings', [GridSettings(0.01, 0.1, 1.0, 100.0), GridSettings(0.01, -10.0, 100.0, 4.0), GridSettings(0.02, 0.1, 0.12, 100.0)]
)
def test_a_view_that_does_not_fit_into_memory_is_refused_before_it_is_carved(settings: GridSettings) -> None:
    """All within what the node's parameters allow."""
    (keyframe,) = keyframes(Look([DepthView(np.full((CAM.height, CAM.width), 2.0, np.float32), np.eye(4))], np.eye(4)))
    plan = KeyframeGrid(upright(np.array([0, -1.0, 0]), np.array([0, 1.2, 0]), np.eye(4)), settings)
    for _ in range(2):  # refused once more: nothing of it was counted
        with pytest.raises(ExportError, match='is too large'):
            plan.update([keyframe], most=5)


def test_a_keyframe_too_far_away_costs_its_own_part_only() -> None:
    """As after a jump, or in a building that is larger than memory."""
    view = DepthView(np.full((CAM.height, CAM.width), 2.0, np.float32), np.eye(4))
    (keyframe,) = keyframes(Look([view], np.eye(4)))
    plan = KeyframeGrid(upright(np.array([0, -1.0, 0]), np.array([0, 1.2, 0]), np.eye(4)), SETTINGS)
    at = [PosedView.at(keyframe.view, se3.exp(np.array([x, 0, 0, 0, 0, 0])), n) for n, x in enumerate((0.0, 1e4, 0.1, 1.0))]
    plan.update(at[:1] + at[2:], most=5)
    alone = plan.grid()
    assert plan.left_out == '' and (alone.cells == OCCUPIED).any()
    for _ in range(2):
        assert not plan.update(at, most=5)
        assert plan.left_out.startswith('1 keyframes are left out: a grid of ') and 'is too large' in plan.left_out
    moved = PosedView.at(keyframe.view, se3.exp(np.array([1e4, 0, 0, 0, 0, 0])), 3)  # a correction that cannot be followed
    plan.update([*at[:3], moved], most=5)
    assert plan.left_out.startswith('2 keyframes')
    np.testing.assert_array_equal(plan.grid().cells, alone.cells)


def test_a_grid_in_steps_is_that_of_all_at_once() -> None:
    """Whatever was added, moved and asked for in between, and wherever memory began."""
    rng = np.random.default_rng(0)

    def local() -> LocalGrid:
        shape = (*rng.integers(1, 90, 2), SETTINGS.layers)
        return LocalGrid(
            (int(rng.integers(-150, 150)), int(rng.integers(-150, 150))), rng.random(shape) < 0.3, rng.random(shape) < 0.8
        )

    parts = [local() for _ in range(12)]
    steps, at_once = Voxels(SETTINGS), Voxels(SETTINGS)
    for part in parts:
        steps.add(part)
        if rng.random() < 0.5:
            steps.grid(np.eye(4))
    for part in parts[::3]:
        steps.add(part, -1)
    kept = [part for index, part in enumerate(parts) if index % 3]
    for part in reversed(kept):
        at_once.add(part)
    found, expected = steps.grid(np.eye(4)), at_once.grid(np.eye(4))
    np.testing.assert_array_equal(found.cells, expected.cells)
    assert found.origin_m == expected.origin_m
    assert {*np.unique(found.cells)} == {FREE, OCCUPIED, UNKNOWN}


def test_the_axes_are_upright_and_point_where_the_first_camera_looks() -> None:
    level = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])  # optical axes, 1.5 m over the floor
    T_world_cam = np.eye(4)
    T_grid_world = upright(np.array([0, -1.0, 0]), np.array([3.0, 1.5, 2.0]), T_world_cam)
    np.testing.assert_allclose(T_grid_world, level, atol=1e-12)
    down = se3.exp(np.array([0, 0, 0, -np.pi / 2, 0, 0]))  # looks straight down: the image's upward direction is forward
    np.testing.assert_allclose(upright(np.array([0, -1.0, 0]), np.array([0, 1.5, 0]), down)[:3, :3], level[:3, :3], atol=1e-9)


def test_a_map_without_a_floor_has_no_grid() -> None:
    wall = DepthView(np.full((CAM.height, CAM.width), 2.0, np.float32), np.eye(4))
    with pytest.raises(ExportError, match='no floor was seen, so it is not known where up is'):
        find_floor([wall], CAM, 4.0)
    nothing = DepthView(np.zeros((CAM.height, CAM.width), np.float32), np.eye(4))
    for views in ([], [nothing]):
        with pytest.raises(ExportError, match='the poses see too little of the map'):
            find_floor(views, CAM, 4.0)
    with pytest.raises(ExportError, match='nothing is within range'):
        grid_of([nothing], CAM, np.eye(4), SETTINGS)
    far = DepthView(nothing.depth_m, se3.exp(np.array([1e4, 1e4, 0, 0, 0, 0])))
    with pytest.raises(ExportError, match='is too large: choose a larger resolution'):
        grid_of([nothing, far], CAM, np.eye(4), SETTINGS)


def test_files_are_read_by_the_rules_of_map_server(tmp_path: Path) -> None:
    """As nav2's map_io in mode trinary: the first row of the picture is the top, and shade s is p = (255 - s) / 255."""
    cells = np.array([[OCCUPIED, FREE, UNKNOWN], [FREE, FREE, OCCUPIED]], np.int8)
    write_map_server(tmp_path / 'map.yaml', Grid(cells, 0.05, (-1.25, 2.5), np.eye(4)))
    meta = yaml.safe_load((tmp_path / 'map.yaml').read_text())
    assert (meta['resolution'], meta['origin'], meta['mode'], meta['negate']) == (0.05, [-1.25, 2.5, 0.0], 'trinary', 0)
    picture = cv2.imread(str(tmp_path / meta['image']), cv2.IMREAD_UNCHANGED)
    p = (255 - picture[::-1].astype(float)) / 255
    read = np.where(p > meta['occupied_thresh'], OCCUPIED, np.where(p < meta['free_thresh'], FREE, UNKNOWN))
    assert read.tolist() == cells.tolist()
    assert 'T_grid_world' in (tmp_path / 'map.yaml').read_text()


def read_octree(content: bytes) -> dict[tuple[int, int, int], int]:
    """The leaves of an octree by their keys, read as OctoMap's ``readBinaryNode`` does; and its header is right."""
    header, _, data = content.partition(b'\ndata\n')
    assert header.startswith(b'# Octomap OcTree binary file\n')
    stated = dict(line.split() for line in header.decode().splitlines() if not line.startswith('#'))
    assert stated.keys() == {'id', 'size', 'res'} and stated['id'] == 'OcTree'
    leaves: dict[tuple[int, int, int], int] = {}
    pairs, size = iter(data), 1

    def read(key: tuple[int, ...], width: int) -> None:
        nonlocal size
        bits = next(pairs) | next(pairs) << 8
        found = [(child, bits >> 2 * child & 3) for child in range(8) if bits >> 2 * child & 3]
        size += len(found)
        for child, kind in found:
            at = tuple(place + width * (child >> axis & 1) for axis, place in enumerate(key))
            if kind == 3:
                read(at, width // 2)
            else:
                assert width == 1
                leaves[at] = {1: FREE, 2: OCCUPIED}[kind]

    read((0, 0, 0), 1 << 15)
    assert next(pairs, None) is None and size == int(stated['size'])
    return leaves


def test_voxels_are_read_by_the_rules_of_octomap(tmp_path: Path) -> None:
    rng, low = np.random.default_rng(0), (-7, 3, -2)
    voxels = rng.choice(np.array([UNKNOWN, FREE, OCCUPIED], np.int8), (5, 9, 4))
    write_octomap(tmp_path / 'map.bt', Volume(voxels, 0.05, low, np.eye(4)))
    leaves = read_octree((tmp_path / 'map.bt').read_bytes())
    expected = {
        tuple((1 << 15) + np.array(low) + (column, row, layer)): voxels[row, column, layer]
        for row, column, layer in np.argwhere(voxels != UNKNOWN)
    }
    assert leaves == expected
    with pytest.raises(ExportError, match='too large for an octree'):
        write_octomap(tmp_path / 'far.bt', Volume(voxels, 0.05, (1 << 15, 0, 0), np.eye(4)))


BESIDE = 0.07 * np.array([[x, y] for x in (-1, 0, 1) for y in (-1, 0, 1)])
"""Metres: half the diagonal of a voxel, and the error of measured depth."""


@pytest.mark.slow
def test_voxels_are_those_of_the_room() -> None:
    """Looked through inside, a surface at walls, floor and furniture."""
    look = look_around(20)
    T_grid_world = find_floor(look.views, CAM, SETTINGS.range_m)
    volume = volume_of(look.views, CAM, T_grid_world, resolution_m=0.05, range_m=SETTINGS.range_m)
    T_room_grid = look.T_room_world @ se3.inverse(T_grid_world)
    index = np.argwhere(volume.voxels != UNKNOWN)
    centres = volume.resolution_m * (index[:, [1, 0, 2]] + np.array(volume.low) + 0.5)
    room = centres @ T_room_grid[:3, :3].T + T_room_grid[:3, 3]
    states = volume.voxels[tuple(index.T)]
    assert (states == OCCUPIED).sum() > 3000 and (states == FREE).sum() > 20_000
    for layer in np.unique(index[:, 2]):
        at = room[index[:, 2] == layer]
        height_m, found = float(at[0, 2]), states[index[:, 2] == layer]
        assert is_solid(at[found == FREE, :2], height_m, height_m).mean() < 0.05 if (found == FREE).any() else True
        near = is_solid(at[found == OCCUPIED, None, :2] + BESIDE, height_m - 0.07, height_m + 0.07).any(axis=1)
        assert height_m < 0.07 or near.mean() > 0.9


def test_depth_is_rendered_from_the_map() -> None:
    wall = torch.cartesian_prod(torch.linspace(-2, 2, 60), torch.linspace(-2, 2, 60), torch.tensor([2.0]))
    count = len(wall)
    gaussians = Gaussians(wall, torch.full((count, 1), -3.0), torch.full((count,), 4.0), torch.zeros(count, 3))
    (view,) = rendered_views(gaussians, make_rasterizer('cpu', 1), CAM.resized(32, 24), np.eye(4)[None], list)
    assert view.depth_m.shape == (24, 32) and np.abs(view.depth_m - 2).max() < 1e-3
