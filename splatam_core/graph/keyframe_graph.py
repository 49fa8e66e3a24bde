"""The keyframe graph: joins keyframes by measured motions, recognises places seen before, and says how to correct the map.

An edge of the odometry joins two keyframes as they were tracked in one and the same state of the map: the earlier one after
what was corrected when it was added, the later one before anything is. So a correction never enters a measurement.

The work of a keyframe waits in a queue, from which each frame takes a bounded part, and poses are optimised a few steps a frame.
So no frame takes long, and the same frames do the same work. The frame at which the optimisation ends becomes a node, too, for as
long as it takes to correct the map at it.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatam_core.config import SlamConfig
from splatam_core.geometry import motions, se3
from splatam_core.geometry.se3 import Matrix
from splatam_core.graph.corrections import Corrections
from splatam_core.graph.links import (
    Kind,
    Link,
    Task,
    Work,
    brought_together,
    contradictions,
    deviations,
    inverse,
    parts,
    renumbered,
    size,
)
from splatam_core.graph.nodes import Nodes
from splatam_core.graph.pairs import PairAligner, PairResult, Shot
from splatam_core.graph.places import Places
from splatam_core.graph.pose_graph import Optimizer, OptimizerState, PoseGraph
from splatam_core.graph.schedule import GraphSchedule
from splatam_core.mapping.keyframes import overlaps, sample_points
from splatam_core.mapping.posed import PosedView
from splatam_core.tracking.aligner import Aligner
from splatam_core.tracking.read_motion import STILL, ReadMotion
from splatam_core.types import Arrays, GraphSummary

_log = logging.getLogger(__name__)

WINDOW = 1, 2
"""A keyframe is aligned directly to those so many before it: farther apart the odometry is better."""

_MOST_WRONG = 4.0  # deviations of a loop, by which the optimised graph contradicts it at most: 8 cm
_LEAST_DRIFT = 0.85  # of the squared disagreement of loops, in their deviations, that a correction takes away
_MAX_BACK = 0.02, 0.015  # m, rad: there and back
_LEAST_OVERLAP, _LEAST_AGREEMENT = 0.3, 0.9
_MAX_SURPRISE = 0.05  # m and rad: a pair in the window that is farther from the odometry is wrong
_CANDIDATES = 2  # places compared per keyframe
_LOOKS_ALIKE = 4  # places whose features are compared with those of a keyframe
_LEAST_EXPLAINED = 0.6  # of the view, by a loop
_SAME = 0.03, 0.1  # m and rad: loops that correct alike differ by less than half of the correction, within these limits
_GAP_TO_FOUND = 10.0  # keyframes: to a place that was recognised the map says how it lies, with all drift since it was seen
_SAMPLES = 200
_MARGIN = 0.03  # of the width
_TASKS_PER_KEYFRAME = 5  # about what a keyframe needs
_MOST_TASKS = 6  # that wait; beyond it, places near the camera are not compared
_NODES_PER_FRAME, _MOST_STEPS = 150, 4  # of an optimisation: so many nodes are moved by a step, or less; at most so many steps
_AGREES = 0.5  # of the least correction, by which a loop that says nothing new is off
_MOST_LOOPS = 10  # of a keyframe that takes over those of another one: a place seen for hours has no more than one seen twice

_NO_POSES = np.empty((0, 4, 4))
_TASK_ARRAYS = 'tasks', 'task_motions', 'task_covariances'
_LINK_ARRAYS = 'T_first_second', 'information', 'limits', 'kinds'
_SINGLE_ARRAYS = 'T_world_odom', 'num_corrections', 'last_correction_m', 'is_interrupted', 'solving', 'solving_widths', 'schedule'


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFrame:
    """A frame whose pose may be trusted.

    Attributes:
        index: its number.
        stamp_ns: its stamp.
        T_world_cam: [4, 4] as it was tracked.
        covariance: [6, 6] of that, as a twist in the camera's axes; zeros where it is not known.
        found_at: number of the keyframe by which a camera that was lost has been found anew, so that the way to here is not known;
            negative if it is no node; None = it was not lost.
        begins: True if a new map begins here, of which nobody knows how it lies to the old one.
        motion: of the camera while it took the frame.
    """

    index: int
    stamp_ns: int
    T_world_cam: Matrix
    covariance: Matrix
    found_at: int | None = None
    begins: bool = False
    motion: ReadMotion = STILL


@dataclass(frozen=True, slots=True, eq=False)
class _Solving:
    """An optimisation that goes on.

    Attributes:
        optimizer: takes the steps.
        num_nodes: number of active nodes that take part: the first ones.
        num_links: number of links of which those that are sure take part: the first ones.
        is_second: True after loops that contradict the others were left out.
    """

    optimizer: Optimizer
    num_nodes: int
    num_links: int
    is_second: bool = False


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
    _found: list[Link]  # loops that nobody has compared with the graph yet
    _tasks: list[Task]  # what is still to be measured
    _solving: _Solving | None  # the optimisation that goes on
    _schedule: GraphSchedule  # when loops are looked for
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

    def configure(self, config: SlamConfig, aligner: Aligner[Any] | None = None) -> None:
        """Uses other settings from the next keyframe on.

        Args:
            config: every setting.
            aligner: for images in the host's memory, where the graph is switched on only now; None = as before.
        """
        self._aligner = aligner or self._aligner
        self._config, self._seed, self._every = config.graph, config.seed, config.keyframes.every
        self._tasks_per_frame = -(-_TASKS_PER_KEYFRAME // self._every)
        self._pairs = PairAligner(self._aligner, config.tracking) if self._aligner is not None else None

    @property
    def is_used(self) -> bool:
        """Whether keyframes are added."""
        return self._config.enabled and self._pairs is not None

    @property
    def lacks_aligner(self) -> bool:
        """Whether it was made without one."""
        return self._aligner is None

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

    def load(self, keyframes: Sequence[PosedView]) -> None:
        """Begins with the keyframes of a map that was loaded, which stay where they are: loops to them correct what comes.

        Args:
            keyframes: with negative numbers, increasing.
        """
        self.rest()
        for keyframe in keyframes if self.is_used else ():
            T_world_cam = se3.inverse(keyframe.T_cam_world.double().numpy(force=True))
            self._active.append(len(self.nodes))
            self.nodes = self.nodes.added(keyframe.frame, keyframe.frame, T_world_cam)

    def follow(self, frame: TrackedFrame, keyframes: Sequence[PosedView], places: Places | None = None) -> Corrections | None:
        """Goes on with the work after a tracked frame, which may be a new keyframe.

        Args:
            frame: it.
            keyframes: all, the newest last.
            places: the keyframes, to be recognised wherever the camera seems to be; None = it is looked for nearby only.

        Returns:
            How poses and map are to be corrected; None if they are to stay.
        """
        is_keyframe = bool(keyframes) and keyframes[-1].frame == frame.index
        by_frame = {keyframe.frame: keyframe for keyframe in keyframes} if is_keyframe or self._tasks else {}
        if is_keyframe:
            self._add(frame)
            if self._solving is None:
                self._accept()
                self._take_out_dropped(by_frame)
            self._plan(len(self.nodes) - 1, by_frame)
        elif frame.found_at is not None or self._is_interrupted:
            self._add(frame)
        is_to_solve = self._is_time_to_solve(frame.index)
        self._measure(by_frame, places, self._tasks_per_frame - is_to_solve)
        if is_to_solve:
            return self._solve(frame)
        if self._solving is None:
            self._accept()
        return None

    def _add(self, frame: TrackedFrame) -> None:
        """Adds a node, and joins it to the one before."""
        if len(self.nodes) and frame.stamp_ns <= self.nodes.stamps_ns[-1]:
            self.rest()
        is_far, node = frame.found_at is not None or self._is_interrupted, len(self.nodes)
        if is_far or frame.begins:
            self._schedule = GraphSchedule(is_apart=frame.begins or self._schedule.is_apart)
        self._is_interrupted = False
        self.nodes = self.nodes.added(frame.index, frame.stamp_ns, frame.T_world_cam, frame.motion)
        self._active.append(node)
        if not node or frame.begins or self.nodes.frames[node - 1] < 0:
            return
        before, T_before = node - 1, self.nodes.placed[node - 1]
        gap = (frame.index - int(self.nodes.frames[before])) / self._every
        at = [n for n in self._active[:-1] if frame.found_at is not None and self.nodes.frames[n] == frame.found_at]
        if at:
            before, T_before = at[0], self.nodes.T_world_cam[at[0]]
        step, gap = motions.between(T_before, frame.T_world_cam), max(gap, _GAP_TO_FOUND) if is_far else gap
        self._links.append(Link.measured(before, node, step, Kind.ODOMETRY, frame.covariance, gap))

    def _take_out_dropped(self, by_frame: dict[int, PosedView]) -> None:
        """Takes out the nodes that have no images, where the way leads on from the one before to the one after.

        Those at which the camera was lost, or found elsewhere, stay: what is beside them moves with them.
        """
        frames = self.nodes.frames[self._active].tolist()
        if all(frame in by_frame for frame in frames[1:-1]):
            return
        ways = {(link.first, link.second) for link in self._links if link.kind is Kind.ODOMETRY}
        for before, node, after in list(zip(self._active, self._active[1:], self._active[2:])):
            if int(self.nodes.frames[node]) not in by_frame and {(before, node), (node, after)} <= ways:
                self._merge(node)

    def settle(self, newest: TrackedFrame | None) -> Corrections | None:
        """Returns how poses and map are corrected so that they agree best with all edges; None without a loop.

        Without one the odometry is as good: it is measured against a map of many frames.

        Args:
            newest: the last frame, at which map and poses are corrected; it becomes a node. None = the last node.
        """
        self._solving = None
        self._accept()
        if not self.num_loops:
            return None
        self._extend(newest)
        self._begin_solving()
        while (solution := self._solved()) is None:
            pass
        is_worth_it = self.num_loops and self._is_drift(self._active, solution)
        return self._corrections(solution, self._active) if is_worth_it else None

    def _extend(self, newest: TrackedFrame | None) -> None:
        """Adds the last frame, if it comes after the last node: what is corrected there moves the frames before it as well."""
        if newest is not None and len(self.nodes) and newest.index > self.nodes.frames[-1]:
            self._add(newest)

    def _plan(self, node: int, by_frame: dict[int, PosedView]) -> None:
        """Queues what is to be measured about a new keyframe."""
        frame = int(self.nodes.frames[node])
        for before in [self._active[-1 - gap] for gap in WINDOW if gap < len(self._active)]:
            self._queue(Work.JOIN, before, node)
        is_near_due, room = frame >= self._schedule.near_from, max(0, _MOST_TASKS - len(self._tasks)) // 2  # there and back
        if (is_near_due or self._schedule.is_apart) and (old := self._old(node, by_frame)):
            for place in self._nearby(node, old, by_frame)[:room] if is_near_due and room else ():
                self._queue(Work.CLOSE, place, node)
            if frame >= self._schedule.anywhere_from and room:
                self._queue(Work.LOOK, node, node)
                self._schedule = self._schedule.looked(frame, self._every)
        self._tasks.sort(key=lambda task: task.work is not Work.JOIN)  # what holds keyframes together comes first

    def _queue(self, work: Work, first: int, second: int) -> None:
        T = self.nodes.T_world_cam
        self._tasks.append(Task(work, first, second, motions.between(T[second], T[first])))

    def _measure(self, by_frame: dict[int, PosedView], places: Places | None, most_tasks: int) -> None:
        """Does as much of the work that waits as a frame has time for."""
        while most_tasks > 0 and self._tasks:
            task = self._tasks.pop(0)
            most_tasks -= task.work is not Work.LOOK  # which takes little
            if task.work is Work.JOIN:
                self._join(task, by_frame)
            elif task.work is Work.CLOSE:
                self._find_loop(task, by_frame)
            elif task.work is Work.RETURN:
                self._return(task, by_frame)
            elif places is not None and task.work is Work.LOOK:
                self._look(task.second, by_frame, places)
            elif places is not None:
                self._compare(task, by_frame, places)

    def _join(self, task: Task, by_frame: dict[int, PosedView]) -> None:
        """Measures the motion from a keyframe shortly before."""
        before, node = task.first, task.second
        expected = motions.between(self.nodes.T_world_cam[node], self.nodes.T_world_cam[before])
        found = self._aligned(before, node, by_frame, expected)
        if found is None or np.abs(motions.log(found.T_second_first @ se3.inverse(expected))).max() > _MAX_SURPRISE:
            return
        T, covariance = se3.inverse(found.T_second_first), found.weigh().covariance
        self._links.append(Link.measured(before, node, T, Kind.WINDOW, covariance, node - before))

    def _old(self, node: int, by_frame: dict[int, PosedView]) -> list[int]:
        """Returns the nodes of places that were mapped long ago."""
        frames, latest = self.nodes.frames[self._active].tolist(), int(self.nodes.frames[node]) - self._config.loop_after
        return [n for n, frame in zip(self._active, frames) if frame <= latest and frame in by_frame]

    def _nearby(self, node: int, old: list[int], by_frame: dict[int, PosedView]) -> list[int]:
        """Returns the old nodes that see most of what is seen from where the camera seems to be."""
        now = by_frame[int(self.nodes.frames[node])]
        points = sample_points(now, _SAMPLES, np.random.default_rng([self._seed, now.frame]))
        keyframes = [by_frame[frame] for frame in self.nodes.frames[old].tolist()]
        seen = np.array(overlaps(points, now.view.camera, keyframes, round(_MARGIN * now.view.camera.width)))
        return [old[index] for index in np.argsort(-seen, kind='stable')[:_CANDIDATES] if seen[index] >= _LEAST_OVERLAP]

    def _look(self, node: int, by_frame: dict[int, PosedView], places: Places) -> None:
        """Queues the comparison with places that show the same features, wherever they are, if none was found nearby.

        Otherwise with those of maps that lie beside this one until a place of both is recognised.
        """
        frame, old, tracks = int(self.nodes.frames[node]), self._old(node, by_frame), (Kind.ODOMETRY, Kind.WINDOW)
        if any(link.second == node and link.kind not in tracks for link in (*self._links, *self._found)):
            old = self._elsewhere(node, old)
        if not old or frame not in by_frame or frame not in places:
            return
        number = dict(zip(self.nodes.frames[old].tolist(), old))
        for place in places.alike(frame, list(number), _LOOKS_ALIKE):
            self._queue(Work.COMPARE, number[place], node)

    def _elsewhere(self, node: int, others: Sequence[int]) -> list[int]:
        """Returns those of other nodes that nothing joins to a node."""
        ways = {(link.first, link.second) for link in self._links if link.kind is Kind.ODOMETRY}
        own = [n for n in self._active if self.nodes.frames[n] >= 0]
        if set(pairwise(own)) <= ways:
            return []  # the camera was never lost
        part = dict(zip(self._active, parts(len(self._active), renumbered(self._sure(len(self._links)), self._active)).tolist()))
        num_loaded = len(self._active) - len(own)  # they are one map, although nothing joins them
        return [n for n in others if max(part[n], num_loaded) != max(part[node], num_loaded)]

    def _compare(self, task: Task, by_frame: dict[int, PosedView], places: Places) -> None:
        """Compares the features of two keyframes; aligns them next if they show the same."""
        first, second = self.nodes.frames[[task.first, task.second]].tolist()
        if second not in by_frame or first not in places or second not in places:
            return
        place = places.compare_keyframes(first, second, by_frame[second].view.camera)
        if place is not None:
            self._tasks.insert(0, replace(task, work=Work.CLOSE, T_second_first=place.T_cam_keyframe))

    def _find_loop(self, task: Task, by_frame: dict[int, PosedView]) -> None:
        """Aligns two nodes that are long apart; if their images may be a loop, the way back is measured next."""
        there = self._aligned(task.first, task.second, by_frame, task.T_second_first)
        if there is None or (evidence := there.weigh()).explained < _LEAST_EXPLAINED:
            return
        found = replace(task, work=Work.RETURN, T_second_first=there.T_second_first, covariance=evidence.covariance)
        self._tasks.insert(0, found)

    def _return(self, task: Task, by_frame: dict[int, PosedView]) -> None:
        """Adds a loop, if the way back agrees with the way there."""
        shots = self._shots(task.first, task.second, by_frame)
        if shots is None or self._pairs is None:
            return
        if (np.array(self._pairs.way_back(*shots, task.T_second_first)) > _MAX_BACK).any():
            return
        loop = Link.measured(task.first, task.second, se3.inverse(task.T_second_first), Kind.LOOP, task.covariance)
        self._found.append(replace(loop, kind=Kind.FOUND))
        self._tasks = [other for other in self._tasks if (other.work, other.second) != (Work.COMPARE, task.second)]  # one is enough

    def _aligned(self, first: int, second: int, by_frame: dict[int, PosedView], T_second_first: Matrix) -> PairResult | None:
        """Aligns the images of two nodes, starting at a motion [4, 4]; returns None if the result is not sure."""
        shots = self._shots(first, second, by_frame)
        if shots is None or self._pairs is None:
            return None
        there = self._pairs.align(*shots, T_second_first)
        return there if there.overlap >= _LEAST_OVERLAP and there.agreement >= _LEAST_AGREEMENT else None

    def _is_time_to_solve(self, frame: int) -> bool:
        """Returns whether a frame takes part in an optimisation in place of one task; of two frames at least one does."""
        is_joined = not self._tasks or self._tasks[0].work is not Work.JOIN
        is_due = self._schedule.is_disputed and is_joined
        return (self._solving is not None or is_due) and (not self._tasks or frame % 2 == 1)

    def _shots(self, first: int, second: int, by_frame: dict[int, PosedView]) -> tuple[Shot, Shot] | None:
        """Returns the images of two nodes, as one camera would show them; None if one's are gone."""
        one, other = (self._shot(node, by_frame, max(first, second)) for node in (first, second))
        if one is None or other is None:
            return None
        return replace(one, view=one.view.through(other.view.camera)), other  # that of a map that was loaded may be another one

    def _shot(self, node: int, by_frame: dict[int, PosedView], as_known_at: int) -> Shot | None:
        """Returns the images of a node, taken with the readout known at another; None if they are gone."""
        keyframe = by_frame.get(int(self.nodes.frames[node]))
        return None if keyframe is None else Shot(keyframe.view, self.nodes.motion(node, as_known_at))

    def _solve(self, frame: TrackedFrame) -> Corrections | None:
        """Begins an optimisation, or goes on with it.

        Args:
            frame: at which map and poses are corrected if the optimisation ends with it; it becomes a node.

        Returns:
            How they are corrected; None if they stay.
        """
        if self._solving is None:
            self._schedule = self._schedule.disputed(is_disputed=False)
            self._begin_solving()
            steps = _steps_per_frame(len(self._active)) - 1
        else:
            steps = _steps_per_frame(self._solving.num_nodes)
        assert self._solving is not None
        num_nodes, solution = self._solving.num_nodes, self._solved(steps)
        if solution is None:
            return None
        nodes, least = self._active[:num_nodes], self._config.min_correction_m
        disagrees = self._most_off() > least
        moves = size(motions.between(self.nodes.T_world_cam[nodes], solution)) > least
        if not (disagrees and moves and self._is_drift(nodes, solution)):
            return None
        self._extend(frame)
        return self._corrections(solution, nodes)

    def _accept(self) -> None:
        """Takes the loops that were found into the graph."""
        found, self._found = self._found, []
        loops = [one for loop in found for one in self._confirmed(replace(loop, kind=Kind.LOOP))]
        self._links += loops
        for loop in found:
            place, frame = self.nodes.frames[[loop.first, loop.second]].tolist()
            off, least = self._off(loop), self._config.min_correction_m
            if off > least:
                self._schedule = self._schedule.disagreed()
            elif off <= _AGREES * least:
                self._schedule = self._schedule.agreed(frame, place, self._every)
        if any(self._off(loop) > self._config.min_correction_m for loop in loops):
            self._schedule = self._schedule.disputed(is_disputed=True)

    def _begin_solving(self) -> None:
        self._solving = self._solving_from(None, len(self._active), len(self._links))

    def _solving_from(self, state: OptimizerState | None, num_nodes: int, num_links: int, *, is_second: bool = False) -> _Solving:
        """Returns the optimisation of the first nodes and links, from a state of it."""
        nodes = self._active[:num_nodes]
        edges, T_world_cam = renumbered(self._sure(num_links), nodes), self.nodes.T_world_cam[nodes]
        tracks = renumbered([link for link in self._sure(num_links) if link.kind is not Kind.LOOP], nodes)
        T_world_cam = brought_together(T_world_cam, edges, parts(len(nodes), tracks))
        _, firsts = np.unique(parts(len(nodes), edges), return_index=True)
        num_loaded = int((self.nodes.frames[nodes] < 0).sum())
        fixed = {*firsts.tolist(), *range(num_loaded + 1)}  # nothing that was loaded is anchored to a later frame than the first
        return _Solving(Optimizer(PoseGraph.of(T_world_cam, edges, sorted(fixed)), state), num_nodes, num_links, is_second)

    def _sure(self, count: int) -> list[Link]:
        """Returns those of the first links that are not in doubt."""
        return [link for link in self._links[:count] if link.kind is not Kind.PENDING]

    def _solved(self, most_steps: int = 10**6) -> Matrix | None:
        """Goes on with the optimisation, first with all loops, then without those that contradict the others.

        Returns:
            The poses [N, 4, 4] of the nodes that take part; None as long as it goes on.
        """
        solving = self._solving
        assert solving is not None
        for _ in range(most_steps):
            if solving.optimizer.state.is_done:
                break
            solving.optimizer.step()
        if not solving.optimizer.state.is_done:
            return None
        self._solving, solution = None, solving.optimizer.solution()
        poses = solution.T_world_cam if solution.is_better else solution.T_before
        at = dict(zip(self._active, poses))
        loops = [link for link in self._sure(solving.num_links) if link.kind is Kind.LOOP]
        wrong = {id(loop) for loop, off in zip(loops, deviations(loops, at)) if off.max() > _MOST_WRONG}
        if not wrong:
            return poses
        _log.info('%d loops contradict the graph at frame %d', len(wrong), self.nodes.frames[-1])
        self._links = [link for link in self._links if id(link) not in wrong]
        if solving.is_second or not solution.is_better:
            return poses
        state = OptimizerState(poses, widening=1.0)
        self._solving = self._solving_from(state, solving.num_nodes, solving.num_links - len(wrong), is_second=True)
        return None

    def _is_drift(self, nodes: Sequence[int], solution: Matrix) -> bool:
        """Returns whether the poses [N, 4, 4] of a solution explain most of what loops disagree with the present ones.

        If they do not, loops err by as much as the poses: each of them says something else, and the poses follow its error. What
        loops of one keyframe say, some correction always explains: as with parameters of a fit, they do not count.
        """
        T_now, T_then = dict(zip(nodes, self.nodes.T_world_cam[nodes])), dict(zip(nodes, solution))
        loops = [loop for loop in self.loops() if loop.first in T_now and loop.second in T_now]
        now, then = (np.square(deviations(loops, T)).sum() for T in (T_now, T_then))
        keyframes = len({loop.second for loop in loops})
        return bool(keyframes and then <= (1 - _LEAST_DRIFT) * (1 - 1 / keyframes) * now)

    def _off(self, loop: Link) -> float:
        """Returns by how much a loop would move its second node: m or rad, whichever is more."""
        T = self.nodes.T_world_cam
        return size(se3.inverse(loop.T_first_second) @ motions.between(T[loop.first], T[loop.second]))

    def _most_off(self) -> float:
        """Returns by how much loops would move their second nodes at most: m or rad, whichever is more."""
        twists = contradictions(self.loops(), dict(enumerate(self.nodes.T_world_cam)))
        return float(np.linalg.norm(twists.reshape(-1, 2, 3), axis=2).max(initial=0.0))

    def _moved(self, loop: Link) -> Matrix:
        """Returns the motion [4, 4] of the world by which a loop would move its second node."""
        T = self.nodes.T_world_cam
        return T[loop.first] @ loop.T_first_second @ se3.inverse(T[loop.second])

    def _confirmed(self, loop: Link) -> list[Link]:
        """Returns a loop, if it changes little or another one says the same, and then with that one; else it waits for one."""
        off = self._off(loop)
        if off <= self._config.min_correction_m:
            return [loop]
        T, alike = self.nodes.T_world_cam[loop.second], min(max(_SAME[0], 0.5 * off), _SAME[1])
        others = [
            other for other in self._links
            if other.kind is Kind.PENDING and other.second != loop.second
            and size(se3.inverse(self._moved(other) @ T) @ self._moved(loop) @ T) < alike
        ]  # fmt: skip
        self._links = [link for link in self._links if not any(link is other for other in others)]
        if others:
            return [*(replace(other, kind=Kind.LOOP) for other in others), loop]
        self._links.append(replace(loop, kind=Kind.PENDING))
        return []

    def _corrections(self, solution: Matrix, nodes: Sequence[int]) -> Corrections:
        """Moves nodes to the poses [N, 4, 4] of a solution, and the others with them. Returns how the world moves."""
        T_last, T_before = self.nodes.T_world_cam[-1], self.nodes.T_world_cam[nodes]
        corrections = Corrections.between(self.nodes.frames[nodes], T_before, solution)
        T_world_cam = corrections.at(self.nodes.frames) @ self.nodes.T_world_cam
        T_world_cam[nodes] = solution
        self.nodes = self.nodes.moved(T_world_cam)
        self.num_corrections += 1
        self.num_corrections += 1
        is_apart = self._schedule.is_apart and bool(self._elsewhere(self._active[-1], self._active))
        self._schedule = GraphSchedule(is_apart=is_apart)
        self._last_correction_m = float(np.linalg.norm(T_world_cam[-1, :3, 3] - T_last[:3, 3]))
        self.T_world_odom = corrections.motions[-1] @ self.T_world_odom
        return corrections

    def _merge(self, node: int) -> None:
        """Takes a node out, because its images are gone. The one beside it takes over its edges."""
        self._active.remove(node)
        own = [link for link in self._links if node in (link.first, link.second)]
        self._links = [link for link in self._links if node not in (link.first, link.second)]
        ways = {link.first + link.second - node: link for link in own if link.kind is Kind.ODOMETRY}  # by the node at the other end
        if not ways:
            return
        T, into = self.nodes.T_world_cam, min(ways, key=lambda other: abs(other - node))
        covariance = inverse(ways.pop(into).information)
        for other, link in ways.items():
            first, second = sorted((into, other))
            information = inverse(covariance + inverse(link.information))
            self._links.append(Link(first, second, motions.between(T[first], T[second]), information))
        step = motions.between(T[into], T[node])
        handed_over = [link for link in own if link.kind not in (Kind.ODOMETRY, Kind.WINDOW)]
        has = sum(link.kind not in (Kind.ODOMETRY, Kind.WINDOW) and into in (link.first, link.second) for link in self._links)
        for link in handed_over[: max(0, _MOST_LOOPS - has)]:
            if into in (link.first, link.second):
                continue
            is_first = link.first == node
            motion = step @ link.T_first_second if is_first else link.T_first_second @ se3.inverse(step)
            first, second = (into, link.second) if is_first else (link.first, into)
            self._links.append(replace(link, first=first, second=second, T_first_second=motion))

    def rest(self) -> None:
        """Begins anew with the next keyframe, because time does; the map stays where it is."""
        self.nodes = Nodes()
        self._active, self._links, self._found, self._tasks = [], [], [], []
        self._solving, self._schedule = None, GraphSchedule()
        self._is_interrupted = False

    def interrupt(self, newest: TrackedFrame | None) -> None:
        """Goes on after frames were left out: the way to the next tracked frame is not known, but what was measured stays.

        Args:
            newest: the last frame before that; None = the last node.
        """
        self._extend(newest)
        self._is_interrupted = True

    def drop_from(self, frame: int) -> None:
        """Forgets the keyframes of the frames from a number on."""
        self.nodes = self.nodes.before(frame)
        self._active = [node for node in self._active if node < len(self.nodes)]
        self._links, self._found = (
            [link for link in links if max(link.first, link.second) < len(self.nodes)] for links in (self._links, self._found)
        )
        self._tasks = [task for task in self._tasks if max(task.first, task.second) < len(self.nodes)]
        self._schedule, self._solving = GraphSchedule(is_apart=self._schedule.is_apart), None
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
        links = [*self._links, *self._found]
        graph = PoseGraph.of(self.nodes.T_world_cam, links)
        return {
            **{name: getattr(self.nodes, name) for name in Nodes.__dataclass_fields__},
            'active': np.array(self._active, dtype=np.int64),
            'pairs': graph.pairs.astype(np.int64),
            'T_first_second': graph.T_first_second,
            'information': graph.information,
            'limits': graph.limits,
            'kinds': np.array([link.kind for link in links], dtype=np.int64),
            'T_world_odom': self.T_world_odom,
            'num_corrections': np.array(self.num_corrections),
            'is_interrupted': np.array(self._is_interrupted),
            'schedule': np.array(self._schedule.numbers(), dtype=np.int64),
            **self._unfinished(),
            'last_correction_m': np.array(self._last_correction_m),
        }

    def _unfinished(self) -> dict[str, NDArray[Any]]:
        """Returns the work that waits and the optimisation that goes on, by name."""
        tasks, solving = self._tasks, self._solving
        state = OptimizerState(_NO_POSES, 1.0) if solving is None else solving.optimizer.state
        counts = (0, 0, 0) if solving is None else (solving.num_nodes, solving.num_links, int(solving.is_second))
        return {
            'tasks': np.array([(task.work, task.first, task.second) for task in tasks], dtype=np.int64).reshape(-1, 3),
            'task_motions': np.array([task.T_second_first for task in tasks]).reshape(-1, 4, 4),
            'task_covariances': np.array([task.covariance for task in tasks]).reshape(-1, 6, 6),
            'solving': np.array([*counts, state.steps_at_width, state.steps, state.is_done], dtype=np.int64),
            'solving_widths': np.array([state.widening, state.damping]),
            'solving_poses': state.T_world_cam,
        }

    def _restore_unfinished(self, arrays: Arrays) -> None:
        """Continues with the work and the optimisation of ``_unfinished``."""
        self._schedule = GraphSchedule.of(arrays['schedule'].tolist())
        rows = zip(arrays['tasks'].tolist(), arrays['task_motions'], arrays['task_covariances'], strict=True)
        self._tasks = [Task(Work(work), first, second, T, covariance) for (work, first, second), T, covariance in rows]
        num_nodes, num_links, is_second, at_width, steps, is_done = arrays['solving'].tolist()
        if num_nodes:
            widening, damping = arrays['solving_widths'].tolist()
            state = OptimizerState(arrays['solving_poses'], widening, damping, at_width, steps, bool(is_done))
            self._solving = self._solving_from(state, num_nodes, num_links, is_second=bool(is_second))

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
        num_nodes, num_links, num_tasks = len(arrays['frames']), len(arrays['kinds']), len(arrays['tasks'])
        counts = dict.fromkeys(Nodes.__dataclass_fields__, num_nodes)
        counts |= dict.fromkeys(('pairs', *_LINK_ARRAYS), num_links) | dict.fromkeys(_TASK_ARRAYS, num_tasks)
        counts |= {'solving_poses': int(arrays['solving'].flat[0]) if arrays['solving'].size else 0}
        shapes = {name: (count, *expected[name].shape[1:]) for name, count in counts.items()}
        shapes |= {name: expected[name].shape for name in _SINGLE_ARRAYS}
        if broken := [name for name, shape in shapes.items() if arrays[name].shape != shape]:
            raise ValueError(f'graph: {", ".join(broken)} has the wrong shape')
        named = {'pairs': arrays['pairs'], 'active': arrays['active'], 'tasks': arrays['tasks'][:, 1:]}
        if broken := [name for name, nodes in named.items() if nodes.size and not 0 <= nodes.min() <= nodes.max() < num_nodes]:
            raise ValueError(f'graph: {", ".join(broken)} name nodes that are not among its {num_nodes}')
        if not (0 <= arrays['solving'][0] <= len(arrays['active']) and 0 <= arrays['solving'][1] <= num_links):
            raise ValueError('graph: solving goes on with more nodes or links than there are')
        self.nodes = Nodes(**{name: arrays[name] for name in Nodes.__dataclass_fields__})
        self._active, self._is_interrupted = arrays['active'].tolist(), bool(arrays['is_interrupted'])
        columns = [arrays[name] for name in ('pairs', *_LINK_ARRAYS)]
        links = [
            Link(int(first), int(second), T, information, float(limit), kind=Kind(kind))
            for (first, second), T, information, limit, kind in zip(*columns, strict=True)
        ]
        self._links = [link for link in links if link.kind is not Kind.FOUND]
        self._found = [link for link in links if link.kind is Kind.FOUND]
        self.T_world_odom, self.num_corrections = arrays['T_world_odom'], int(arrays['num_corrections'])
        self._last_correction_m = float(arrays['last_correction_m'])
        self._restore_unfinished(arrays)


def _steps_per_frame(num_nodes: int) -> int:
    """Returns how many steps of an optimisation a frame has time for."""
    return max(1, min(_MOST_STEPS, _NODES_PER_FRAME // num_nodes))
