"""The sparse, triangular, in-place belief against plain dense algebra."""

import numpy as np
import pytest

from impslam.filters.belief import POSE, GaussianBelief
from impslam.filters.update import among, gain, innovation_covariance, put_rows, solve


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
    """Return H of the whole state, R, and the entries; each landmark is seen with two numbers.

    The last landmark stands for an error that the others share, too.
    """
    rows, entries = 2 * len(some), [0, 1, 2]
    H, R = np.zeros((rows, n)), np.zeros((rows, rows))
    for i, k in enumerate(some):
        two, A = slice(2 * i, 2 * i + 2), rng.normal(size=(2, 2))
        R[two, two] = A @ A.T + np.eye(2)
        H[two, :POSE] = rng.normal(size=(2, POSE))
        H[two, offsets[k] : offsets[k] + dims[k]] = rng.normal(size=(2, dims[k]))
        entries += range(offsets[k], offsets[k] + dims[k])
    H[:, entries[-1]] += np.where(np.arange(rows) % 3, rng.normal(size=rows), 0.0)
    return H, R, np.array(entries)


@pytest.mark.parametrize("landmarks", [70, 150])  # one panel of P, and several
def test_update_is_the_kalman_update(rng, landmarks):
    belief, P, offsets, dims = random_belief(rng, landmarks)
    H, R, entries = random_rows(rng, belief.n, offsets, dims, [5, 0, 69, 33])
    innovation, before = rng.normal(size=len(H)), rng.normal(size=belief.n)
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    H_seen = np.ascontiguousarray(H[:, entries])
    found = innovation_covariance(H_seen, among(belief.P, entries), R)
    np.testing.assert_allclose(found, S, atol=1e-10)
    moving = len(entries) - 1
    before[np.setdiff1d(np.arange(belief.n), entries[:moving])] = 0.0
    system = H_seen, R, innovation
    G, step, (nis, log_det) = solve(system, belief.P, entries, moving, before[entries])
    off = innovation + H @ before
    assert nis == pytest.approx(off @ np.linalg.solve(S, off))
    assert log_det == pytest.approx(np.linalg.slogdet(S)[1])
    np.testing.assert_allclose(step[:-1], (K @ off)[entries[:-1]], atol=1e-10)
    assert step[-1] == 0.0
    W_T, step, of_pose = gain(belief.P, belief.n, entries, G)
    np.testing.assert_allclose(of_pose, P[:POSE], atol=1e-12)
    np.testing.assert_allclose(step, K @ off, atol=1e-10)
    belief.subtract(W_T)
    np.testing.assert_allclose(belief.covariance, P - K @ H @ P, atol=1e-10)


@pytest.mark.parametrize("value", [-100.0, np.nan, np.inf])
def test_what_has_no_factor_has_no_step(rng, value):
    belief, _, offsets, dims = random_belief(rng)
    H, R, entries = random_rows(rng, belief.n, offsets, dims, [5, 0, 69, 33])
    R[3, 3] = value
    system = np.ascontiguousarray(H[:, entries]), R, np.zeros(8)
    *_, (_, log_det) = solve(system, belief.P, entries, 3, np.zeros(len(entries)))
    assert np.isnan(log_det)


def test_kinds_are_put_one_after_another(rng):
    """Blocks of both kinds in their rows and entries, angles wrapped, and nothing else."""
    H, R, nu = np.zeros((5, 9)), np.zeros((5, 5)), np.zeros(5)
    z_D_pose, z_D_m, noise = (rng.normal(size=(2, 2, size)) for size in (3, 2, 2))
    predicted = np.array([[1.0, 3.0], [2.0, 0.5]]), z_D_pose, z_D_m
    seen = np.array([[1.5, -3.0], [2.0, 0.5]]), noise
    put_rows((H, R, nu), (1, 4), seen, predicted, np.array([False, True]))
    np.testing.assert_allclose(nu, [0.0, 0.5, 2.0 * np.pi - 6.0, 0.0, 0.0])
    rows = slice(1, 5)
    expected_H, expected_R = np.zeros_like(H), np.zeros_like(R)
    expected_H[rows, :POSE] = z_D_pose.reshape(4, POSE)
    expected_H[1:3, 4:6], expected_H[3:5, 6:8] = z_D_m
    expected_R[1:3, 1:3], expected_R[3:5, 3:5] = noise
    np.testing.assert_array_equal(H, expected_H)
    np.testing.assert_array_equal(R, expected_R)


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
