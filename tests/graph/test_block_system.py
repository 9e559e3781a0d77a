import numpy as np
import pytest

from impslam.geometry import se2
from impslam.graph.block_system import add_relative, clear_system, empty_system, solve_system


def dense(system):
    k = len(system.diagonal)
    H = np.zeros((3 * k, 3 * k))
    for a in range(k):
        H[3 * a : 3 * a + 3, 3 * a : 3 * a + 3] += system.diagonal[a]
    for i, j, B in zip(system.i, system.j, system.off, strict=True):
        H[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] += B
        H[3 * j : 3 * j + 3, 3 * i : 3 * i + 3] += B.T
    return H


def random_system(k, extra, seed=0, fixed=()):
    rng = np.random.default_rng(seed)
    i = np.r_[np.arange(k - 1), rng.integers(0, k - 1, extra)]
    j = np.r_[np.arange(1, k), i[k - 1 :] + 1 + rng.integers(0, k - 1 - i[k - 1 :])]
    poses = rng.normal(0, 3, (k, 3))
    m, held = len(i), np.isin(np.arange(k), fixed)
    system = empty_system(i, j, held)
    clear_system(system)
    J = rng.normal(0, 1, (m, 5, 3))
    H, g = np.einsum("mra,mrb->mab", J, J), rng.normal(0, 1, (m, 3))
    for row in range(m):
        add_relative(system, row, poses, H[row], g[row])
    return system, poses, H, g


def test_blocks_are_the_derivatives_of_relative_poses():
    system, poses, H, g = random_system(6, 5)
    J = np.zeros((3 * len(H), 18))
    for row, (i, j) in enumerate(zip(system.i, system.j, strict=True)):
        for b in range(18):
            step = np.zeros(18)
            step[b] = 1e-6
            one, two = poses + step.reshape(6, 3), poses - step.reshape(6, 3)
            d = se2.between(one[i], one[j]) - se2.between(two[i], two[j])
            J[3 * row : 3 * row + 3, b] = d / 2e-6
    W = np.zeros((len(J), len(J)))
    for row in range(len(H)):
        W[3 * row : 3 * row + 3, 3 * row : 3 * row + 3] = H[row]
    np.testing.assert_allclose(dense(system), J.T @ W @ J, atol=1e-6)
    np.testing.assert_allclose(system.gradient.ravel(), J.T @ g.ravel(), atol=1e-7)


@pytest.mark.parametrize("extra", [0, 10, 60])
def test_the_solution_is_that_of_dense_algebra(extra):
    system, *_ = random_system(30, extra, extra, fixed=[0])
    x = np.empty((30, 3))
    steps = solve_system(system, x)
    H, g = dense(system), system.gradient.ravel()
    assert np.linalg.norm(H @ x.ravel() + g) <= 1.1e-3 * np.linalg.norm(g)
    assert steps < 60
    assert (x[0] == 0.0).all()
    if extra == 0:
        assert steps <= 3  # a chain is solved by its own factors, damping aside


def test_unconstrained_poses_stay():
    system, *_ = random_system(10, 4, fixed=[0])
    system.diagonal[9], system.gradient[9] = 0.0, 0.0
    system.off[(system.i == 9) | (system.j == 9)] = 0.0
    x = np.empty((10, 3))
    solve_system(system, x)
    assert (x[9] == 0.0).all()
    assert np.isfinite(x).all()
