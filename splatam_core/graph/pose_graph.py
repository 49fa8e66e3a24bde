"""Robust pose-graph optimisation: the poses that agree best with measured motions between them.

Levenberg-Marquardt on SE(3) (Grisetti et al., "A Tutorial on Graph-Based SLAM", 2010). An edge with a limit has the kernel of
Geman and McClure, which switches off edges that contradict the others. The kernels begin wide and are narrowed step by step
(graduated non-convexity, Yang et al. 2020), so that a right loop counts however much drift it takes back. The normal equations
are sparse, and are solved by native code in a time that grows with the number of poses, as long as there are few loops.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatam_core.geometry import motions, se3
from splatam_core.geometry.se3 import Matrix, Vector
from splatam_core.rasterizer.native import solve_blocks

_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-6, 1e-9, 1e6
_MAX_STEPS, _STEPS_BETWEEN = 20, 2
_NARROWING = 4.0  # factor from one width of the kernels to the next
_SMALL_STEP = 1e-5  # m, rad: converged
_SMALL_GAIN = 1e-4  # of the cost: converged


@dataclass(frozen=True, slots=True, eq=False)
class Edge:
    """A measured motion between two poses.

    Attributes:
        first: number of a pose.
        second: number of another one.
        T_first_second: [4, 4] camera of the second to camera of the first.
        information: [6, 6] inverse covariance of the twist by which the motion is off, in the axes of the second.
        limit: of the squared error in standard deviations, beyond which the edge loses its weight; infinite = it never does.
    """

    first: int
    second: int
    T_first_second: Matrix
    information: Matrix
    limit: float = math.inf


@dataclass(frozen=True, slots=True, eq=False)
class PoseGraph:
    """Poses and edges, as arrays.

    Attributes:
        T_world_cam: [N, 4, 4].
        pairs: [E, 2] numbers of the poses that each edge connects.
        T_first_second: [E, 4, 4].
        information: [E, 6, 6].
        limits: [E].
        is_fixed: [N] which poses stay; at least one.
    """

    T_world_cam: Matrix
    pairs: NDArray[np.intp]
    T_first_second: Matrix
    information: Matrix
    limits: Vector
    is_fixed: NDArray[np.bool_]

    @classmethod
    def of(cls, T_world_cam: Matrix, edges: Sequence[Edge], fixed: Sequence[int] = (0,)) -> PoseGraph:
        """Returns the graph of poses [N, 4, 4], of which some are fixed, and edges.

        Raises:
            ValueError: no pose is fixed.
        """
        is_fixed = np.zeros(len(T_world_cam), dtype=bool)
        is_fixed[[number for number in fixed if number < len(T_world_cam)]] = True
        if len(T_world_cam) and not is_fixed.any():
            raise ValueError('no pose is fixed, so the graph could be anywhere')
        return cls(
            T_world_cam=T_world_cam,
            pairs=np.array([(edge.first, edge.second) for edge in edges], dtype=np.intp).reshape(-1, 2),
            T_first_second=np.array([edge.T_first_second for edge in edges]).reshape(-1, 4, 4),
            information=np.array([edge.information for edge in edges]).reshape(-1, 6, 6),
            limits=np.array([edge.limit for edge in edges], dtype=np.float64),
            is_fixed=is_fixed,
        )

    def errors(self, T_world_cam: Matrix) -> Vector:
        """Returns [E, 6] the twists by which poses [N, 4, 4] contradict the edges."""
        first, second = self.pairs.T
        return motions.log(se3.inverse(self.T_first_second) @ motions.between(T_world_cam[first], T_world_cam[second]))

    def squared(self, errors: Vector) -> Vector:
        """Returns [E] errors [E, 6] squared, in standard deviations."""
        return (errors[:, None] @ self.information @ errors[:, :, None])[:, 0, 0]


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Optimised poses.

    Attributes:
        T_world_cam: [N, 4, 4].
        squared_errors: [E] of the edges, in standard deviations.
        weights: [E] that the kernels leave them, in [0, 1].
        steps: number of steps taken.
        T_before: [N, 4, 4] the poses from which the optimisation began.
        is_better: True if the edges, those with a limit counted up to it, agree at least as well as they did there.
    """

    T_world_cam: Matrix
    squared_errors: Vector
    weights: Vector
    steps: int
    T_before: Matrix
    is_better: bool


def optimize(graph: PoseGraph) -> Solution:
    """Returns the poses that agree best with the edges, found from those of the graph."""
    optimizer = Optimizer(graph)
    while not optimizer.state.is_done:
        optimizer.step()
    return optimizer.solution()


@dataclass(frozen=True, slots=True, eq=False)
class OptimizerState:
    """How far an optimisation is.

    Attributes:
        T_world_cam: [N, 4, 4] poses so far.
        widening: factor by which the kernels are wider than in the end.
        damping: of the next step.
        steps_at_width: number of steps taken with these kernels.
        steps: number of all steps taken.
        is_done: True if no further step helps.
    """

    T_world_cam: Matrix
    widening: float
    damping: float = _FIRST_DAMPING
    steps_at_width: int = 0
    steps: int = 0
    is_done: bool = False


class Optimizer:
    """Finds the poses that agree best with edges, a step at a time, so that the work can be spread over frames.

    Attributes:
        state: how far it is.
    """

    def __init__(self, graph: PoseGraph, state: OptimizerState | None = None) -> None:
        """Begins, or continues from a state of the same graph."""
        self._graph = graph
        self._at = _Estimate.of(graph, graph.T_world_cam if state is None else state.T_world_cam)
        self.state = self._first_state() if state is None else state

    def _first_state(self) -> OptimizerState:
        limited = np.isfinite(self._graph.limits)
        widening = max(1.0, 2 * float((self._at.squared[limited] / self._graph.limits[limited]).max(initial=0.0)))
        return OptimizerState(self._at.T_world_cam, widening, is_done=bool(self._graph.is_fixed.all()))

    def step(self) -> None:
        """Takes one step of Levenberg and Marquardt; narrows the kernels where steps have become small."""
        state, limits = self.state, self.state.widening * self._graph.limits
        cost, damping, is_small = _cost(self._at.squared, limits), state.damping, False
        step = _step(self._graph, self._at.T_world_cam, self._at.errors, _weights(self._at.squared, limits), damping)
        there = self._at if step is None else _Estimate.of(self._graph, self._at.T_world_cam @ motions.exp(step))
        cost_there = _cost(there.squared, limits)
        if step is None or not cost_there <= cost:
            damping *= 10
        else:
            self._at, damping = there, max(damping / 10, _LEAST_DAMPING)
            is_small = bool(np.abs(step).max() < _SMALL_STEP) or cost - cost_there <= _SMALL_GAIN * cost_there
        is_last, count = state.widening == 1.0, state.steps_at_width + 1
        ends = is_small or damping >= _MOST_DAMPING or count >= (_MAX_STEPS if is_last else _STEPS_BETWEEN)
        self.state = OptimizerState(
            self._at.T_world_cam,
            widening=max(1.0, state.widening / _NARROWING) if ends else state.widening,
            damping=_FIRST_DAMPING if ends else damping,
            steps_at_width=0 if ends else count,
            steps=state.steps + 1,
            is_done=ends and is_last,
        )

    def solution(self) -> Solution:
        """Returns the poses so far."""
        squared, limits = self._at.squared, self._graph.limits
        before = _Estimate.of(self._graph, self._graph.T_world_cam).squared
        return Solution(
            T_world_cam=_orthonormal(self._at.T_world_cam),
            squared_errors=squared,
            weights=_weights(squared, limits),
            steps=self.state.steps,
            T_before=self._graph.T_world_cam,
            is_better=_cost(squared, limits) <= _cost(before, limits),
        )


@dataclass(frozen=True, slots=True, eq=False)
class _Estimate:
    """Poses [N, 4, 4], and errors [E, 6] of the edges there, also squared in standard deviations [E]."""

    T_world_cam: Matrix
    errors: Vector
    squared: Vector

    @classmethod
    def of(cls, graph: PoseGraph, T_world_cam: Matrix) -> _Estimate:
        errors = graph.errors(T_world_cam)
        return cls(T_world_cam, errors, graph.squared(errors))


def _cost(squared: Vector, limits: Vector) -> float:
    return float((squared / (1 + squared / limits)).sum())


def _weights(squared: Vector, limits: Vector) -> Vector:
    """Returns [E] the derivative of the kernels by the squared errors."""
    return (1 + squared / limits) ** -2


def _step(graph: PoseGraph, poses: Matrix, errors: Vector, weights: Vector, damping: float) -> Vector | None:
    """Returns the [N, 6] step of damped Gauss-Newton, 0 for fixed poses; None if the equations have no solution."""
    free = np.flatnonzero(~graph.is_fixed)
    number = np.full(len(poses), -1)
    number[free] = np.arange(len(free))
    of_first, of_second = jacobians(graph, poses, errors)
    weighted = weights[:, None, None] * graph.information
    place, blocks = _normal_blocks(number[graph.pairs], of_first, of_second, weighted)
    gradient = np.zeros((len(free), 6))
    for ends, jacobian in zip(number[graph.pairs].T, (of_first, of_second)):
        kept = ends >= 0
        np.add.at(gradient, ends[kept], np.einsum('eki,ekl,el->ei', jacobian[kept], weighted[kept], errors[kept]))
    diagonal = np.full((len(free), 6), _LEAST_DAMPING)
    is_diagonal = place[:, 0] == place[:, 1]
    np.add.at(diagonal, place[is_diagonal, 0], damping * np.einsum('kii->ki', blocks[is_diagonal]))
    place = np.concatenate([place, np.repeat(np.arange(len(free))[:, None], 2, axis=1)])
    blocks = np.concatenate([blocks, diagonal[:, :, None] * np.eye(6)])
    try:
        solve_blocks(np.ascontiguousarray(place, dtype=np.int32), np.ascontiguousarray(blocks), gradient)
    except ValueError:
        return None
    step = np.zeros((len(poses), 6))
    step[free] = -gradient
    return step if np.isfinite(step).all() else None


def jacobians(graph: PoseGraph, poses: Matrix, errors: Vector) -> tuple[Matrix, Matrix]:
    """Returns [E, 6, 6] the derivatives of the errors by twists on the right of the first and of the second pose."""
    first, second = graph.pairs.T
    of_second = motions.inverse_right_jacobian(errors)
    return -of_second @ motions.adjoint(motions.between(poses[second], poses[first])), of_second


def _normal_blocks(
    ends: NDArray[np.intp], of_first: Matrix, of_second: Matrix, information: Matrix
) -> tuple[NDArray[np.intp], Matrix]:
    """Returns [K, 2] places and [K, 6, 6] blocks of the lower triangle of the normal matrix. ends: [E, 2], -1 = fixed."""
    first, second = ends.T
    by_first, by_second = (np.swapaxes(jacobian, 1, 2) @ information for jacobian in (of_first, of_second))
    both, first_is_later = (first >= 0) & (second >= 0), first > second
    across = by_second @ of_first  # row second, column first
    across = np.where(first_is_later[:, None, None], np.swapaxes(across, 1, 2), across)
    places = [
        np.stack([first, first], axis=1)[first >= 0], np.stack([second, second], axis=1)[second >= 0],
        np.stack([np.maximum(first, second), np.minimum(first, second)], axis=1)[both],
    ]  # fmt: skip
    blocks = [(by_first @ of_first)[first >= 0], (by_second @ of_second)[second >= 0], across[both]]
    return np.concatenate(places), np.concatenate(blocks)


def _orthonormal(T: Matrix) -> Matrix:
    """Returns motions [N, 4, 4] whose rotations lost no digit in many steps."""
    U, _, V = np.linalg.svd(T[:, :3, :3])
    result = T.copy()
    result[:, :3, :3] = U @ V
    return result
