"""How one map lies in another: keyframes of the one are recognised in the other and aligned to it.

Each keyframe that is recognised says by itself how the maps lie to each other, by the same rules as for a lost camera
(graph/relocalisation.py). The transform is the one that agrees best with those that say the same, by robust optimisation
(graph/pose_graph.py). Maps are joined only if a good part of the keyframes that see both maps then, recognised or not, fit: rooms
that are built alike have places that look alike, but others that do not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatam_core.config import SlamConfig
from splatam_core.device import pose_tensor
from splatam_core.geometry import motions, se3
from splatam_core.geometry.se3 import Matrix
from splatam_core.graph.places import Places
from splatam_core.graph.pose_graph import Edge, PoseGraph, optimize
from splatam_core.graph.relocalisation import Sight, is_convincing, recognise, unknown
from splatam_core.mapping.gaussian_map import GaussianMap
from splatam_core.mapping.posed import PosedView
from splatam_core.rasterizer import Gaussians
from splatam_core.state import SavedKeyframes
from splatam_core.tracking import Tracker
from splatam_core.tracking.time_offset import TimeOffset

ENOUGH = 12
"""Keyframes that agree: no more are looked at then."""

LEAST = 3
"""Keyframes that must agree: one may be wrong, and a second one beside it in the same way."""

_STEP = 8  # at first every eighth keyframe is looked at, so that a place of both maps is met soon
_ALIKE = 0.15  # m and rad: keyframes say the same; both maps have drift
_LEAST_SHARE = 0.35  # of the keyframes that see both maps: so many must fit; with drift and blur not all do
_SEEN = 0.5  # of the view mapped in the first map: the keyframe sees both maps
_TESTED = 40  # keyframes, at most
_POSITION_M, _ROTATION_RAD = 0.02, 0.01  # errors of a pose in a map that images do not show
_LIMIT = 60.0  # of a squared error in standard deviations, beyond which a keyframe loses its weight
_CELL_M = 0.03  # a Gaussian of the second map that has one of the first within one to two cells is left out

Progress = Callable[[range], Iterable[int]]


@dataclass(frozen=True, slots=True, eq=False)
class SavedMap:
    """A finished map.

    Attributes:
        gaussians: its Gaussians.
        saved: its keyframes.
    """

    gaussians: Gaussians
    saved: SavedKeyframes


@dataclass(frozen=True, slots=True, eq=False)
class Joint:
    """How a second map lies in a first one.

    Attributes:
        T_first_second: [4, 4] world of the second to world of the first; None where too few keyframes agree or fit.
        num_looked_at: number of keyframes of the second that were looked for.
        num_recognised: how many of them were recognised.
        num_agreeing: how many of these agree.
        num_seen: number of keyframes of the second that see both maps then.
        num_fitting: how many of these fit.
    """

    T_first_second: Matrix | None
    num_looked_at: int
    num_recognised: int
    num_agreeing: int
    num_seen: int = 0
    num_fitting: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """A keyframe of the second map that was recognised in the first one.

    Attributes:
        in_first: [4, 4] its pose in the world of the first, camera to world.
        in_second: [4, 4] in the world of the second.
        covariance: [6, 6] of the first pose, as a twist in the camera's axes.
    """

    in_first: Matrix
    in_second: Matrix
    covariance: Matrix

    @property
    def T_first_second(self) -> Matrix:
        """[4, 4] how the worlds lie, as this keyframe says."""
        return self.in_first @ se3.inverse(self.in_second)

    def edge(self) -> Edge:
        """Returns the same as an edge between the worlds."""
        own = np.diag(np.repeat(np.square([_POSITION_M, _ROTATION_RAD]), 3))
        to_camera = motions.adjoint(se3.inverse(self.in_second))
        information = to_camera.T @ np.linalg.inv(self.covariance + own) @ to_camera
        return Edge(0, 1, self.T_first_second, information, _LIMIT)


def find_joint(first: SavedMap, second: SavedMap, tracker: Tracker, config: SlamConfig, progress: Progress = iter) -> Joint:
    """Finds how the second map lies in the first one.

    Args:
        first: the map that stays, on the tracker's device.
        second: the map whose keyframes are looked for.
        tracker: aligns them.
        config: says when a pose may be used.
        progress: wraps the loop over the keyframes.
    """
    places = Places()
    places.restore(first.saved.places)
    places.follow(first.saved.keyframes)
    found: list[_Found] = []
    keyframes, count = _spread(second.saved.keyframes), 0
    is_one = np.zeros(0, dtype=bool)
    for index in progress(range(len(keyframes))):
        count += 1
        recognised = recognise(_sight(keyframes[index], first.gaussians, tracker, config), places, unknown()[0])
        if recognised is not None:
            in_second = se3.inverse(keyframes[index].T_cam_world.double().numpy(force=True))
            found.append(_Found(recognised.T_world_cam, in_second, recognised.covariance))
            is_one = _largest_group(found)
        if is_one.sum() >= ENOUGH:
            break
    agreeing = [one for one, agrees in zip(found, is_one) if agrees]
    if len(agreeing) < LEAST:
        return Joint(None, count, len(found), len(agreeing))
    T = _best(agreeing)
    fits = [_fits(_sight(one, first.gaussians, tracker, config), _moved(one.T_cam_world, T)) for one in keyframes[:_TESTED]]
    seen = [fit for fit in fits if fit is not None]
    is_sure = sum(seen) >= _LEAST_SHARE * len(seen)
    return Joint(T if is_sure else None, count, len(found), len(agreeing), len(seen), sum(seen))


def joined(first: SavedMap, second: SavedMap, T_first_second: Matrix) -> SavedMap:
    """Returns both maps as one, in the world of the first. Where both show a surface, the first one's is kept.

    The keyframes keep their order and get new numbers.

    Raises:
        RasterizerError: the first map is isotropic and the second is not.
    """
    moved = transformed(second.gaussians, T_first_second)
    both = GaussianMap(first.gaussians.rotations is not None)
    for gaussians in (first.gaussians, moved.chosen(~_is_near(moved.means, first.gaussians.means))):
        both.append(replace(gaussians, anchors=None))  # of frames of different runs
    there = [replace(one, T_cam_world=_moved(one.T_cam_world, T_first_second)) for one in second.saved.keyframes]
    keyframes = [*first.saved.keyframes, *there]
    places = {name: np.concatenate([first.saved.places[name], second.saved.places[name]]) for name in first.saved.places}
    numbers = [len(each.saved.keyframes) + each.saved.places['frames'] for each in (first, second)]  # they are negative
    places['frames'] = np.concatenate([numbers[0], len(first.saved.keyframes) + numbers[1]]) - len(keyframes)
    numbered = tuple(replace(one, frame=index - len(keyframes)) for index, one in enumerate(keyframes))
    return SavedMap(both.gaussians.detached(), SavedKeyframes(numbered, places))


def transformed(gaussians: Gaussians, T: Matrix) -> Gaussians:
    """Returns Gaussians after a motion [4, 4] of the world, without anchors."""
    result = GaussianMap(gaussians.rotations is not None)
    result.append(replace(gaussians.detached(), bounds=None, anchors=None))
    half = motions.exp(0.5 * motions.log(T))
    for _ in range(2):  # one move turns by less than half a circle
        result.move(lambda frames: np.repeat(half[None], len(frames), axis=0))
    return result.gaussians.detached()


def _spread(keyframes: Sequence[PosedView]) -> list[PosedView]:
    """Returns the keyframes in an order that soon has some from everywhere."""
    return [keyframe for first in range(_STEP) for keyframe in keyframes[first::_STEP]]


def _sight(keyframe: PosedView, gaussians: Gaussians, tracker: Tracker, config: SlamConfig) -> Sight:
    """Returns a keyframe as a frame to be looked for."""
    view = keyframe.view.to(gaussians.means.device)
    return Sight(
        stamp_ns=0,
        view=view,
        host=keyframe.view,
        gaussians=gaussians,
        tracker=tracker,
        time_offset=TimeOffset(),
        config=config.tracking,
    )


def _fits(sight: Sight, T_cam_world: Tensor) -> bool | None:
    """Returns whether a view fits the map at a pose [4, 4]; None if it sees too little of it."""
    expected = T_cam_world.double().numpy(force=True)
    result = sight.tracker.track(sight.view, sight.gaussians, expected)
    if result.visible_fraction < _SEEN:
        return None
    twist = motions.log(result.T_cam_world @ se3.inverse(expected))
    return is_convincing(result) and bool(np.linalg.norm(twist.reshape(2, 3), axis=1).max() < _ALIKE)


def _largest_group(found: Sequence[_Found]) -> NDArray[np.bool_]:
    """Returns [K] which keyframes agree with the one that most agree with."""
    worlds = np.array([one.T_first_second for one in found])
    off = np.array([motions.log(se3.inverse(one.in_first) @ worlds @ one.in_second) for one in found])
    groups = np.linalg.norm(off.reshape(len(found), len(found), 2, 3), axis=3).max(axis=2) < _ALIKE
    return groups[groups.sum(axis=1).argmax()]


def _best(found: Sequence[_Found]) -> Matrix:
    """Returns the [4, 4] transform that agrees best with what single keyframes say."""
    graph = PoseGraph.of(np.array([np.eye(4), found[0].T_first_second]), [one.edge() for one in found])
    return optimize(graph).T_world_cam[1]


def _moved(T_cam_world: Tensor, T: Matrix) -> Tensor:
    """Returns the pose [4, 4] of a camera after a motion [4, 4] of its world."""
    return pose_tensor(T_cam_world.double().numpy(force=True) @ se3.inverse(T), T_cam_world.device)


def _is_near(points: Tensor, others: Tensor) -> Tensor:
    """Returns [N] which points [N, 3] have one of the others [M, 3] in their cell or in one beside it."""
    occupied = np.unique(_keys(np.floor(others.double().numpy(force=True) / _CELL_M)))
    cells = np.floor(points.double().numpy(force=True) / _CELL_M)
    near = np.zeros(len(cells), dtype=bool)
    for offset in np.ndindex(3, 3, 3):
        near |= np.isin(_keys(cells + np.array(offset) - 1), occupied)
    return torch.from_numpy(near).to(points.device)


def _keys(cells: NDArray[np.float64]) -> NDArray[np.int64]:
    """Returns [N] one number for each cell [N, 3], as long as they are within 30 km."""
    return (cells.astype(np.int64) & 0x1FFFFF) @ np.array([1 << 42, 1 << 21, 1], dtype=np.int64)
