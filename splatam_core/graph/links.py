"""The edges of the keyframe graph, and the work that measures them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from splatam_core.geometry import motions, se3
from splatam_core.geometry.se3 import Matrix
from splatam_core.graph.pose_graph import Edge

_FAR_M = 5.0  # of a new map that lies beside the old one: more than drift


class Kind(IntEnum):
    """What an edge was measured by."""

    ODOMETRY = 0
    WINDOW = 1
    LOOP = 2
    PENDING = 3  # a loop that no other one confirms yet
    FOUND = 4  # a loop that nobody has compared with the graph yet


_LIMITS = {Kind.ODOMETRY: np.inf, Kind.WINDOW: 6.0, Kind.LOOP: 60.0}
"""Of the squared error of an edge, in standard deviations of six numbers. A pair that contradicts the odometry and other pairs is
wrong; loops may contradict them by all the drift that came together."""

_DEVIATIONS = {Kind.ODOMETRY: (0.016, 0.008), Kind.WINDOW: (0.01, 0.006), Kind.LOOP: (0.02, 0.012)}
"""Errors (m, rad) that images do not show, such as those of calibration; from one keyframe to the next, or of a loop.

Those of the odometry are alike from one keyframe to the next, because the map gives way to the camera: they add up.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Link(Edge):
    """An edge, and what it was measured by."""

    kind: Kind = Kind.ODOMETRY

    @classmethod
    def measured(cls, first: int, second: int, T: Matrix, kind: Kind, covariance: Matrix, factor: float = 1.0) -> Link:
        """Returns a link between two nodes.

        Args:
            first: number of a node.
            second: of another one.
            T: [4, 4] the motion between them.
            kind: what it was measured by, which has errors of its own.
            covariance: [6, 6] of the motion as the images say.
            factor: by which the errors of its kind are larger than usual.
        """
        own = np.diag(np.repeat(np.square(factor * np.array(_DEVIATIONS[kind])), 3))
        return cls(first, second, T, inverse(own + covariance), _LIMITS[kind], kind=kind)


class Work(IntEnum):
    """What a task does: at most one alignment of two keyframes, or as much."""

    JOIN = 0  # align two keyframes of the window
    CLOSE = 1  # align two keyframes that are long apart
    LOOK = 2  # find keyframes that show the same features
    COMPARE = 3  # match the features of two keyframes
    RETURN = 4  # align two keyframes that are long apart the other way round, which confirms a loop


@dataclass(frozen=True, slots=True, eq=False)
class Task:
    """Work that waits for a frame that has time for it.

    Attributes:
        work: what is to be done.
        first: number of a node; of LOOK it is that of the second.
        second: number of the node that came later.
        T_second_first: [4, 4] where alignment starts: camera of the first to camera of the second; of RETURN what was found.
        covariance: [6, 6] of RETURN: that of what was found.
    """

    work: Work
    first: int
    second: int
    T_second_first: Matrix
    covariance: Matrix = field(default_factory=lambda: np.zeros((6, 6)))


def size(T: Matrix) -> float:
    """Returns how far motions [..., 4, 4] move or turn at most: m or rad, whichever is more."""
    twists = motions.log(T)
    return float(np.linalg.norm(twists.reshape(*twists.shape[:-1], 2, 3), axis=-1).max(initial=0.0))


def contradictions(links: Sequence[Link], T_world_cam: Mapping[int, Matrix]) -> Matrix:
    """Returns the twists [L, 6] by which poses [4, 4], by node, contradict links."""
    measured = np.array([link.T_first_second for link in links]).reshape(-1, 4, 4)
    ends = [np.array([T_world_cam[node] for node in nodes]).reshape(-1, 4, 4) for nodes in _ends(links)]
    return motions.log(se3.inverse(measured) @ motions.between(*ends))


def deviations(links: Sequence[Link], T_world_cam: Mapping[int, Matrix]) -> Matrix:
    """Returns [L, 2] by how many of the deviations of their kinds poses [4, 4], by node, contradict links: position, rotation."""
    lengths = np.linalg.norm(contradictions(links, T_world_cam).reshape(-1, 2, 3), axis=2)
    return lengths / np.array([_DEVIATIONS[link.kind] for link in links]).reshape(-1, 2)


def _ends(links: Sequence[Link]) -> tuple[list[int], list[int]]:
    return [link.first for link in links], [link.second for link in links]


def inverse(covariance: Matrix) -> Matrix:
    """Returns the information [6, 6] of a covariance, or the other way round."""
    return np.linalg.inv(covariance).astype(np.float64, copy=False)


def renumbered(links: Sequence[Link], nodes: Sequence[int]) -> list[Edge]:
    """Returns links as edges between the places of their nodes in a list."""
    place = {node: index for index, node in enumerate(nodes)}
    return [Edge(place[link.first], place[link.second], link.T_first_second, link.information, link.limit) for link in links]


def parts(count: int, edges: Sequence[Edge]) -> NDArray[np.intp]:
    """Returns [N] for each of so many poses the first pose that edges connect it to, over any number of others."""
    before = list(range(count))  # an earlier pose of the same part; itself where there is none

    def first_of(pose: int) -> int:
        while before[pose] != pose:
            before[pose] = before[before[pose]]
            pose = before[pose]
        return pose

    for edge in edges:
        ends = first_of(edge.first), first_of(edge.second)
        before[max(ends)] = min(ends)
    return np.array([first_of(pose) for pose in range(count)], dtype=np.intp)


def brought_together(T_world_cam: Matrix, edges: Sequence[Edge], part: NDArray[np.intp]) -> Matrix:
    """Returns poses [N, 4, 4], of which the parts [N] that lie far from where an edge says are moved there as a whole."""
    result, done = T_world_cam.copy(), {0}
    if not part.any():
        return result
    for edge in sorted(edges, key=lambda edge: max(edge.first, edge.second)):
        ends = [int(part[edge.first]), int(part[edge.second])]
        if ends[0] == ends[1] or (ends[0] in done) == (ends[1] in done):
            continue
        place = result[edge.first] @ edge.T_first_second @ se3.inverse(result[edge.second])
        late, motion = (ends[1], place) if ends[0] in done else (ends[0], se3.inverse(place))
        done.add(late)
        if np.linalg.norm(motions.log(motion)[:3]) > _FAR_M:
            result[part == late] = motion @ result[part == late]
    return result
