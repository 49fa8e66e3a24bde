"""Pose-graph optimisation against known poses, its derivatives, and edges that are wrong."""

from __future__ import annotations

import numpy as np
import pytest

from splatam_core.geometry import motions, se3
from splatam_core.graph.pose_graph import Edge, PoseGraph, jacobians, optimize
from splatam_core.rasterizer.native import solve_blocks

LIMIT = 50.0  # of a squared error that is 6 on average


def circle(count: int) -> np.ndarray:
    """Poses [N, 4, 4] once around a circle of one metre."""
    turn = se3.exp(np.array([0, 0, 2 * np.pi / count, 0.1 / count, 2 * np.pi / count, 0.0]))
    poses = [np.eye(4)]
    for _ in range(count - 1):
        poses.append(poses[-1] @ turn)
    return np.array(poses)


def edge(poses: np.ndarray, first: int, second: int, deviation: float, rng: np.random.Generator, limit: float = np.inf) -> Edge:
    """Measures the motion between two poses with noise."""
    noise = se3.exp(deviation * rng.standard_normal(6))
    return Edge(first, second, motions.between(poses[first], poses[second]) @ noise, np.eye(6) / deviation**2, limit)


def chained(poses: np.ndarray, edges: list[Edge]) -> np.ndarray:
    """Poses as the sequential edges alone give them."""
    result = [poses[0]]
    for one in edges[: len(poses) - 1]:
        result.append(result[-1] @ one.T_first_second)
    return np.array(result)


def test_exp_and_log_are_those_of_single_motions() -> None:
    twists = np.random.default_rng(0).normal(size=(50, 6)) * np.geomspace(1e-9, 1.5, 50)[:, None]
    twists[:, 3:] *= np.minimum(1, 3.0 / np.linalg.norm(twists[:, 3:], axis=1))[:, None]
    np.testing.assert_allclose(motions.exp(twists), [se3.exp(twist) for twist in twists], atol=1e-12)
    np.testing.assert_allclose(motions.log(motions.exp(twists)), twists, atol=1e-9)  # near 1e-4 rad the series ends


def test_derivatives_are_those_of_finite_differences() -> None:
    rng = np.random.default_rng(1)
    poses = np.array([se3.exp(rng.normal(size=6)) for _ in range(4)])
    edges = [edge(poses, first, second, 0.3, rng) for first, second in ((0, 1), (1, 2), (3, 0), (2, 3))]
    graph = PoseGraph.of(poses, edges)
    analytic = jacobians(graph, poses, graph.errors(poses))
    for number, derivative in enumerate(analytic):
        for axis in range(6):
            twist = np.zeros(6)
            twist[axis] = 1e-6
            for index, one in enumerate(edges):
                moved, back = poses.copy(), poses.copy()
                which = (one.first, one.second)[number]
                moved[which], back[which] = poses[which] @ se3.exp(twist), poses[which] @ se3.exp(-twist)
                numeric = (graph.errors(moved)[index] - graph.errors(back)[index]) / 2e-6
                np.testing.assert_allclose(derivative[index][:, axis], numeric, atol=1e-6)  # of a series, up to 1 rad


def test_sparse_solution_is_the_dense_one() -> None:
    rng = np.random.default_rng(2)
    size, place = 12, [(k, k) for k in range(12)] + [(k + 1, k) for k in range(11)] + [(9, 2), (11, 0), (9, 2)]
    blocks = rng.normal(size=(len(place), 6, 6))
    blocks[:size] = blocks[:size] @ np.swapaxes(blocks[:size], 1, 2) + 60 * np.eye(6)
    dense = np.zeros((6 * size, 6 * size))
    for (row, column), block in zip(place, blocks):
        dense[6 * row : 6 * row + 6, 6 * column : 6 * column + 6] += block
        if row != column:
            dense[6 * column : 6 * column + 6, 6 * row : 6 * row + 6] += block.T
    wanted = rng.normal(size=(size, 6))
    found = (dense @ wanted.ravel()).reshape(size, 6)
    solve_blocks(np.array(place, np.int32), blocks, found)
    np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_what_cannot_be_solved_is_refused() -> None:
    zero = np.zeros((1, 6))
    with pytest.raises(ValueError, match='positive definite'):
        solve_blocks(np.zeros((1, 2), np.int32), -np.eye(6)[None], zero)
    with pytest.raises(ValueError, match='lower triangle'):
        solve_blocks(np.array([(0, 1)], np.int32), np.eye(6)[None], zero)
    with pytest.raises(ValueError, match='fixed'):
        PoseGraph.of(np.eye(4)[None], [], fixed=())


def test_a_loop_takes_the_drift_back() -> None:
    rng, truth = np.random.default_rng(3), circle(100)
    edges = [edge(truth, k, k + 1, 0.01, rng) for k in range(99)]
    drifted = chained(truth, edges)
    edges.append(edge(truth, 99, 0, 0.001, rng, LIMIT))
    solution = optimize(PoseGraph.of(drifted, edges))
    graph = PoseGraph.of(drifted, edges)
    assert np.linalg.norm(drifted[-1, :3, 3] - truth[-1, :3, 3]) > 0.2
    assert np.linalg.norm(solution.T_world_cam[-1, :3, 3] - truth[-1, :3, 3]) < 0.01
    assert solution.weights[-1] > 0.9
    assert solution.squared_errors.sum() < graph.squared(graph.errors(truth)).sum()  # nothing explains the edges better
    np.testing.assert_allclose(solution.T_world_cam[0], drifted[0], atol=1e-12)


def test_a_wrong_loop_loses_its_weight() -> None:
    rng, truth = np.random.default_rng(4), circle(60)
    edges = [edge(truth, k, k + 1, 0.005, rng) for k in range(59)]
    edges += [edge(truth, k, k + 4, 0.005, rng) for k in range(0, 55, 2)]
    right = [edge(truth, first, second, 0.01, rng, LIMIT) for first, second in ((0, 58), (3, 55), (10, 45))]
    wrong = Edge(20, 50, se3.exp(np.array([0.5, 0, 0, 0, 0.4, 0])), np.eye(6) / 0.01**2, LIMIT)
    drifted = chained(truth, edges)
    with_it = optimize(PoseGraph.of(drifted, [*edges, *right, wrong]))
    without = optimize(PoseGraph.of(drifted, [*edges, *right]))
    assert with_it.weights[-1] < 0.01
    assert with_it.weights[-4:-1].min() > 0.5
    np.testing.assert_allclose(with_it.T_world_cam, without.T_world_cam, atol=2e-3)  # what is left of its weight
