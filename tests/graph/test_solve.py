import numpy as np
import pytest
from tests.graph.pose_graphs import dense_information, errors_of, random_graph
from tests.numeric import jacobian

from impslam.errors import NumericalError
from impslam.geometry import se2
from impslam.geometry.angles import wrap
from impslam.graph.block_system import empty_system
from impslam.graph.edges import Costs, linearise
from impslam.graph.solve import Limits, marginals, solve
from impslam.types import Edges

FIRST = np.array([0])


def close(poses, others, atol=1e-9):
    difference = poses - others
    difference[:, 2] = wrap(difference[:, 2])
    np.testing.assert_allclose(difference, 0.0, atol=atol)


def test_gradient_and_information_are_derivatives_of_the_cost():
    truth, edges, _ = random_graph(8, 5, seed=1)
    rng = np.random.default_rng(2)
    poses, free = truth + rng.normal(0, 0.03, truth.shape), np.zeros(8, bool)
    edges = edges._replace(kernel=np.where(np.arange(len(edges.i)) < 7, np.inf, 9.0))
    system = empty_system(edges.i, edges.j, free)
    costs = Costs(np.empty(len(edges.i)), np.empty(len(edges.i)))

    def cost(at):
        return linearise(at, edges, 2.0, empty_system(edges.i, edges.j, free), costs)

    linearise(poses, edges, 2.0, system, costs)
    H, _, _ = dense_information(poses, edges, (), costs.weights)
    for b in range(24):
        step = np.zeros(24)
        step[b] = 1e-6
        step = step.reshape(8, 3)
        slope = (cost(poses + step) - cost(poses - step)) / 2e-6
        assert system.gradient.ravel()[b] == pytest.approx(slope / 2, rel=1e-5, abs=1e-2)
    diagonal = np.concatenate([np.diag(block) for block in system.diagonal])
    np.testing.assert_allclose(diagonal, np.diag(H), rtol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_noiseless_graphs_are_exact(seed):
    truth, edges, _ = random_graph(60, 25, seed, noise=0.0)
    rng = np.random.default_rng(seed)
    start = truth + rng.normal(0, 0.1, truth.shape)
    start[0] = truth[0]
    solution = solve(start, edges, FIRST)
    close(solution.poses, truth)
    assert solution.chi2 < 1e-12


def test_the_optimum_has_no_gradient_and_a_plausible_chi_square():
    _, edges, start = random_graph(80, 60, seed=3)
    solution = solve(start, edges, FIRST)
    _, J, W = dense_information(solution.poses, edges)
    slope = (J.T @ W @ errors_of(solution.poses, edges).ravel())[3:]
    sigmas = np.sqrt(marginals(solution.poses, edges, FIRST)[1:].diagonal(axis1=1, axis2=2))
    assert np.abs(slope * sigmas.ravel()).max() < 1e-3
    degrees = 3 * (len(edges.i) - 79)
    assert abs(solution.chi2 - degrees) < 4 * np.sqrt(2 * degrees)
    assert solution.cost == pytest.approx(solution.chi2)


def test_a_rigid_motion_of_everything_moves_the_solution():
    _, edges, start = random_graph(50, 20, seed=4)
    edges = edges._replace(kernel=np.where(np.arange(len(edges.i)) < 49, np.inf, 25.0))
    motion = np.array([30.0, -12.0, 2.5])
    one = solve(start, edges, FIRST)
    two = solve(se2.compose(motion, start), edges, FIRST)
    close(two.poses, se2.compose(motion, one.poses), 1e-6)
    np.testing.assert_allclose(two.weights, one.weights, atol=1e-6)


def test_the_order_of_edges_makes_no_difference():
    _, edges, start = random_graph(50, 30, seed=5)
    order = np.random.default_rng(0).permutation(len(edges.i))
    one, two = (solve(start, e, FIRST) for e in (edges, Edges(*(a[order] for a in edges))))
    close(two.poses, one.poses, 1e-7)


def test_an_edge_equals_its_inverse():
    _, edges, start = random_graph(40, 15, seed=6, noise=0.01)
    J = np.array([jacobian(se2.inverse, T_j_i) for T_j_i in se2.inverse(edges.T_i_j)])
    turned = Edges(
        edges.j,
        edges.i,
        se2.inverse(edges.T_i_j),
        J.transpose(0, 2, 1) @ edges.information @ J,
        edges.kernel,
    )
    close(solve(start, turned, FIRST).poses, solve(start, edges, FIRST).poses, 1e-5)


def false_closure(seed):
    """A graph of true closures, and the same with a false one that claims centimetres."""
    truth, edges, start = random_graph(100, 20, seed)
    edges = edges._replace(kernel=np.where(np.arange(len(edges.i)) < 99, np.inf, 25.0))
    wrong = Edges(
        np.array([10]),
        np.array([90]),
        se2.between(truth[10], truth[90])[None] + [3.0, -2.0, 1.0],
        edges.information[-1:],
        np.array([25.0]),
    )
    return edges, Edges(*(np.concatenate(pair) for pair in zip(edges, wrong, strict=True))), start


@pytest.mark.parametrize("seed", range(5))
def test_a_false_closure_is_rejected_and_true_ones_are_kept(seed):
    edges, both, start = false_closure(seed)
    clean, solution = solve(start, edges, FIRST), solve(start, both, FIRST)
    assert solution.weights[-1] < 1e-4
    assert (solution.weights[99:-1] > 0.01).sum() >= 19
    sigmas = np.sqrt(marginals(clean.poses, edges, FIRST).diagonal(axis1=1, axis2=2)) + 1e-9
    close((solution.poses - clean.poses) / sigmas, 0 * sigmas, 0.3)


def test_a_true_loop_that_closes_much_drift_is_kept_when_graduated():
    _, edges, start = random_graph(100, 3, seed=8)
    weak = edges.information.copy()
    weak[:99] /= 400.0  # dead reckoning is worse than told by the start that it gave
    rng = np.random.default_rng(0)
    steps = edges.T_i_j[:99] + rng.normal(0, 1, (99, 3)) * [0.2, 0.2, 0.06]
    T_i_j = np.concatenate([steps, edges.T_i_j[99:]])
    kernel = np.where(np.arange(102) < 99, np.inf, 25.0)
    edges = Edges(edges.i, edges.j, T_i_j, weak, kernel)
    for k in range(1, 100):
        start[k] = se2.compose(start[k - 1], T_i_j[k - 1])
    solution = solve(start, edges, FIRST)
    plain = solve(start, edges, FIRST, Limits(graduated=False))
    assert solution.cost <= plain.cost
    assert (solution.weights[99:] > 0.25).all()


@pytest.mark.parametrize("seed", range(3))
def test_marginals_are_those_of_the_dense_inverse(seed):
    _, edges, start = random_graph(40, 20, seed)
    fixed = np.array([0, 17])
    solution = solve(start, edges, FIRST)
    H, _, _ = dense_information(solution.poses, edges, fixed)
    P = np.zeros((120, 120))
    free = np.repeat(~np.isin(np.arange(40), fixed), 3)
    P[np.ix_(free, free)] = np.linalg.inv(H)
    covariances = marginals(solution.poses, edges, fixed)
    for v in range(40):
        block = P[3 * v : 3 * v + 3, 3 * v : 3 * v + 3]
        np.testing.assert_allclose(covariances[v], block, rtol=1e-5, atol=1e-10)


def test_marginals_are_the_covariance_of_solutions():
    runs, chi2 = 400, []
    for seed in range(runs):
        truth, edges, _ = random_graph(12, 6, seed=100 + seed)
        solution = solve(truth, edges, FIRST)
        error = solution.poses[-1] - truth[-1]
        error[2] = wrap(error[2])
        covariance = marginals(solution.poses, edges, FIRST)[-1]
        chi2.append(error @ np.linalg.solve(covariance, error))
    assert abs(np.mean(chi2) - 3.0) < 4 * np.sqrt(6.0 / runs)


def bad(edges, **changes):
    return edges._replace(
        **{name: change(getattr(edges, name).copy()) for name, change in changes.items()}
    )


def put(value, *at):
    def change(array):
        array[at] = value
        return array

    return change


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"T_i_j": put(np.nan, 3, 1)}, "edge 3 is not finite"),
        ({"information": put(np.inf, 4, 1, 1)}, "edge 4 is not finite"),
        ({"i": put(99, 2)}, "not in 0 to 19"),
        ({"kernel": put(0.0, 2)}, "not positive"),
        ({"i": put(7, 6)}, "edge 6 joins pose 7 to itself"),
        ({"information": put(0.0, slice(None), 2, slice(None))}, "not determined"),
    ],
)
def test_what_has_no_solution_is_named(changes, said):
    _, edges, start = random_graph(20, 5)
    before = start.copy()
    with pytest.raises(NumericalError, match=said):
        solve(start, bad(edges, **changes), FIRST)
    np.testing.assert_array_equal(start, before)


def test_unconnected_poses_are_named():
    _, edges, start = random_graph(20, 0)
    loose = Edges(*(np.delete(a, 11, axis=0) for a in edges))
    for function in (solve, marginals):
        with pytest.raises(NumericalError, match="connect pose 12 "):
            function(start, loose, FIRST)
    with pytest.raises(NumericalError, match="connect pose 0 "):
        solve(start, edges, np.empty(0, np.int64))
    with pytest.raises(NumericalError, match="`fixed` names a pose that is not in 0 to 19"):
        solve(start, edges, np.array([20]))
    start[4] = np.nan
    with pytest.raises(NumericalError, match="pose 4 is not finite"):
        solve(start, edges, FIRST)


def test_too_few_iterations_are_no_convergence():
    _, edges, start = random_graph(60, 20)
    with pytest.raises(NumericalError, match="no convergence"):
        solve(start, edges, FIRST, Limits(iterations=1))


def test_one_pose_and_no_edges_is_solved():
    none = Edges(*(np.empty((0, *s)) for s in ((), (), (3,), (3, 3), ())))
    solution = solve(np.ones((1, 3)), none, FIRST)
    np.testing.assert_array_equal(solution.poses, np.ones((1, 3)))
    np.testing.assert_array_equal(marginals(np.ones((1, 3)), none, FIRST), np.zeros((1, 3, 3)))
