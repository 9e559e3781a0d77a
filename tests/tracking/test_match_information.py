"""Information of a match: what errors of normals add is subtracted, and the pose goes with it."""

import numpy as np
import pytest

from impslam.tracking.match_information import discount_spurious

GUESS = np.array([0.3, -0.2, 3.1])
W = np.array([4.0, 4.0, 40.0])


def scan_information(rng):
    """Return H (3, 3) that says little about x."""
    J = rng.standard_normal((40, 3)) * [0.02, 1.0, 2.0]
    return J.T @ J


def fused(H, optimum, W, guess):
    """Return the pose (3,) that fits both, for small differences of heading."""
    return np.linalg.solve(H + np.diag(W), H @ optimum + W * guess)


@pytest.mark.parametrize("share", [0.3, 0.9, 1.0, 5.0])
def test_a_discounted_pose_fits_the_scan_by_what_is_left_and_the_prior(rng, share):
    """The scan keeps its optimum. Here all spurious information is along one direction."""
    for _ in range(10):
        H, optimum = scan_information(rng), GUESS + rng.normal(0.0, 0.01, 3)
        u = rng.standard_normal(3)
        Hu = H @ u
        S = share * np.outer(Hu, Hu) / (u @ Hu)
        left = H - min(share, 1.0) / share * S
        pose, after = fused(H, optimum, W, GUESS), H.copy()
        discount_spurious(after, S, W, GUESS, pose)
        np.testing.assert_allclose(after, left, atol=1e-9 * np.abs(H).max())
        np.testing.assert_allclose(pose, fused(left, optimum, W, GUESS), atol=1e-9)


def test_the_direction_of_the_largest_share_is_found(rng):
    for _ in range(20):
        H, root = scan_information(rng), rng.standard_normal((2, 3)) * [[0.01], [0.002]]
        S, after = root.T @ root, H.copy()
        shares = np.linalg.eigvals(np.linalg.solve(H, S)).real
        discount_spurious(after, S, W, GUESS, GUESS.copy())
        removed = np.linalg.eigvals(np.linalg.solve(H, H - after)).real
        assert np.linalg.matrix_rank(H - after, tol=1e-6 * np.abs(H - after).max()) == 1
        assert max(removed) == pytest.approx(min(max(shares), 1.0), rel=0.02)


@pytest.mark.parametrize(
    "H", [np.zeros((3, 3)), np.diag([0.0, 1.0, 1.0]), np.diag([1.0, 1.0, 0.0])]
)
def test_a_scan_that_shows_nothing_stays_as_it_is(H):
    after, pose = H.copy(), GUESS + 0.1
    discount_spurious(after, 0.1 * np.eye(3), W, GUESS, pose)
    np.testing.assert_array_equal(after, H)
    np.testing.assert_array_equal(pose, GUESS + 0.1)


def test_nothing_spurious_changes_nothing(rng):
    H, pose = scan_information(rng), GUESS + 0.1
    after = H.copy()
    discount_spurious(after, np.zeros((3, 3)), W, GUESS, pose)
    np.testing.assert_array_equal(after, H)
    np.testing.assert_array_equal(pose, GUESS + 0.1)
