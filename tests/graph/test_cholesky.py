import numpy as np
import pytest

from impslam.graph.block_system import add_relative, clear_system, empty_system
from impslam.graph.cholesky import empty_factor, factorise, selected_inverse, substitute
from impslam.graph.elimination import eliminate

FIXED = (0, 7)


def random_system(k, extra, seed):
    rng = np.random.default_rng(seed)
    i = np.r_[np.arange(k - 1), rng.integers(0, k - 1, extra)]
    j = np.r_[np.arange(1, k), i[k - 1 :] + 1 + rng.integers(0, k - 1 - i[k - 1 :])]
    swap = rng.random(len(i)) < 0.5
    i, j = np.where(swap, j, i), np.where(swap, i, j)
    system = empty_system(i, j, np.isin(np.arange(k), FIXED))
    clear_system(system)
    J = rng.normal(0, 1, (len(i), 5, 3))
    H, g = np.einsum("mra,mrb->mab", J, J), rng.normal(0, 1, (len(i), 3))
    poses = rng.normal(0, 3, (k, 3))
    for row in range(len(i)):
        add_relative(system, row, poses, H[row], g[row])
    return system


def dense(system):
    k = len(system.diagonal)
    H = np.zeros((3 * k, 3 * k))
    for a in range(k):
        H[3 * a : 3 * a + 3, 3 * a : 3 * a + 3] += system.diagonal[a]
    for i, j, B in zip(system.i, system.j, system.off, strict=True):
        H[3 * i : 3 * i + 3, 3 * j : 3 * j + 3] += B
        H[3 * j : 3 * j + 3, 3 * i : 3 * i + 3] += B.T
    return H


@pytest.mark.parametrize(("k", "extra"), [(8, 0), (12, 5), (60, 40), (60, 400)])
def test_solutions_and_inverses_are_those_of_the_dense_matrix(k, extra):
    system = random_system(k, extra, seed=k + extra)
    factor = empty_factor(eliminate(system.i, system.j, system.fixed))
    assert factorise(system, 0.0, factor) == -1
    H, b, x = dense(system), np.random.default_rng(1).normal(0, 1, (k, 3)), np.empty((k, 3))
    substitute(factor, b, x)
    np.testing.assert_allclose(H @ x.ravel(), b.ravel(), atol=1e-8)
    inverse = np.linalg.inv(H).reshape(k, 3, k, 3)
    diagonal, _ = selected_inverse(factor)
    scale = np.abs(inverse).max()
    for v in range(k):
        np.testing.assert_allclose(diagonal[v], inverse[v, :, v], atol=1e-9 * scale)


def test_damping_multiplies_the_diagonal():
    system = random_system(20, 15, seed=3)
    factor = empty_factor(eliminate(system.i, system.j, system.fixed))
    assert factorise(system, 0.5, factor) == -1
    H, x = dense(system), np.empty((20, 3))
    substitute(factor, system.gradient, x)
    H += 0.5 * np.diag(np.diag(H))
    np.testing.assert_allclose(x.ravel(), np.linalg.solve(H, system.gradient.ravel()), atol=1e-8)


def test_an_unconstrained_pose_is_named():
    system = random_system(12, 3, seed=4)
    system.diagonal[5], touching = 0.0, (system.i == 5) | (system.j == 5)
    system.off[touching] = 0.0
    factor = empty_factor(eliminate(system.i, system.j, system.fixed))
    assert factorise(system, 0.0, factor) == 5


@pytest.mark.parametrize("seed", range(20))
def test_the_pattern_is_that_of_elimination(seed):
    rng = np.random.default_rng(seed)
    k = 40
    i, j = rng.integers(0, k, (2, 70))
    fixed = rng.random(k) < 0.1
    pattern = eliminate(i, j, fixed)
    assert sorted(pattern.step) == list(range(k))
    full = np.eye(k, dtype=bool)
    for a, b in zip(i, j, strict=True):
        if not (fixed[a] or fixed[b]):
            full[pattern.step[a], pattern.step[b]] = full[pattern.step[b], pattern.step[a]] = True
    for s in range(k):
        below = np.flatnonzero(full[s + 1 :, s]) + s + 1
        rows = pattern.rows[pattern.starts[s] : pattern.starts[s + 1]]
        np.testing.assert_array_equal(rows, below)
        full[np.ix_(below, below)] = True
    for r in range(k):
        for t in range(pattern.row_starts[r], pattern.row_starts[r + 1]):
            q = pattern.blocks[t]
            assert pattern.rows[q] == r
            assert pattern.starts[pattern.columns[t]] <= q < pattern.starts[pattern.columns[t] + 1]


def test_a_chain_fills_nothing_in():
    k = 200
    pattern = eliminate(np.arange(k - 1), np.arange(1, k), np.zeros(k, bool))
    assert len(pattern.rows) == k - 1


def test_a_lattice_fills_in_little():
    side = 30
    at = np.arange(side * side).reshape(side, side)
    i, j = np.r_[at[:, :-1].ravel(), at[:-1].ravel()], np.r_[at[:, 1:].ravel(), at[1:].ravel()]
    pattern = eliminate(i, j, np.zeros(side * side, bool))
    assert len(pattern.rows) < 12 * side * side  # row by row it is 30 a pose
