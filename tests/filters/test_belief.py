"""The sparse, triangular, in-place belief against plain dense algebra."""

import numpy as np
import pytest

from impslam.filters.belief import POSE, GaussianBelief
from impslam.filters.update import Rows, gain, innovation_covariance, solve


def random_belief(rng, landmarks=70):
    """Return a belief with landmarks of sizes 2 and 3 and a full random covariance."""
    belief = GaussianBelief(rng.normal(size=3), np.eye(3))
    dims = [2 if i % 3 else 3 for i in range(landmarks)]
    offsets = [belief.extend(rng.normal(size=d), rng.normal(size=(d, 3)), np.eye(d)) for d in dims]
    n = belief.n
    A = rng.normal(size=(n, n))
    P = A @ A.T / n + np.eye(n)
    belief.P[:n, :n] = np.tril(P)
    return belief, P, offsets, dims


def random_rows(rng, n, offsets, dims, some):
    """Return H by rows and dense, each landmark seen with two numbers, R, and the entries."""
    count = 2 * len(some)
    H, R, entries = np.zeros((count, n)), np.zeros((count, count)), [0, 1, 2]
    slots, blocks = np.zeros(count, np.int64), np.repeat(np.arange(0, count, 2), 2)
    h_pose, h_m, noise = rng.normal(size=(count, 3)), np.zeros((count, 3)), np.zeros((count, 2))
    for i, k in enumerate(some):
        two = slice(2 * i, 2 * i + 2)
        A = rng.normal(size=(2, 2))
        noise[two] = R[two, two] = A @ A.T + np.eye(2)
        slots[two] = len(entries)
        entries += range(offsets[k], offsets[k] + dims[k])
        h_m[two, : dims[k]] = rng.normal(size=(2, dims[k]))
        H[two, :POSE], H[two, offsets[k] : offsets[k] + dims[k]] = h_pose[two], h_m[two, : dims[k]]
    errors, h_error = np.where(np.arange(count) % 3, slots[-1], -1), rng.normal(size=count)
    H[np.arange(count), entries[slots[-1]]] += np.where(errors < 0, 0.0, h_error)
    return Rows(slots, blocks, noise, h_pose, h_m, errors, h_error), H, R, np.array(entries)


@pytest.mark.parametrize("landmarks", [70, 150])  # one panel of P, and several
def test_update_is_the_kalman_update(rng, landmarks):
    belief, P, offsets, dims = random_belief(rng, landmarks)
    rows, H, R, entries = random_rows(rng, belief.n, offsets, dims, [5, 0, 69, 33])
    innovation, before = rng.normal(size=len(H)), rng.normal(size=belief.n)
    before[entries[rows.errors.max()]] = 0.0  # a shared error is considered, not moved
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    np.testing.assert_allclose(innovation_covariance(rows, belief.P, entries)[0], S, atol=1e-10)
    U, y, step, log_det = solve(rows, belief.P, entries, innovation, before[entries])
    assert log_det == pytest.approx(np.linalg.slogdet(S)[1])
    expected = K @ (innovation + H @ before)
    np.testing.assert_allclose(step, expected[entries], atol=1e-10)
    W_T, step, of_pose = gain(rows, belief.P, belief.n, entries, U, y)
    np.testing.assert_allclose(of_pose[:, : belief.n], P[:POSE], atol=1e-12)
    np.testing.assert_allclose(step[: belief.n], expected, atol=1e-10)
    assert not W_T[:, belief.n :].any()
    belief.subtract(W_T, W_T)
    np.testing.assert_allclose(belief.covariance, P - K @ H @ P, atol=1e-10)


@pytest.mark.parametrize("value", [-100.0, np.nan, np.inf])
def test_what_has_no_factor_has_no_step(rng, value):
    belief, _, offsets, dims = random_belief(rng)
    rows, _, _, entries = random_rows(rng, belief.n, offsets, dims, [5, 0, 69, 33])
    rows.noise[3, 1] = value
    assert np.isnan(solve(rows, belief.P, entries, np.zeros(8), np.zeros(len(entries)))[-1])


def test_innovation_blocks_are_h_p_ht(rng):
    belief, P, offsets, dims = random_belief(rng)
    threes = [i for i, d in enumerate(dims) if d == 3]
    h_pose, h_m = rng.normal(size=(len(threes), 2, 3)), rng.normal(size=(len(threes), 2, 3))
    blocks = belief.innovation_blocks(np.array([offsets[i] for i in threes]), h_pose, h_m)
    for b, i in enumerate(threes):
        H = np.zeros((2, belief.n))
        H[:, :POSE], H[:, offsets[i] : offsets[i] + 3] = h_pose[b], h_m[b]
        np.testing.assert_allclose(blocks[b], H @ P @ H.T, atol=1e-10)


def test_move_is_f_p_ft_plus_q(rng):
    belief, P, _, _ = random_belief(rng)
    F, Q = np.eye(belief.n), np.diag([0.1, 0.2, 0.3])
    F[0, 2], F[1, 2] = 0.7, -1.3
    belief.move(0.7, -1.3, Q)
    expected = F @ P @ F.T
    expected[:POSE, :POSE] += Q
    np.testing.assert_allclose(belief.covariance, expected, atol=1e-10)


def test_extend_has_the_full_cross_covariance(rng):
    belief, P, _, _ = random_belief(rng)
    n, J, N = belief.n, rng.normal(size=(2, 3)), np.array([[2.0, 0.3], [0.3, 1.0]])
    belief.extend(np.ones(2), J, N)
    G = np.vstack([np.eye(n), np.hstack([J, np.zeros((2, n - 3))])])
    expected = G @ P @ G.T
    expected[n:, n:] += N
    np.testing.assert_allclose(belief.covariance, expected, atol=1e-10)


@pytest.mark.parametrize("count", [1, 69])
def test_keep_marginalises(rng, count):
    belief, P, offsets, dims = random_belief(rng)
    mean = belief.mean[: belief.n].copy()
    gone = set(rng.choice(len(dims), count, replace=False).tolist())
    stays = np.ones(belief.n, bool)
    for i in gone:
        stays[offsets[i] : offsets[i] + dims[i]] = False
    indices = np.flatnonzero(stays)
    belief.keep(indices)
    np.testing.assert_allclose(belief.covariance, P[np.ix_(indices, indices)])
    np.testing.assert_allclose(belief.mean[: belief.n], mean[indices])
