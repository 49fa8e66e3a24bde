"""Recognises places: which keyframes show what a view shows, and from where the view was taken.

Each keyframe keeps ORB features (Rublee et al. 2011) with depth. All keyframes are ranked by the number of parts of descriptors
that they have in common with the view, without comparing descriptors (multi-index hashing; Norouzi, Punjani and Fleet, "Fast
search in Hamming space with multi-index hashing", CVPR 2012). The descriptors of the best ones are matched with those of the
view. Matches are right where they agree about the distances between points, which no motion changes (Leordeanu and Hebert, "A
spectral technique for correspondence problems using pairwise constraints", ICCV 2005); the pose follows from these, and is
refined on the pixels. Nothing is drawn at random. What is found is a guess: alignment and a verdict must confirm it.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from splatam_core.geometry.camera import PinholeCamera
from splatam_core.geometry.se3 import Matrix
from splatam_core.images.features import orb_features
from splatam_core.images.view import View
from splatam_core.mapping.posed import PosedView
from splatam_core.tracking.matching import matched
from splatam_core.types import Arrays

NUM_FEATURES = 600
"""Of a view. With descriptors (32 bytes), points (12) and keys (4 x 4), a keyframe takes at most 36 kB."""

MAX_WIDTH = 320
"""Wider views are made smaller, in pixels: a smaller one has fewer features to recognise, a larger one takes longer."""

_FAST_THRESHOLD = 7  # of 255; the default, 20, finds little in a blurred frame
_NUM_TABLES, _KEY_BITS = 4, 16  # parts of a descriptor that are looked up, and their length
_NUM_ALIKE, _NUM_OTHERS = 6, 6  # keyframes whose descriptors are matched, for each view
_MOST_RANKED = 128  # places that are ranked for a keyframe
_GOLDEN = (math.sqrt(5) - 1) / 2  # its multiples modulo 1 visit everything evenly
_NEAR_M, _NEAR_RAD = 0.15, 0.15  # keyframes that are nearer to each other show the same
_FARTHEST = 80  # bits of 256 in which matched descriptors differ
_LARGEST_ERROR = 0.0125  # reprojection error of an inlier, as a fraction of the width: 4 pixels of 320
_DEPTH_NOISE = 0.02, 0.01  # m, and relative to the depth: errors of the distance between two points
_FAR_APART_M = 0.1  # points that are nearer to each other say little by their distance
_NUM_SEEDS, _ROUNDS = 8, 3
_MIN_INLIERS = 8
_LEAST_DEPTH, _LEAST_FEATURES = 0.3, 100  # of the pixels, with depth: a view that shows a place, and not a hand or a wall


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Where a view was perhaps taken.

    Attributes:
        keyframe: number of the keyframe that shows the same.
        T_cam_keyframe: [4, 4] from the keyframe's camera to the view's.
        T_cam_world: [4, 4] guess of the view's pose, from the keyframe's present one.
        num_matches: number of features that both have in common.
        num_inliers: of these, how many agree with the guess.
    """

    keyframe: int
    T_cam_keyframe: Matrix
    T_cam_world: Matrix
    num_matches: int
    num_inliers: int


@dataclass(frozen=True, slots=True, eq=False)
class _Keyframe:
    """What is kept of a keyframe.

    Attributes:
        T_cam_world: [4, 4] its pose.
        descriptors: [K, 32] uint8 of the features with depth.
        points: [K, 3] float32 where they are in its camera.
        keys: [K * tables] int32 of the descriptors, see ``_keys``.
        source: [4, 4] the tensor from which its pose was read; None where it was not read from one.
    """

    T_cam_world: Matrix
    descriptors: NDArray[np.uint8]
    points: NDArray[np.float32]
    keys: NDArray[np.int32]
    source: Tensor | None = None

    @classmethod
    def of(cls, T_cam_world: Matrix, descriptors: NDArray[np.uint8], points: NDArray[np.float32]) -> _Keyframe:
        """Returns a keyframe with some features."""
        return cls(T_cam_world, descriptors, points, _keys(descriptors))

    @classmethod
    def seen_in(cls, view: View, T_cam_world: Matrix) -> _Keyframe:
        """Returns a keyframe with the features of a view."""
        seen = _Features.of(view)
        has_depth = seen.points[:, 2] > 0
        return cls.of(T_cam_world, seen.descriptors[has_depth], seen.points[has_depth])


class Places:
    """Every keyframe as a place to be recognised. The same calls give the same answers, bit for bit."""

    def __init__(self) -> None:
        self._keyframes: dict[int, _Keyframe] = {}
        self._last: tuple[View, _Features] | None = None

    def __len__(self) -> int:
        return len(self._keyframes)

    def __contains__(self, keyframe: int) -> bool:
        return keyframe in self._keyframes

    def add(self, keyframe: int, view: View, T_cam_world: Matrix) -> None:
        """Adds a keyframe, or replaces that of the same number.

        Args:
            keyframe: its number.
            view: its images, in the host's memory; the full frame has more to recognise than what is kept of it for mapping.
            T_cam_world: [4, 4] its pose.
        """
        self._keyframes[keyframe] = _Keyframe.seen_in(view, T_cam_world)

    def follow(self, keyframes: Iterable[PosedView]) -> None:
        """Adds, drops and moves places, so that they are those of the given keyframes, by number, at their present poses."""
        old, self._keyframes = self._keyframes, {}
        for posed in keyframes:
            known = old.get(posed.frame)
            if known is None or known.source is not posed.T_cam_world:
                T_cam_world = posed.T_cam_world.double().numpy(force=True)
                known = _Keyframe.seen_in(posed.view, T_cam_world) if known is None else replace(known, T_cam_world=T_cam_world)
                known = replace(known, source=posed.T_cam_world)
            self._keyframes[posed.frame] = known

    def arrays(self) -> Arrays:
        """Returns the features of all places, by name; ``restore`` takes them, and ``follow`` gives them their poses."""
        kept = self._keyframes.values()
        return {
            'frames': np.array(list(self._keyframes), np.int64),
            'counts': np.array([len(keyframe.points) for keyframe in kept], np.int64),
            'descriptors': np.concatenate([np.empty((0, 32), np.uint8), *(keyframe.descriptors for keyframe in kept)]),
            'points': np.concatenate([np.empty((0, 3), np.float32), *(keyframe.points for keyframe in kept)]),
        }

    def restore(self, arrays: Arrays) -> None:
        """Replaces all places by those of ``arrays``; their poses are not known yet.

        Raises:
            KeyError: an array is missing.
            ValueError: the arrays do not fit each other.
        """
        frames, counts, descriptors, points = (arrays[name] for name in ('frames', 'counts', 'descriptors', 'points'))
        form = [(array.dtype.name, array.shape) for array in (frames, counts, descriptors, points)]
        size = (len(frames),)
        if form != [('int64', size), ('int64', size), ('uint8', (len(points), 32)), ('float32', (len(points), 3))]:
            raise ValueError(f'places are {form}')
        if (counts < 0).any() or (counts > len(points)).any() or counts.sum() != len(points) or not np.isfinite(points).all():
            raise ValueError(f'places have {counts.sum()} features of {len(points)}')
        begins = np.cumsum(counts) - counts
        self._keyframes = {
            frame: _Keyframe.of(np.eye(4), descriptors[begin : begin + count], points[begin : begin + count])
            for frame, begin, count in zip(frames.tolist(), begins.tolist(), counts.tolist(), strict=True)
        }

    def poses(self) -> dict[int, Matrix]:
        """Returns the pose [4, 4], world to camera, of each keyframe by its number."""
        return {number: keyframe.T_cam_world for number, keyframe in self._keyframes.items()}

    def find(self, view: View, limit: int, exclude: Collection[int] = (), attempt: int = 0) -> list[Place]:
        """Returns where a view was perhaps taken, at most ``limit`` poses that differ, the one with most inliers first.

        The view is compared with a bounded number of keyframes that are not near each other: with those that look most alike,
        and with others, which change from attempt to attempt.

        Args:
            view: what the camera sees.
            limit: largest number of places.
            exclude: numbers of keyframes that are not considered.
            attempt: how often about the same view was looked for before.
        """
        places = [self.compare(number, view) for number in self.candidates(view, exclude, attempt)]
        found = sorted((place for place in places if place is not None), key=lambda place: -place.num_inliers)
        return [found[index] for index in _apart([place.T_cam_world for place in found])][:limit]

    def candidates(self, view: View, exclude: Collection[int] = (), attempt: int = 0) -> list[int]:
        """Returns the numbers of the keyframes that are worth a comparison with a view. Arguments: see ``find``."""
        ranked = self._spread(self._ranked(self._features(view).descriptors, exclude))
        others = ranked[_NUM_ALIKE:]
        first = attempt * _NUM_OTHERS % max(1, len(others))
        return [*ranked[:_NUM_ALIKE], *(others[first:] + others[:first])[:_NUM_OTHERS]]

    def compare(self, keyframe: int, view: View) -> Place | None:
        """Returns where a view was perhaps taken, if it shows what a keyframe shows; None if too few features agree on a pose."""
        return self._compare(keyframe, self._features(view))

    def alike(self, keyframe: int, among: Sequence[int], limit: int) -> list[int]:
        """Returns the numbers of the keyframes that look most like one of them, which is known; at most ``limit``.

        Of very many, only every n-th is considered, so that the time does not grow: other ones for the next keyframe.

        Args:
            keyframe: its number.
            among: numbers of those that are considered.
            limit: largest number of keyframes.
        """
        known, step = [number for number in among if number in self._keyframes], -(-len(among) // _MOST_RANKED)
        chosen = known[int(keyframe * _GOLDEN % 1 * step) :: step] if step > 1 else known
        ranked = self._by_shared_keys(self._keyframes[keyframe].keys, chosen)
        return [ranked[index] for index in _apart([self._keyframes[number].T_cam_world for number in ranked], limit)]

    def compare_keyframes(self, keyframe: int, other: int, camera: PinholeCamera) -> Place | None:
        """Returns where one keyframe was perhaps taken, if it shows what another one shows; None if too few features agree.

        Args:
            keyframe: number of the other one, whose pose is known.
            other: number of the one whose pose is asked for.
            camera: of the pixels in which an error counts.
        """
        kept = self._keyframes[other]
        return self._compare(keyframe, _Features(camera, _projected(kept.points, camera), kept.descriptors, kept.points))

    def _features(self, view: View) -> _Features:
        """Returns the features of a view; those of the last one are kept."""
        if self._last is None or self._last[0] is not view:
            self._last = view, _Features.of(view)
        return self._last[1]

    def _ranked(self, descriptors: NDArray[np.uint8], exclude: Collection[int]) -> list[int]:
        """Returns the numbers of the keyframes, the one with most keys of the descriptors [K, 32] first."""
        return self._by_shared_keys(_keys(descriptors), [number for number in self._keyframes if number not in exclude])

    def _by_shared_keys(self, keys: NDArray[np.int32], numbers: Sequence[int]) -> list[int]:
        """Returns numbers of keyframes, the one with most of some keys [K * tables] first."""
        is_key = np.zeros(_NUM_TABLES << _KEY_BITS, np.uint8)
        is_key[keys] = 1
        shared = {number: int(is_key.take(self._keyframes[number].keys).sum(dtype=np.int64)) for number in numbers}
        return sorted(numbers, key=lambda number: (-shared[number], number))

    def _spread(self, ranked: list[int]) -> list[int]:
        """Returns the keyframes of a ranking without those that are near one before them."""
        return [ranked[index] for index in _apart([self._keyframes[number].T_cam_world for number in ranked])]

    def _compare(self, number: int, seen: _Features) -> Place | None:
        """Matches a view with a keyframe; returns None if too few features agree on a pose."""
        keyframe = self._keyframes[number]
        if min(len(seen.descriptors), len(keyframe.descriptors)) < _MIN_INLIERS:
            return None
        pairs = matched(keyframe.descriptors, seen.descriptors)
        is_near = pairs.distance <= _FARTHEST
        left, right = pairs.first[is_near], pairs.second[is_near]
        points, seen_points = keyframe.points[left].astype(np.float64), seen.points[right].astype(np.float64)
        matches = _Matches(points, seen_points, seen.pixels[right], seen.camera)
        T, inliers = matches.pose()
        num_inliers = int(inliers.sum())
        return None if num_inliers < _MIN_INLIERS else Place(number, T, T @ keyframe.T_cam_world, len(left), num_inliers)


def shows_a_place(view: View) -> bool:
    """Returns whether a view, in the host's memory, has enough depth and features to be recognised later."""
    has_depth = float(view.valid.float().mean()) >= _LEAST_DEPTH
    return has_depth and int((_Features.of(view).points[:, 2] > 0).sum()) >= _LEAST_FEATURES


@dataclass(frozen=True, slots=True, eq=False)
class _Features:
    """The features of a view.

    Attributes:
        camera: of the pixels.
        pixels: [K, 2].
        descriptors: [K, 32] uint8.
        points: [K, 3] float32 where they are in the camera; zeros where there is no depth.
    """

    camera: PinholeCamera
    pixels: Matrix
    descriptors: NDArray[np.uint8]
    points: NDArray[np.float32]

    @classmethod
    def of(cls, view: View) -> _Features:
        """Finds the features of a view."""
        view = view.narrowed(1.0, MAX_WIDTH)
        keypoints, descriptors = orb_features(view.rgb8.numpy(force=True), NUM_FEATURES, _FAST_THRESHOLD)
        if descriptors is None:
            return cls(view.camera, np.empty((0, 2)), np.empty((0, 32), np.uint8), np.empty((0, 3), np.float32))
        pixels = np.array([keypoint.pt for keypoint in keypoints[:NUM_FEATURES]], np.float64)  # OpenCV returns more at a tie
        return cls(view.camera, pixels, descriptors[:NUM_FEATURES], _points(view, pixels))


@dataclass(frozen=True, slots=True, eq=False)
class _Matches:
    """Points of a keyframe and what a view shows of them.

    Attributes:
        points: [K, 3] in the keyframe's camera.
        seen: [K, 3] in the view's camera; zeros where it has no depth.
        pixels: [K, 2] of the view.
        camera: of the view.
    """

    points: Matrix
    seen: Matrix
    pixels: Matrix
    camera: PinholeCamera

    def pose(self) -> tuple[Matrix, NDArray[np.bool_]]:
        """Returns the [4, 4] motion from keyframe to view that most matches agree with, and [K] which these are."""
        best: tuple[Matrix, NDArray[np.bool_]] = np.eye(4), np.zeros(len(self.points), bool)
        for members in self._groups():
            T, inliers = np.eye(4), members
            for _ in range(_ROUNDS):
                with_depth = inliers & (self.seen[:, 2] > 0)
                if with_depth.sum() < 3:
                    break
                T = _rigid(self.points[with_depth], self.seen[with_depth])
                inliers = self._agreeing(T)
            if inliers.sum() > best[1].sum():
                best = T, inliers
        return best if best[1].sum() < _MIN_INLIERS else self._refined(*best)

    def _groups(self) -> Iterator[NDArray[np.bool_]]:
        """Yields [K] matches that agree with one match about distances, for those with which most agree; each group once."""
        known = np.flatnonzero(self.seen[:, 2] > 0)
        if len(known) < _MIN_INLIERS // 2:
            return
        points, seen = self.points[known], self.seen[known]
        noise = _DEPTH_NOISE[0] + _DEPTH_NOISE[1] * (points[:, 2] + seen[:, 2])
        apart, seen_apart = _distances(points), _distances(seen)
        agrees = (np.abs(apart - seen_apart) < np.maximum(noise[:, None], noise)) & (apart > _FAR_APART_M)
        groups: set[bytes] = set()
        for seed in np.argsort(-agrees.sum(axis=1), kind='stable')[:_NUM_SEEDS]:
            votes = agrees[agrees[seed]].sum(axis=0)  # of those that agree with the seed
            members = np.zeros(len(self.points), bool)
            members[known[agrees[seed] & (2 * votes >= votes[seed])]] = True
            if members.tobytes() not in groups:
                groups.add(members.tobytes())
                yield members

    def _agreeing(self, T: Matrix) -> NDArray[np.bool_]:
        """Returns [K] which points a motion [4, 4] takes to where the view shows them."""
        x, y, z = T[:3, :3] @ self.points.T + T[:3, 3:]
        z = np.where(z > 0, z, np.inf)
        u, v = self.camera.fx * x / z + self.camera.cx, self.camera.fy * y / z + self.camera.cy
        off = np.hypot(u - self.pixels[:, 0], v - self.pixels[:, 1])
        return np.isfinite(z) & (off < _LARGEST_ERROR * self.camera.width)

    def _refined(self, T: Matrix, inliers: NDArray[np.bool_]) -> tuple[Matrix, NDArray[np.bool_]]:
        """Returns the motion that minimises the error of the inliers in pixels, and its inliers; the first one if that has more."""
        rotation, translation = cv2.solvePnPRefineLM(
            self.points[inliers], self.pixels[inliers], self.camera.matrix, None, cv2.Rodrigues(T[:3, :3])[0], T[:3, 3:].copy()
        )
        refined = np.eye(4)
        refined[:3, :3], refined[:3, 3] = cv2.Rodrigues(rotation)[0], translation[:, 0]
        agreeing = self._agreeing(refined)
        return (refined, agreeing) if np.isfinite(refined).all() and agreeing.sum() >= inliers.sum() else (T, inliers)


def _apart(T_cam_world: Sequence[Matrix], limit: int | None = None) -> list[int]:
    """Returns the indices of the poses [4, 4] that are not near one before them, the first ones up to a limit."""
    poses = np.array(T_cam_world).reshape(-1, 4, 4)
    centres = -np.einsum('nji,nj->ni', poses[:, :3, :3], poses[:, :3, 3])
    is_free, chosen = np.ones(len(poses), bool), list[int]()
    for index in range(len(poses)):
        if len(chosen) == limit:
            break
        if is_free[index]:
            chosen.append(index)
            cosines = (np.einsum('nij,ij->n', poses[:, :3, :3], poses[index, :3, :3]) - 1) / 2
            near = np.linalg.norm(centres - centres[index], axis=1) < _NEAR_M
            is_free &= ~(near & (cosines > math.cos(_NEAR_RAD)))
    return chosen


def _distances(points: Matrix) -> Matrix:
    """Returns [K, K] the distances between points [K, 3], exact to a micrometre: three times as fast as by differences."""
    centred = points - points.mean(axis=0)
    lengths = np.square(centred).sum(axis=1)
    return np.sqrt(np.maximum(lengths[:, None] + lengths - 2 * centred @ centred.T, 0))


def _rigid(points: Matrix, others: Matrix) -> Matrix:
    """Returns the [4, 4] motion that takes points [K, 3] to others with the least squared distance (Umeyama 1991)."""
    mean, mean_of_others = points.mean(axis=0), others.mean(axis=0)
    U, _, V_t = np.linalg.svd((others - mean_of_others).T @ (points - mean))
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(V_t))]) @ V_t
    T[:3, 3] = mean_of_others - T[:3, :3] @ mean
    return T


def _points(view: View, pixels: Matrix) -> NDArray[np.float32]:
    """Returns [K, 3] points of pixels [K, 2] in the camera, by the nearest reading beside the pixel; zeros without one.

    Features lie on the edges of objects, and belong to what is in front.
    """
    depth = view.depth.numpy(force=True)
    nearest = cv2.erode(np.where(depth > 0, depth, np.float32(np.inf)), np.ones((3, 3), np.uint8))
    u, v = pixels.round().astype(int).T
    z = nearest[v, u]
    z = np.where(np.isfinite(z), z, np.float32(0))
    camera = view.camera
    x, y = (pixels[:, 0] - camera.cx) / camera.fx * z, (pixels[:, 1] - camera.cy) / camera.fy * z
    return np.stack([x, y, z], axis=1).astype(np.float32)


def _projected(points: NDArray[np.float32], camera: PinholeCamera) -> Matrix:
    """Returns [K, 2] the pixels of points [K, 3] in front of a camera."""
    x, y, z = points.T.astype(np.float64)
    return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1)


def _keys(descriptors: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Returns [K * tables] parts of the descriptors [K, 32], each with the number of the part in front."""
    parts = np.ascontiguousarray(descriptors).view('<u2')[:, :_NUM_TABLES]
    return (parts.astype(np.int32) + (np.arange(_NUM_TABLES, dtype=np.int32) << _KEY_BITS)).ravel()
