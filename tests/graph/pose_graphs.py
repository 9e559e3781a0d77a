"""Small pose graphs with a known truth."""

import numpy as np

from impslam.geometry import se2
from impslam.geometry.angles import wrap
from impslam.types import Edges


def grid_walk(n, rng):
    """A walk with steps of 1 m and turns of up to 90 degrees."""
    steps = np.c_[np.full(n, 1.0), np.zeros(n), rng.choice([0.0, np.pi / 2, -np.pi / 2, 0.3], n)]
    poses = np.zeros((n, 3))
    poses[0] = [2.0, -1.0, 3.0]
    for k in range(1, n):
        poses[k] = se2.compose(poses[k - 1], steps[k])
    return poses


def random_information(e, rng):
    J = rng.normal(0, 1, (e, 5, 3)) * [20.0, 20.0, 60.0]
    return np.einsum("era,erb->eab", J, J)


def random_graph(n, closures, seed=0, noise=1.0):
    """Return true poses, noisy edges of a chain with closures, and a start by dead reckoning."""
    rng = np.random.default_rng(seed)
    truth = grid_walk(n, rng)
    i = np.r_[np.arange(n - 1), rng.integers(0, n - 2, closures)]
    j = np.r_[np.arange(1, n), i[n - 1 :] + 2 + rng.integers(0, n - 2 - i[n - 1 :])]
    information = random_information(len(i), rng)
    error = np.einsum(
        "eab,eb->ea", np.linalg.cholesky(np.linalg.inv(information)), rng.normal(0, 1, (len(i), 3))
    )
    T_i_j = se2.between(truth[i], truth[j]) + noise * error
    T_i_j[:, 2] = wrap(T_i_j[:, 2])
    return (
        truth,
        Edges(i, j, T_i_j, information, np.full(len(i), np.inf)),
        reckoned(truth[0], T_i_j, n),
    )


def reckoned(first, T_i_j, n):
    start = np.tile(first, (n, 1))
    for k in range(1, n):
        start[k] = se2.compose(start[k - 1], T_i_j[k - 1])
    return start


def errors_of(poses, edges):
    error = se2.between(poses[edges.i], poses[edges.j]) - edges.T_i_j
    error[:, 2] = wrap(error[:, 2])
    return error


def dense_information(poses, edges, fixed=(0,), weights=None):
    """Return J^T W J of the poses that are not fixed, J by central differences."""
    n, e = len(poses), len(edges.i)
    J = np.zeros((3 * e, 3 * n))
    for b in range(3 * n):
        step = np.zeros(3 * n)
        step[b] = 1e-6
        step = step.reshape(n, 3)
        d = errors_of(poses + step, edges) - errors_of(poses - step, edges)
        d[:, 2] = wrap(d[:, 2])
        J[:, b] = d.ravel() / 2e-6
    W = np.zeros((3 * e, 3 * e))
    for row in range(e):
        w = 1.0 if weights is None else weights[row]
        W[3 * row : 3 * row + 3, 3 * row : 3 * row + 3] = w * edges.information[row]
    free = np.repeat(~np.isin(np.arange(n), fixed), 3)
    return (J.T @ W @ J)[np.ix_(free, free)], J, W
