"""The keyframe graph: joins keyframes by measured motions, recognises places seen before, and says how to correct the map.

An edge of the odometry joins two keyframes as they were tracked in one and the same state of the map: the earlier one after
what was corrected when it was added, the later one before anything is. So a correction never enters a measurement.

The work of a keyframe is divided among it and the two frames after it, so that no frame takes long: places near the camera are
looked for at once, others with the first of these frames, and poses are optimised with the second. That frame becomes a node,
too, for as long as it takes to correct the map at it.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatam_core.config import SlamConfig
from splatam_core.geometry import motions, se3
from splatam_core.geometry.se3 import Matrix
from splatam_core.graph.corrections import Corrections
from splatam_core.graph.nodes import Nodes
from splatam_core.graph.pairs import PairAligner, PairResult
from splatam_core.graph.places import Places
from splatam_core.graph.pose_graph import Edge, PoseGraph, Solution, optimize
from splatam_core.mapping.keyframes import overlaps, sample_points
from splatam_core.mapping.posed import PosedView
from splatam_core.tracking.aligner import Aligner
from splatam_core.types import Arrays, GraphSummary

_log = logging.getLogger(__name__)

WINDOW = 1, 2
"""A keyframe is aligned directly to those so many before it: farther apart the odometry is better."""

_LIMIT = 60.0  # of the squared error of an edge, in standard deviations of six numbers
_LEAST_WEIGHT = 0.3  # that the others leave a loop
_MAX_BACK = 0.02, 0.015  # m, rad: there and back
_LEAST_OVERLAP, _LEAST_AGREEMENT = 0.3, 0.9
_MAX_SURPRISE = 0.05  # m and rad: a pair in the window that is farther from the odometry is wrong
_CANDIDATES = 2  # places compared per keyframe
_LOOK_EVERYWHERE = 2  # keyframes from one search by features to the next, where no place is found near the camera
_LEAST_EXPLAINED = 0.6  # of the view, by a loop
_LARGE = 0.15  # m and rad: a correction by more needs two loops
_SAME = 0.1  # m and rad: loops that correct alike
_GAP_TO_FOUND = 10.0  # keyframes: to a place that was recognised the map says how it lies, with all drift since it was seen
_SAMPLES = 200
_MARGIN = 0.03  # of the width


_LINK_ARRAYS = 'T_first_second', 'information', 'limits', 'kinds'
_SINGLE_ARRAYS = 'T_world_odom', 'num_corrections', 'look_at', 'last_correction_m', 'is_interrupted'


class Kind(IntEnum):
    """What an edge was measured by."""

    ODOMETRY = 0
    WINDOW = 1
    LOOP = 2
    PENDING = 3  # a loop that no other one confirms yet
    FOUND = 4  # a loop that nobody has compared with the graph yet


_DEVIATIONS = {Kind.ODOMETRY: (0.008, 0.004), Kind.WINDOW: (0.005, 0.003), Kind.LOOP: (0.012, 0.008)}
"""Errors (m, rad) that images do not show, such as those of calibration; from one keyframe to the next, or of a loop."""


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
        return cls(first, second, T, _inverse(own + covariance), np.inf if kind is Kind.ODOMETRY else _LIMIT, kind=kind)


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFrame:
    """A frame whose pose may be trusted.

    Attributes:
        index: its number.
        stamp_ns: its stamp.
        T_world_cam: [4, 4] as it was tracked.
        covariance: [6, 6] of that, as a twist in the camera's axes; zeros where it is not known.
        is_found: True if the camera was lost before and has been found anew, so that the way to here is not known.
    """

    index: int
    stamp_ns: int
    T_world_cam: Matrix
    covariance: Matrix
    is_found: bool = False


class KeyframeGraph:
    """Keyframes as nodes, measured motions as edges.

    Attributes:
        nodes: where the keyframes are.
        num_corrections: number of times that poses and map were corrected.
        T_world_odom: [4, 4] all corrections of the newest pose so far.
    """

    nodes: Nodes
    _active: list[int]  # numbers of the nodes that edges connect
    _links: list[Link]
    _look_at: int | None  # node to be looked for anywhere with the next frame
    _is_interrupted: bool  # frames were left out before the next one

    def __init__(self, config: SlamConfig, aligner: Aligner[Any] | None) -> None:
        """Begins without keyframes.

        Args:
            config: every setting.
            aligner: for images in the host's memory; None = there is no graph.
        """
        self._aligner = aligner
        self.num_corrections, self._last_correction_m = 0, 0.0
        self.rest()
        self.T_world_odom: Matrix = np.eye(4)
        self.configure(config)

    def configure(self, config: SlamConfig) -> None:
        """Uses other settings from the next keyframe on."""
        self._config, self._seed, self._every = config.graph, config.seed, config.keyframes.every
        self._pairs = PairAligner(self._aligner, config.tracking) if self._aligner is not None else None

    @property
    def is_used(self) -> bool:
        """Whether keyframes are added."""
        return self._config.enabled and self._pairs is not None

    @property
    def num_loops(self) -> int:
        """Number of places that were recognised."""
        return len(self.loops())

    @property
    def summary(self) -> GraphSummary:
        """What it holds now."""
        return GraphSummary(len(self._active), self.num_loops, self.num_corrections, self._last_correction_m)

    def loops(self) -> list[Link]:
        """Returns the links to places that were recognised."""
        return [link for link in self._links if link.kind is Kind.LOOP]

    def pairs(self, *, loops: bool) -> NDArray[np.intp]:
        """Returns [E, 2] the numbers of the nodes that loops, or all other edges, connect."""
        kinds = (Kind.LOOP,) if loops else (Kind.ODOMETRY, Kind.WINDOW)
        pairs = [(link.first, link.second) for link in self._links if link.kind in kinds]
        return np.array(pairs, dtype=np.intp).reshape(-1, 2)

    def follow(self, frame: TrackedFrame, keyframes: Sequence[PosedView], places: Places | None = None) -> Corrections | None:
        """Goes on with the work after a tracked frame, which may be a new keyframe.

        Args:
            frame: it.
            keyframes: all, the newest last.
            places: the keyframes, to be recognised wherever the camera seems to be; None = it is looked for nearby only.

        Returns:
            How poses and map are to be corrected; None if they are to stay.
        """
        by_frame = {keyframe.frame: keyframe for keyframe in keyframes}
        if frame.index in by_frame:
            self._look_at = None
            self._add(frame)
            self._take_out_dropped(by_frame)
            self._join_window(len(self.nodes) - 1, by_frame)
            self._find_nearby(len(self.nodes) - 1, by_frame)
        elif frame.is_found or self._is_interrupted:
            self._add(frame)
        elif self._look_at is not None and places is not None:
            node, self._look_at = self._look_at, None
            self._find_anywhere(node, by_frame, places)
        elif found := [link for link in self._links if link.kind is Kind.FOUND]:
            self._links = [link for link in self._links if link.kind is not Kind.FOUND]
            return self._close(found, frame)
        return None

    def _add(self, frame: TrackedFrame) -> None:
        """Adds a node, and joins it to the one before."""
        if len(self.nodes) and frame.stamp_ns <= self.nodes.stamps_ns[-1]:
            self.rest()
        is_far = frame.is_found or self._is_interrupted
        node, self._is_interrupted = len(self.nodes), False
        self.nodes = self.nodes.added(frame.index, frame.stamp_ns, frame.T_world_cam)
        self._active.append(node)
        if not node:
            return
        step = motions.between(self.nodes.placed[node - 1], frame.T_world_cam)
        gap = (frame.index - int(self.nodes.frames[node - 1])) / self._every
        gap = max(gap, _GAP_TO_FOUND) if is_far else gap
        self._links.append(Link.measured(node - 1, node, step, Kind.ODOMETRY, frame.covariance, gap))

    def _take_out_dropped(self, by_frame: dict[int, PosedView]) -> None:
        """Takes out the nodes that have no images, but neither the first nor the last."""
        for node in [node for node in self._active[1:-1] if int(self.nodes.frames[node]) not in by_frame]:
            self._merge(node)

    def settle(self, newest: TrackedFrame | None) -> Corrections | None:
        """Returns how poses and map are corrected so that they agree best with all edges; None without a loop.

        Without one the odometry is as good: it is measured against a map of many frames.

        Args:
            newest: the last frame, at which map and poses are corrected; it becomes a node. None = the last node.
        """
        if not self.num_loops:
            return None
        self._extend(newest)
        return self._corrections(self._optimized(self._sure()))

    def _extend(self, newest: TrackedFrame | None) -> None:
        """Adds the last frame, if it comes after the last node: what is corrected there moves the frames before it as well."""
        if newest is not None and len(self.nodes) and newest.index > self.nodes.frames[-1]:
            self._add(newest)

    def _sure(self) -> list[Link]:
        return [link for link in self._links if link.kind not in (Kind.PENDING, Kind.FOUND)]

    def _join_window(self, node: int, by_frame: dict[int, PosedView]) -> None:
        """Measures the motions from the keyframes shortly before."""
        for gap in WINDOW:
            if gap >= len(self._active):
                break
            before = self._active[-1 - gap]
            expected = motions.between(self.nodes.T_world_cam[node], self.nodes.T_world_cam[before])
            found = self._aligned(before, node, by_frame, expected)
            if found is None or np.abs(motions.log(found.T_second_first @ se3.inverse(expected))).max() > _MAX_SURPRISE:
                continue
            T, covariance = se3.inverse(found.T_second_first), found.weigh().covariance
            self._links.append(Link.measured(before, node, T, Kind.WINDOW, covariance, node - before))

    def _old(self, node: int, by_frame: dict[int, PosedView]) -> list[int]:
        """Returns the nodes of places that were mapped long ago."""
        frames = self.nodes.frames
        return [n for n in self._active if frames[n] in by_frame and frames[n] <= frames[node] - self._config.loop_after]

    def _find_nearby(self, node: int, by_frame: dict[int, PosedView]) -> None:
        """Finds loops to places that were mapped long ago, as seen from where the camera seems to be."""
        frames, old = self.nodes.frames, self._old(node, by_frame)
        if not old:
            return
        now = by_frame[int(frames[node])]
        points = sample_points(now, _SAMPLES, np.random.default_rng([self._seed, int(frames[node])]))
        seen = np.array(
            overlaps(points, now.view.camera, [by_frame[int(frames[n])] for n in old], round(_MARGIN * now.view.camera.width))
        )
        is_found = False
        for index in np.argsort(-seen, kind='stable')[:_CANDIDATES]:
            if seen[index] < _LEAST_OVERLAP:
                break
            expected = motions.between(self.nodes.T_world_cam[node], self.nodes.T_world_cam[old[index]])
            is_found |= self._find_loop(old[index], node, by_frame, expected)
        if not is_found and int(frames[node]) // self._every % _LOOK_EVERYWHERE == 0:
            self._look_at = node

    def _find_anywhere(self, node: int, by_frame: dict[int, PosedView], places: Places) -> None:
        """Finds loops to places that show the same features, wherever they are."""
        number = {int(self.nodes.frames[n]): n for n in self._old(node, by_frame)}
        if not number:
            return
        view = by_frame[int(self.nodes.frames[node])].view
        exclude = [frame for frame in by_frame if frame not in number]
        for place in places.find(view, 1, exclude):
            self._find_loop(number[place.keyframe], node, by_frame, place.T_cam_keyframe)

    def _find_loop(self, first: int, second: int, by_frame: dict[int, PosedView], T_second_first: Matrix) -> bool:
        """Adds the loop between two nodes that their images show, aligned from a motion [4, 4]; returns False if it is not sure."""
        there = self._aligned(first, second, by_frame, T_second_first, and_back=True)
        if there is None or (evidence := there.weigh()).explained < _LEAST_EXPLAINED:
            return False
        loop = Link.measured(first, second, se3.inverse(there.T_second_first), Kind.LOOP, evidence.covariance)
        self._links.append(replace(loop, kind=Kind.FOUND))
        return True

    def _aligned(
        self, first: int, second: int, by_frame: dict[int, PosedView], T_second_first: Matrix, *, and_back: bool = False
    ) -> PairResult | None:
        """Aligns the images of two nodes, starting at a motion [4, 4]; returns None if the result is not sure."""
        views = [by_frame.get(int(self.nodes.frames[node])) for node in (first, second)]
        if views[0] is None or views[1] is None or self._pairs is None:
            return None
        there = self._pairs.align(views[0].view, views[1].view, T_second_first)
        if there.overlap < _LEAST_OVERLAP or there.agreement < _LEAST_AGREEMENT:
            return None
        if and_back and not all(np.array(self._pairs.way_back(views[0].view, views[1].view, there)) <= _MAX_BACK):
            return None
        return there

    def _close(self, found: Sequence[Link], frame: TrackedFrame) -> Corrections | None:
        """Adds loops, as far as they agree with the graph; returns the correction if they disagree with the present poses.

        Args:
            found: the loops.
            frame: at which map and poses are corrected; it becomes a node.
        """
        loops = [one for loop in found for one in self._confirmed(replace(loop, kind=Kind.LOOP))]
        if not any(self._off(loop) > self._config.min_correction_m for loop in loops):
            self._links += loops
            return None
        self._add(frame)
        links = [*self._sure(), *loops]
        solution = self._optimized(links)
        agreeing = [link for link, weight in zip(links, solution.weights) if link.kind is not Kind.LOOP or weight >= _LEAST_WEIGHT]
        if len(agreeing) < len(links):
            _log.info('%d loops contradict the graph at frame %d', len(links) - len(agreeing), self.nodes.frames[-1])
            solution = self._optimized(agreeing)
        self._links = [link for link in self._links if link.kind is Kind.PENDING] + agreeing
        return self._corrections(solution) if any(loop is link for loop in loops for link in agreeing) else None

    def _off(self, loop: Link) -> float:
        """Returns by how much a loop would move its second node: m or rad, whichever is more."""
        T = self.nodes.T_world_cam
        return _size(se3.inverse(loop.T_first_second) @ motions.between(T[loop.first], T[loop.second]))

    def _moved(self, loop: Link) -> Matrix:
        """Returns the motion [4, 4] of the world by which a loop would move its second node."""
        T = self.nodes.T_world_cam
        return T[loop.first] @ loop.T_first_second @ se3.inverse(T[loop.second])

    def _confirmed(self, loop: Link) -> list[Link]:
        """Returns a loop, if it changes little or another one says the same, and then with that one; else it waits for one."""
        if self._off(loop) <= _LARGE:
            return [loop]
        T = self.nodes.T_world_cam[loop.second]
        alike = [
            other for other in self._links
            if other.kind is Kind.PENDING and other.second != loop.second
            and _size(se3.inverse(self._moved(other) @ T) @ self._moved(loop) @ T) < _SAME
        ]  # fmt: skip
        self._links = [link for link in self._links if not any(link is other for other in alike)]
        if alike:
            return [*(replace(other, kind=Kind.LOOP) for other in alike), loop]
        self._links.append(replace(loop, kind=Kind.PENDING))
        return []

    def _optimized(self, links: Sequence[Link]) -> Solution:
        number = np.full(len(self.nodes), -1)
        number[self._active] = np.arange(len(self._active))
        renumbered = [replace(edge, first=int(number[edge.first]), second=int(number[edge.second])) for edge in links]
        return optimize(PoseGraph.of(self.nodes.T_world_cam[self._active], renumbered))

    def _corrections(self, solution: Solution) -> Corrections:
        T_last, T_before = self.nodes.T_world_cam[-1], self.nodes.T_world_cam[self._active]
        corrections = Corrections.between(self.nodes.frames[self._active], T_before, solution.T_world_cam)
        T_world_cam = corrections.at(self.nodes.frames) @ self.nodes.T_world_cam
        T_world_cam[self._active] = solution.T_world_cam
        self.nodes = self.nodes.moved(T_world_cam)
        self.num_corrections += 1
        self._last_correction_m = float(np.linalg.norm(T_world_cam[-1, :3, 3] - T_last[:3, 3]))
        self.T_world_odom = corrections.motions[-1] @ self.T_world_odom
        return corrections

    def _merge(self, node: int) -> None:
        """Takes a node out, because its images are gone. The nodes beside it are joined, and take over its loops."""
        place = self._active.index(node)
        before, after = self._active[place - 1], self._active[place + 1]
        self._active.remove(node)
        T, links, covariance = self.nodes.T_world_cam, self._links, np.zeros((6, 6))
        self._links = []
        for link in links:
            if node not in (link.first, link.second):
                self._links.append(link)
            elif link.kind is Kind.ODOMETRY:
                covariance += _inverse(link.information)
            elif link.kind is not Kind.WINDOW and before not in (link.first, link.second):
                step, is_first = motions.between(T[before], T[node]), link.first == node
                motion = step @ link.T_first_second if is_first else link.T_first_second @ se3.inverse(step)
                first, second = (before, link.second) if is_first else (link.first, before)
                self._links.append(replace(link, first=first, second=second, T_first_second=motion))
        self._links.append(Link(before, after, motions.between(T[before], T[after]), _inverse(covariance)))

    def rest(self) -> None:
        """Begins anew with the next keyframe, because time does; the map stays where it is."""
        self.nodes = Nodes()
        self._active, self._links, self._look_at = [], [], None
        self._is_interrupted = False

    def interrupt(self, newest: TrackedFrame | None) -> None:
        """Goes on after frames were left out: the way to the next tracked frame is not known, but what was measured stays.

        Args:
            newest: the last frame before that; None = the last node.
        """
        self._extend(newest)
        self._look_at, self._is_interrupted = None, True

    def drop_from(self, frame: int) -> None:
        """Forgets the keyframes of the frames from a number on."""
        self.nodes = self.nodes.before(frame)
        self._active = [node for node in self._active if node < len(self.nodes)]
        self._links = [link for link in self._links if max(link.first, link.second) < len(self.nodes)]
        self._look_at = None
        last = len(self.nodes) - 1
        if self._active and self._active[-1] < last:  # it was merged into a node that is gone; the next frame is joined to it
            before = self._active[-1]
            step, gap = motions.between(*self.nodes.T_world_cam[[before, last]]), np.diff(self.nodes.frames[[before, last]])[0]
            self._links.append(Link.measured(before, last, step, Kind.ODOMETRY, np.zeros((6, 6)), float(gap) / self._every))
            self._active.append(last)

    def corrected(self, stamps_ns: NDArray[np.int64], T_world_cam: Matrix) -> Matrix:
        """Returns poses [M, 4, 4] of frames, as they were published, after all corrections."""
        return self.nodes.corrected(stamps_ns, T_world_cam)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Returns everything that later frames depend on, by name."""
        graph = PoseGraph.of(self.nodes.T_world_cam, self._links)
        return {
            **{name: getattr(self.nodes, name) for name in Nodes.__dataclass_fields__},
            'active': np.array(self._active, dtype=np.int64),
            'pairs': graph.pairs.astype(np.int64),
            'T_first_second': graph.T_first_second,
            'information': graph.information,
            'limits': graph.limits,
            'kinds': np.array([link.kind for link in self._links], dtype=np.int64),
            'T_world_odom': self.T_world_odom,
            'num_corrections': np.array(self.num_corrections),
            'is_interrupted': np.array(self._is_interrupted),
            'look_at': np.array(-1 if self._look_at is None else self._look_at),
            'last_correction_m': np.array(self._last_correction_m),
        }

    def restore(self, arrays: Arrays) -> None:
        """Continues from the state of another graph; from nothing where there is none, as before 0.3.

        Raises:
            ValueError: the arrays are not those of a graph.
        """
        if not arrays:
            return
        expected = KeyframeGraph.arrays(self)
        if broken := [name for name in expected if arrays.get(name) is None or arrays[name].dtype != expected[name].dtype]:
            raise ValueError(f'graph: {", ".join(broken)} is missing or of another type')
        if broken := [name for name in expected if name != 'limits' and not np.isfinite(arrays[name]).all()]:
            raise ValueError(f'graph: the numbers in {", ".join(broken)} are not finite')
        num_nodes, num_links = len(arrays['frames']), len(arrays['kinds'])
        shapes = {name: (num_nodes, *expected[name].shape[1:]) for name in Nodes.__dataclass_fields__}
        shapes |= {name: (num_links, *expected[name].shape[1:]) for name in ('pairs', *_LINK_ARRAYS)}
        shapes |= {name: expected[name].shape for name in _SINGLE_ARRAYS}
        if broken := [name for name, shape in shapes.items() if arrays[name].shape != shape]:
            raise ValueError(f'graph: {", ".join(broken)} has the wrong shape')
        numbers = np.concatenate([arrays['pairs'].ravel(), arrays['active']])
        if arrays['look_at'] >= num_nodes or (len(numbers) and not 0 <= numbers.min() <= numbers.max() < num_nodes):
            raise ValueError(f'graph: pairs, active or look_at name nodes that are not among its {num_nodes}')
        self.nodes = Nodes(**{name: arrays[name] for name in Nodes.__dataclass_fields__})
        self._active, self._is_interrupted = arrays['active'].tolist(), bool(arrays['is_interrupted'])
        self._look_at = None if arrays['look_at'] < 0 else int(arrays['look_at'])
        columns = [arrays[name] for name in ('pairs', *_LINK_ARRAYS)]
        self._links = [
            Link(int(first), int(second), T, information, float(limit), kind=Kind(kind))
            for (first, second), T, information, limit, kind in zip(*columns, strict=True)
        ]
        self.T_world_odom, self.num_corrections = arrays['T_world_odom'], int(arrays['num_corrections'])
        self._last_correction_m = float(arrays['last_correction_m'])


def _size(T: Matrix) -> float:
    """Returns how far a motion [4, 4] moves or turns: m or rad, whichever is more."""
    return float(np.linalg.norm(motions.log(T).reshape(2, 3), axis=1).max())


def _inverse(covariance: Matrix) -> Matrix:
    return np.linalg.inv(covariance).astype(np.float64, copy=False)
