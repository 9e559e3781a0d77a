"""The sparse, triangular, in-place belief against plain dense algebra."""

import numpy as np
import pytest

from impslam.filters.belief import POSE, GaussianBelief, Rows


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
    rows, H = Rows(2 * len(some), 3), np.zeros((2 * len(some), n))
    for i, k in enumerate(some):
        for r in (2 * i, 2 * i + 1):
            rows.offsets[r], rows.dims[r] = offsets[k], dims[k]
            rows.h_pose[r], rows.h_m[r, : dims[k]] = rng.normal(size=3), rng.normal(size=dims[k])
            H[r, :POSE] = rows.h_pose[r]
            H[r, offsets[k] : offsets[k] + dims[k]] = rows.h_m[r, : dims[k]]
    return rows, H


def test_update_is_the_kalman_update(rng):
    belief, P, offsets, dims = random_belief(rng)
    rows, H = random_rows(rng, belief.n, offsets, dims, [5, 0, 69, 33])
    R, innovation = np.diag(rng.uniform(0.1, 1.0, len(H))), rng.normal(size=len(H))
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    gain = belief.gain(rows, R)
    np.testing.assert_allclose(gain.step(innovation), K @ innovation, atol=1e-10)
    delta = rng.normal(size=belief.n)
    np.testing.assert_allclose(rows.apply(delta), H @ delta, atol=1e-10)
    belief.shrink(gain)
    np.testing.assert_allclose(belief.covariance, P - K @ H @ P, atol=1e-10)


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
