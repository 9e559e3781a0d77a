"""The pose graph that grows: its chain, its closures, and the ways along both."""

import math
from copy import copy
from itertools import pairwise

import numpy as np
import pytest
from tests.graph.pose_graphs import grid_walk
from tests.numeric import wrapped

from impslam.errors import NumericalError
from impslam.estimators.pose_graph import KERNEL, PoseGraph
from impslam.geometry.se2 import between, compose, compose_uncertain
from impslam.graph.solve import marginals

Q = np.array([[2e-4, 3e-5, 1e-5], [3e-5, 1e-4, -1e-5], [1e-5, -1e-5, 4e-5]])
FIRM = np.diag([1e4, 1e4, 1e5])
"""Information of a closure: 1 cm and 0.2 degrees."""


def grown(truth, drift=(0.0, 0.0, 0.0), length=2.5):
    """Return a graph of the motions between poses (n, 3), each off by some drift (3,)."""
    graph = PoseGraph()
    graph.begin(truth[0], 1e-8 * np.eye(3))
    for a, b in pairwise(truth):
        graph.go_on(between(a, b) + np.array(drift), Q, length)
    return graph


def closed(graph, truth, i, j, T=None):
    return graph.close(i, j, between(truth[i], truth[j]) if T is None else T, FIRM)


def square(n=8, side=5.0):
    """Return poses (4 n + 1, 3) round a square, back at the first."""
    corners = np.array([[0, 0], [side, 0], [side, side], [0, side]], float)
    rows = []
    for k, (corner, after) in enumerate(zip(corners, np.roll(corners, -1, 0), strict=True)):
        heading = math.remainder(0.5 * math.pi * k, 2 * math.pi)
        rows += [[*(corner + (after - corner) * s / n), heading] for s in range(n)]
    return np.array([*rows, rows[0]])


def test_the_chain_is_that_of_uncertain_motions(rng):
    truth = grid_walk(9, rng)
    graph = grown(truth)
    assert np.abs(wrapped(graph.poses - truth, 2)).max() < 1e-12
    pose, P = truth[0], 1e-8 * np.eye(3)
    for k in range(1, len(truth)):
        pose, P = compose_uncertain(pose, P, between(truth[k - 1], truth[k]), Q)
        np.testing.assert_allclose(graph.covariances[k], P, rtol=1e-12)
    assert graph.closures == 0
    assert len(graph) == 9


def test_a_graph_without_nodes_or_with_one_has_no_edges():
    graph = PoseGraph()
    assert (len(graph), graph.closures, len(graph.edges.i)) == (0, 0, 0)
    graph.begin(np.array([1.0, 2.0, 3.0]), np.eye(3))
    assert (len(graph), graph.closures, len(graph.edges.i)) == (1, 0, 0)
    np.testing.assert_array_equal(graph.ways(0), [0.0])


def test_motions_are_certain_to_be_motions_and_closures_are_not(rng):
    truth = grid_walk(6, rng)
    graph = grown(truth)
    closed(graph, truth, 0, 5)
    edges = graph.edges
    np.testing.assert_array_equal(edges.kernel, [math.inf] * 5 + [KERNEL])
    np.testing.assert_allclose(edges.information[:5], np.broadcast_to(np.linalg.inv(Q), (5, 3, 3)))
    assert graph.closures == 1


def test_a_closure_brings_the_ends_together():
    truth = square()
    graph = grown(truth, drift=(0.0, 0.0, 0.004))
    assert np.hypot(*(graph.poses[-1] - truth[-1])[:2]) > 0.3
    assert closed(graph, truth, 0, len(truth) - 1)
    graph.solve()
    assert np.abs(graph.poses[-1] - truth[-1])[:2].max() < 0.01
    # Of a constant drift, the closure takes most away everywhere.
    assert np.hypot(*(graph.poses - truth)[:, :2].T).max() < 0.1
    np.testing.assert_array_equal(graph.poses[0], truth[0])


def test_a_closure_that_the_drift_does_not_allow_is_outvoted():
    """Nine standard deviations of the chain: the closure is the less likely one."""
    truth = square()
    graph = grown(truth)
    closed(graph, truth, 0, 32, np.array([0.0, 0.0, 9.0 * math.sqrt(32 * Q[2, 2])]))
    graph.solve()
    assert np.hypot(*(graph.poses - truth)[:, :2].T).max() < 0.2


def test_true_closures_of_an_exact_chain_move_nothing(rng):
    truth = grid_walk(30, rng)
    graph = grown(truth)
    assert not closed(graph, truth, 3, 28)
    assert not closed(graph, truth, 0, 15)
    graph.solve()
    assert np.abs(wrapped(graph.poses - truth, 2)).max() < 1e-9


@pytest.mark.parametrize(
    ("shift", "new"),
    [
        ((0.09, 0, 0), False),
        ((0.08, 0.08, 0), True),
        ((0, 0, 0.009), False),
        ((0, 0, -0.011), True),
    ],
)
def test_a_closure_says_something_new_by_how_far_it_moves(shift, new):
    truth = square()
    graph = grown(truth)
    T = between(truth[2], truth[30]) + np.array(shift)
    assert closed(graph, truth, 2, 30, T) == new
    assert graph.closures == 1


def test_a_heading_beyond_pi_is_no_news():
    graph = grown(np.array([[0.0, 0.0, 3.1], [1.0, 0.0, -3.1]]))
    T = between(graph.poses[0], graph.poses[1])
    assert not graph.close(0, 1, T + np.array([0.0, 0.0, 2.0 * math.pi]), FIRM)


def test_a_rigid_motion_of_the_start_moves_everything():
    truth, motion = square(), np.array([4.0, -3.0, 2.0])
    one, two = (
        grown(truth, (0.002, 0.001, 0.01)),
        grown(compose(motion, truth), (0.002, 0.001, 0.01)),
    )
    for graph in (one, two):
        graph.close(0, 32, np.zeros(3), FIRM)
        graph.solve()
    assert np.abs(wrapped(compose(motion, one.poses) - two.poses, 2)).max() < 1e-8


def test_covariances_after_a_solution_are_the_marginals_and_the_start():
    truth = square()
    graph = grown(truth, drift=(0.0, 0.0, 0.005))
    before = graph.covariances[-1].copy()
    closed(graph, truth, 0, 32)
    graph.solve()
    known = marginals(graph.poses, graph.edges, np.array([0])) + 1e-8 * np.eye(3)
    np.testing.assert_allclose(graph.covariances, known, rtol=1e-9, atol=1e-15)
    assert np.trace(graph.covariances[-1]) < 0.1 * np.trace(before)
    assert (np.linalg.eigvalsh(graph.covariances) > 0.0).all()


def test_a_false_closure_gives_way_to_true_ones():
    """Between nodes that two true closures hold, one that is metres off is outside its kernel."""
    truth = square()
    graph = grown(truth, drift=(0.0, 0.0, 0.005))
    closed(graph, truth, 0, 32)
    closed(graph, truth, 1, 31)
    closed(graph, truth, 4, 20, between(truth[4], truth[20]) + np.array([2.0, 0.0, 0.5]))
    graph.solve()
    assert np.hypot(*(graph.poses - truth)[:, :2].T).max() < 0.12


def test_without_a_solution_the_nodes_stay_where_they_are():
    truth = square()
    graph = grown(truth, drift=(0.0, 0.0, 0.01))
    poses, covariances = graph.poses.copy(), graph.covariances.copy()
    graph.close(0, 32, np.array([np.nan, 0.0, 0.0]), FIRM)
    with pytest.raises(NumericalError, match="not finite"):
        graph.solve()
    np.testing.assert_array_equal(graph.poses, poses)
    np.testing.assert_array_equal(graph.covariances, covariances)


def test_closures_that_are_taken_back_leave_the_graph_as_it_was():
    truth = square()
    graph, twin = (grown(truth, drift=(0.0, 0.0, 0.004)) for _ in "ab")
    for one in (graph, twin):
        closed(one, truth, 0, 32)
    before = graph.edges
    graph.close(1, 31, np.full(3, np.nan), FIRM)
    graph.close(2, 30, np.full(3, np.nan), FIRM)
    graph.take_back(2)
    assert graph.closures == 1
    for one in (graph, twin):
        one.go_on(np.array([1.0, 0.0, 0.0]), Q, 1.0)
        one.close(1, 33, np.zeros(3), FIRM)
        one.solve()
    np.testing.assert_array_equal(graph.poses, twin.poses)
    np.testing.assert_array_equal(graph.ways(5), twin.ways(5))
    assert np.isfinite(before.T_i_j).all()
    assert len(before.i) == 33


# --------------------------------------------------------------------------- ways


def test_the_way_along_a_chain_is_its_length(rng):
    graph = grown(grid_walk(7, rng), length=3.0)
    for node in (0, 3, 6):
        np.testing.assert_allclose(graph.ways(node), 3.0 * np.abs(np.arange(7) - node))


def test_a_closure_is_a_short_cut(rng):
    graph = grown(grid_walk(11, rng), length=2.0)
    graph.close(1, 9, np.zeros(3), FIRM)
    ways = graph.ways(10)
    np.testing.assert_allclose(ways[[10, 9, 1, 0, 2, 5]], [0.0, 2.0, 2.5, 4.5, 4.5, 10.0])


def test_ways_are_the_shortest(rng):
    """Against Floyd and Warshall, in a graph with many closures."""
    n = 25
    graph = grown(grid_walk(n, rng), length=2.5)
    apart = np.full((n, n), np.inf)
    np.fill_diagonal(apart, 0.0)
    edges = [(k, k + 1, 2.5) for k in range(n - 1)]
    for _ in range(8):
        i, j = sorted(rng.choice(n, 2, replace=False).tolist())
        graph.close(i, j, np.zeros(3), FIRM)
        edges.append((i, j, 0.5))
    for i, j, length in edges:
        apart[i, j] = apart[j, i] = min(apart[i, j], length)
    for k in range(n):
        apart = np.minimum(apart, apart[:, k : k + 1] + apart[k : k + 1])
    for node in range(n):
        np.testing.assert_allclose(graph.ways(node), apart[node])


def test_a_copy_stays_as_it_is_while_the_graph_goes_on():
    graph = PoseGraph()
    graph.begin(np.zeros(3), 1e-4 * np.eye(3))
    step = np.array([1.0, 0.0, 0.0])
    graph.go_on(step, 1e-4 * np.eye(3), 1.0)
    before = copy(graph)
    graph.go_on(step, 1e-4 * np.eye(3), 1.0)
    graph.close(0, 2, np.array([2.0, 0.1, 0.0]), 1e4 * np.eye(3))
    assert (len(before), len(before.edges.i), before.closures) == (2, 1, 0)
    before.solve()
    np.testing.assert_allclose(before.poses[1], step, atol=1e-12)
