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
from impslam.geometry.se2 import between, compose, compose_uncertain, inverse
from impslam.graph.solve import marginals

Q = np.array([[2e-4, 3e-5, 1e-5], [3e-5, 1e-4, -1e-5], [1e-5, -1e-5, 4e-5]])
FIRM = np.diag([1e4, 1e4, 1e5])
"""Information of a closure: 1 cm and 0.2 degrees."""


def grown(truth, drift=(0.0, 0.0, 0.0), length=2.5):
    """Return a graph of the motions between poses (n, 3), each off by some drift (3,)."""
    graph = PoseGraph()
    graph.add_root(truth[0], 1e-8 * np.eye(3))
    for a, b in pairwise(truth):
        graph.extend(between(a, b) + np.array(drift), Q, length)
    return graph


def closed(graph, truth, i, j, T=None):
    return graph.add_closure(i, j, between(truth[i], truth[j]) if T is None else T, FIRM)


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
    graph.add_root(np.array([1.0, 2.0, 3.0]), np.eye(3))
    assert (len(graph), graph.closures, len(graph.edges.i)) == (1, 0, 0)
    np.testing.assert_array_equal(graph.path_lengths(0), [0.0])


def test_motions_are_quadratic_and_closures_robust(rng):
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


def test_a_closure_beyond_the_drift_is_outvoted():
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
def test_a_closure_triggers_a_solution_by_its_correction(shift, new):
    truth = square()
    graph = grown(truth)
    T = between(truth[2], truth[30]) + np.array(shift)
    assert closed(graph, truth, 2, 30, T) == new
    assert graph.closures == 1


def test_a_heading_beyond_pi_triggers_no_solution():
    graph = grown(np.array([[0.0, 0.0, 3.1], [1.0, 0.0, -3.1]]))
    T = between(graph.poses[0], graph.poses[1])
    assert not graph.add_closure(0, 1, T + np.array([0.0, 0.0, 2.0 * math.pi]), FIRM)


def test_a_rigid_motion_of_the_start_moves_everything():
    truth, motion = square(), np.array([4.0, -3.0, 2.0])
    one, two = (
        grown(truth, (0.002, 0.001, 0.01)),
        grown(compose(motion, truth), (0.002, 0.001, 0.01)),
    )
    for graph in (one, two):
        graph.add_closure(0, 32, np.zeros(3), FIRM)
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


def test_the_reach_is_three_sigma_of_the_motions_between_two_nodes(rng):
    truth = grid_walk(9, rng)
    graph = grown(truth)
    motions = between(truth[:-1], truth[1:])
    noise = rng.multivariate_normal(np.zeros(3), Q, (4000, len(motions)))
    drawn = np.repeat(truth[7][None], 4000, 0)
    assert graph.reach(7)[7] == 0.0
    for k in range(6, -1, -1):  # back from node 7, which is fixed
        drawn = compose(drawn, inverse(motions[k] + noise[:, k]))
        sigma = math.sqrt(np.linalg.eigvalsh(np.cov(drawn[:, :2].T))[-1])
        assert graph.reach(7)[k] == pytest.approx(3.0 * sigma, rel=0.08), k


def test_a_closure_reduces_the_reach(rng):
    truth = grid_walk(9, rng)
    graph = grown(truth)
    before = graph.reach(8)[0]
    closed(graph, truth, 0, 8)
    assert graph.reach(8)[0] < 0.5 * before


def test_the_reach_of_another_session_is_infinite(rng):
    truth = grid_walk(6, rng)
    graph = grown(truth)
    graph.add_root(truth[0], np.eye(3))
    graph.extend(between(truth[0], truth[1]), Q, 2.5)
    assert np.isinf(graph.reach(7)[:6]).all()
    assert np.isfinite(graph.reach(7)[6:]).all()
    assert np.isinf(graph.reach(2)[6:]).all()


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
    graph.add_closure(0, 32, np.array([np.nan, 0.0, 0.0]), FIRM)
    with pytest.raises(NumericalError, match="not finite"):
        graph.solve()
    np.testing.assert_array_equal(graph.poses, poses)
    np.testing.assert_array_equal(graph.covariances, covariances)


def test_a_copy_does_not_know_later_closures():
    truth = square()
    spoilt, twin = (grown(truth, drift=(0.0, 0.0, 0.004)) for _ in "ab")
    for one in (spoilt, twin):
        closed(one, truth, 0, 32)
    before, graph = spoilt.edges, copy(spoilt)
    spoilt.add_closure(1, 31, np.full(3, np.nan), FIRM)
    spoilt.add_closure(2, 30, np.full(3, np.nan), FIRM)
    assert graph.closures == 1
    for one in (graph, twin):
        one.extend(np.array([1.0, 0.0, 0.0]), Q, 1.0)
        one.add_closure(1, 33, np.zeros(3), FIRM)
        one.solve()
    np.testing.assert_array_equal(graph.poses, twin.poses)
    np.testing.assert_array_equal(graph.path_lengths(5), twin.path_lengths(5))
    assert np.isfinite(before.T_i_j).all()
    assert len(before.i) == 33


def test_a_graph_is_cut_at_a_motion():
    truth = square()
    graph = grown(truth, drift=(0.0, 0.0, 0.004))
    before = graph.poses.copy()
    other = copy(graph)
    motion, covariance = graph.cut(20)
    np.testing.assert_allclose(compose(before[19], motion), before[20], atol=1e-12)
    np.testing.assert_allclose(covariance, Q, atol=1e-12)
    assert graph.roots.tolist() == [0] * 20 + [20] * (len(graph) - 20)
    assert not other.roots.any()
    np.testing.assert_array_equal(graph.poses, before)
    graph.add_closure(19, 20, motion, np.linalg.inv(covariance))
    graph.solve()
    np.testing.assert_allclose(graph.poses, before, atol=1e-9)


def test_a_closure_that_is_cut_does_not_count_any_more():
    graph = grown(square())
    graph.add_root(np.zeros(3), np.zeros((3, 3)))
    graph.add_closure(len(graph) - 2, len(graph) - 1, np.zeros(3), FIRM)
    assert graph.closures == 1
    assert graph.cut(len(graph) - 1) is not None
    assert graph.closures == 0


def test_a_graph_is_not_cut_through_a_closure():
    truth = square()
    graph = grown(truth, drift=(0.0, 0.0, 0.004))
    closed(graph, truth, 0, 32)
    assert graph.cut(20) is None
    assert not graph.roots.any()


# --------------------------------------------------------------------------- ways


def test_the_path_along_a_chain_is_its_length(rng):
    graph = grown(grid_walk(7, rng), length=3.0)
    for node in (0, 3, 6):
        np.testing.assert_allclose(graph.path_lengths(node), 3.0 * np.abs(np.arange(7) - node))


def test_a_closure_is_a_short_cut(rng):
    graph = grown(grid_walk(11, rng), length=2.0)
    graph.add_closure(1, 9, np.zeros(3), FIRM)
    ways = graph.path_lengths(10)
    np.testing.assert_allclose(ways[[10, 9, 1, 0, 2, 5]], [0.0, 2.0, 2.5, 4.5, 4.5, 10.0])


def test_path_lengths_are_the_shortest(rng):
    """Against Floyd and Warshall, in a graph with many closures."""
    n = 25
    graph = grown(grid_walk(n, rng), length=2.5)
    apart = np.full((n, n), np.inf)
    np.fill_diagonal(apart, 0.0)
    edges = [(k, k + 1, 2.5) for k in range(n - 1)]
    for _ in range(8):
        i, j = sorted(rng.choice(n, 2, replace=False).tolist())
        graph.add_closure(i, j, np.zeros(3), FIRM)
        edges.append((i, j, 0.5))
    for i, j, length in edges:
        apart[i, j] = apart[j, i] = min(apart[i, j], length)
    for k in range(n):
        apart = np.minimum(apart, apart[:, k : k + 1] + apart[k : k + 1])
    for node in range(n):
        np.testing.assert_allclose(graph.path_lengths(node), apart[node])


def test_a_copy_does_not_change_while_the_graph_grows():
    graph = PoseGraph()
    graph.add_root(np.zeros(3), 1e-4 * np.eye(3))
    step = np.array([1.0, 0.0, 0.0])
    graph.extend(step, 1e-4 * np.eye(3), 1.0)
    before = copy(graph)
    graph.extend(step, 1e-4 * np.eye(3), 1.0)
    graph.add_closure(0, 2, np.array([2.0, 0.1, 0.0]), 1e4 * np.eye(3))
    assert (len(before), len(before.edges.i), before.closures) == (2, 1, 0)
    before.solve()
    np.testing.assert_allclose(before.poses[1], step, atol=1e-12)


# --------------------------------------------------------------------------- folded nodes


def folded(graph, truth, node, host):
    graph.fold(node, host, between(truth[host], truth[node]), np.linalg.inv(FIRM))


def test_edges_of_a_folded_node_are_those_of_its_host():
    """Of a chain 0 1 ... 8 with 7 folded into 1, and closures to both: exact where all are exact."""
    truth = square(n=2)
    graph = grown(truth)
    closed(graph, truth, 3, 7)
    folded(graph, truth, 7, 1)
    closed(graph, truth, 7, 8)
    edges = graph.edges
    assert not ((edges.i == 7) | (edges.j == 7)).any()
    expected = between(truth[edges.i], truth[edges.j])
    assert np.abs(wrapped(edges.T_i_j - expected, 2)).max() < 1e-12
    assert {(1, 6), (1, 8), (1, 3)} <= {
        tuple(sorted(e)) for e in zip(edges.i.tolist(), edges.j.tolist(), strict=True)
    }
    assert (graph.closures, len(graph), graph.is_folded.sum()) == (2, 9, 1)
    graph.solve()
    assert np.abs(wrapped(graph.poses - truth, 2)).max() < 1e-9


def test_a_moved_edge_has_the_errors_of_both_parts(rng):
    """The covariance of each edge of a folded node is that of samples."""
    truth = square(n=2)
    graph = grown(truth)
    C = np.diag([1e-4, 2e-4, 3e-5])
    graph.fold(7, 1, between(truth[1], truth[7]), C)
    edges = graph.edges
    n = 40000
    hosts = between(truth[1], truth[7]) + rng.multivariate_normal(np.zeros(3), C, n)
    for other in (6, 8):
        a, b = min(other, 7), max(other, 7)
        motion = between(truth[a], truth[b]) + rng.multivariate_normal(np.zeros(3), Q, n)
        at = compose(motion, inverse(hosts)) if b == 7 else compose(hosts, motion)
        row = np.flatnonzero((edges.i == other) | (edges.j == other))
        row = next(k for k in row if 1 in (edges.i[k], edges.j[k]))
        assert (edges.i[row], edges.j[row]) == ((other, 1) if b == 7 else (1, other))
        np.testing.assert_allclose(
            np.cov(at.T), np.linalg.inv(edges.information[row]), rtol=0.05, atol=3e-6
        )


def test_a_closure_along_a_corridor_can_be_moved_to_a_host():
    """It has no information along the corridor, and gets none."""
    truth = square(n=2)
    graph = grown(truth)
    folded(graph, truth, 7, 1)
    graph.add_closure(7, 3, between(truth[7], truth[3]), np.diag([0.0, 1e4, 1e5]))
    values = np.linalg.eigvalsh(graph.edges.information[-1])
    assert values[0] == pytest.approx(0.0, abs=1e-3)
    assert values[1] > 1.0
    graph.solve()
    assert np.abs(wrapped(graph.poses - truth, 2)).max() < 1e-6


def test_a_motion_without_noise_is_refused_as_a_whole():
    graph = grown(square())
    n, edges = len(graph), graph.edges
    with pytest.raises(NumericalError, match="singular"):
        graph.extend(np.array([1.0, 0.0, 0.0]), np.zeros((3, 3)), 1.0)
    assert len(graph) == n
    np.testing.assert_array_equal(graph.edges.information, edges.information)


def test_folding_a_leaf_does_not_change_the_others():
    truth = square(n=2)
    graph, twin = grown(truth), grown(truth[:-1])
    folded(graph, truth, 8, 0)
    folded(graph, truth, 7, 1)
    graph._merge(1, 3, between(truth[1], truth[3]), 1e-9 * np.eye(3), math.inf, 1.0)
    assert len(graph.edges.i) == 8
    graph.solve()
    twin.solve()
    assert (
        np.trace(graph.covariances[:7], axis1=1, axis2=2)
        <= np.trace(twin.covariances[:7], axis1=1, axis2=2) + 1e-12
    ).all()


def test_of_two_motions_between_the_same_nodes_the_better_one_stays():
    truth = square(n=2)
    for better in (False, True):
        graph = grown(truth)
        information = np.linalg.inv(Q) * (2.0 if better else 0.5)
        graph._merge(1, 0, between(truth[1], truth[0]), information, math.inf, 1.0)
        edges = graph.edges
        assert len(edges.i) == 8
        assert (edges.i[0], edges.j[0]) == ((1, 0) if better else (0, 1))


def test_a_building_driven_again_and_again_is_one_graph():
    lap = square(n=4)[:-1]
    truth = np.concatenate([lap] * 6)
    graph = grown(truth[: len(lap)])
    edges = []
    for k in range(len(lap), len(truth)):
        graph.extend(between(truth[k - 1], truth[k]), Q, 2.5)
        if k > len(lap) + 4:
            folded(graph, truth, k - 4, (k - 4) % len(lap))
        edges.append(len(graph.edges.i))
    assert np.count_nonzero(~graph.is_folded) <= len(lap) + 5
    assert max(edges) <= len(lap) + 6
    graph.solve()
    assert np.abs(wrapped(graph.poses - truth, 2)).max() < 1e-9
    assert graph.path_lengths(len(graph) - 5)[0] < 2.5 * len(lap)


def test_a_folded_node_moves_with_its_host():
    truth = square()
    graph = grown(truth, drift=(0.0, 0.0, 0.004))
    graph.fold(20, 18, between(graph.poses[18], graph.poses[20]), np.linalg.inv(FIRM))
    T = between(graph.poses[18], graph.poses[20])
    before = graph.poses[20].copy()
    closed(graph, truth, 0, 32)
    graph.solve()
    assert np.abs(graph.poses[20] - before).max() > 0.05
    np.testing.assert_allclose(between(graph.poses[18], graph.poses[20]), T, atol=1e-12)


@pytest.mark.parametrize("frozen", [0, 19])
def test_the_covariance_of_a_folded_node_includes_that_relative_to_its_host(frozen):
    """Also if the host is a node of a frozen map, relative to which it is certain."""
    graph, C = grown(square(), drift=(0.0, 0.0, 0.004)), np.diag([4e-4, 9e-4, 1e-4])
    graph.frozen = frozen
    if frozen:
        graph.covariances = graph.covariances.copy()
        graph.covariances[:frozen] = 0.0
    graph.fold(20, 18, between(graph.poses[18], graph.poses[20]), C)
    graph.solve()
    T = between(graph.poses[18], graph.poses[20])
    _, expected = compose_uncertain(graph.poses[18], graph.covariances[18], T, C)
    np.testing.assert_allclose(graph.covariances[20], expected, rtol=1e-6, atol=2e-8)  # of the root
    reach = graph.reach(18)
    assert reach[18] == 0.0
    assert reach[20] == pytest.approx(3.0 * math.sqrt(9e-4), rel=0.02)


def test_nothing_is_folded_twice_or_into_itself():
    truth = square(n=2)
    graph = grown(truth)
    folded(graph, truth, 7, 1)
    known = graph.edges
    folded(graph, truth, 7, 2)
    folded(graph, truth, 1, 7)  # 7 is 1 by now
    folded(graph, truth, 0, 3)  # the first node says where the map lies
    assert graph.hosts.tolist() == [0, 1, 2, 3, 4, 5, 6, 1, 8]
    np.testing.assert_array_equal(graph.edges.i, known.i)


def test_a_copy_does_not_change():
    truth = square()
    graph = grown(truth[:20], drift=(0.0, 0.0, 0.004))
    still = copy(graph)
    before = still.edges
    graph.extend(np.array([1.0, 0.0, 0.0]), Q, 1.0)
    folded(graph, truth, 10, 3)
    graph.add_closure(0, 20, np.zeros(3), FIRM)
    graph.solve()
    assert len(still) == 20
    for one, other in zip(still.edges, before, strict=True):
        np.testing.assert_array_equal(one, other)
    still.solve()
    assert not still.is_folded.any()


def test_roots_follow_each_change_of_the_graph():
    """The roots are kept between changes; read them before each one."""
    graph = grown(square(3))
    assert graph.roots.tolist() == [0] * len(graph)
    n = len(graph)
    graph.add_root(np.zeros(3), np.zeros((3, 3)))
    assert graph.roots.tolist() == [*[0] * n, n]
    lone = copy(graph)
    lone.fold(n, 1, np.zeros(3), np.zeros((3, 3)))
    assert lone.roots.tolist() == [0] * (n + 1)
    graph.extend(np.array([1.0, 0.0, 0.0]), 1e-4 * np.eye(3), 1.0)
    assert graph.roots.tolist() == [*[0] * n, n, n]
    snapshot = copy(graph)
    graph.add_closure(0, n, np.zeros(3), np.eye(3))
    assert graph.roots.tolist() == [0] * (n + 2)
    assert snapshot.roots.tolist() == [*[0] * n, n, n]
    chain = grown(square(3))
    assert not chain.roots.any()
    chain.cut(n - 1)
    assert chain.roots.tolist() == [*[0] * (n - 1), n - 1]
