"""The unscented filter: its transform, its square root, and where it beats the EKF."""

import numpy as np
import pytest
from tests.filters.worlds import MODELS, drive, observe, step

from impslam.filters.ekf import Ekf
from impslam.filters.square_root import SquareRootBelief
from impslam.filters.ukf import Unscented, UnscentedKalmanFilter, points
from impslam.types import Increment, Observation


def test_the_transform_is_exact_to_the_fourth_moment_along_each_column():
    """f(u) = u + c u^2 in each of two directions: mean c s^2, variance s^2 + 2 c^2 s^4."""
    s, c = np.array([0.5, 2.0]), 0.3
    changes = points(np.diag(s)) + c * points(np.diag(s)) ** 2
    found = Unscented.of(changes)
    np.testing.assert_allclose(found.shift, c * s**2, rtol=1e-12)
    covariance = found.slopes @ found.slopes.T + found.bends @ found.bends.T
    np.testing.assert_allclose(covariance, np.diag(s**2 + 2.0 * c**2 * s**4), rtol=1e-12)


def test_the_mean_of_an_uncertain_turn_is_that_of_the_arc():
    """Driven on after a turn known to 0.4 rad, the robot is on average nearer: by E[cos]."""
    belief, sigma = UnscentedKalmanFilter(), 0.4
    belief.start(np.zeros(3), np.diag([1e-9, 1e-9, sigma]) ** 2, MODELS)
    belief.predict(Increment(1.0, np.array([5.0, 0.0, 0.0]), 1e-12 * np.eye(3), 1.0))
    mean, P = belief.pose, belief.covariance
    e = np.exp(-0.5 * sigma**2)
    assert mean[0] == pytest.approx(5.0 * e, rel=1e-3)
    assert P[0, 0] == pytest.approx(25.0 * 0.5 * (1.0 - e**2) ** 2, rel=0.2)
    assert P[1, 1] == pytest.approx(25.0 * 0.5 * (1.0 - e**4), rel=0.05)


@pytest.mark.parametrize("sigma", [0.5, 2.0, 1000.0])
def test_a_robot_at_rest_stays_as_uncertain_of_its_heading(sigma):
    belief, P = UnscentedKalmanFilter(), np.diag([0.1, 0.2, sigma]) ** 2
    belief.start(np.zeros(3), P, MODELS)
    belief.predict(Increment(1.0, np.zeros(3), 1e-12 * np.eye(3), 1.0))
    np.testing.assert_allclose(belief.covariance, P, rtol=1e-6, atol=1e-9)


def both(rng, sigma):
    """Return an EKF and a UKF after the same drive, with noise told as sigma of the usual."""
    made = Ekf(), UnscentedKalmanFilter()
    steps = [(pose, motion, observe(pose, rng)) for pose, motion in drive(15, rng)]
    for belief in made:
        belief.start(np.zeros(3), 1e-16 * np.eye(3), MODELS)
        for _, motion, seen in steps:
            less = Increment(motion.stamp, motion.d_pose, sigma**2 * motion.covariance, 1.0)
            step(belief, less, tuple(o.with_noise(sigma**2 * o.R) for o in seen))
    return made


def test_with_little_noise_it_is_the_ekf():
    ekf, ukf = both(np.random.default_rng(1), 1e-4)
    # Their Jacobians differ by the noise of the data, which is not scaled.
    np.testing.assert_allclose(ukf.pose, ekf.pose, atol=3e-3)
    np.testing.assert_allclose(ukf.covariance, ekf.covariance, rtol=0.02, atol=1e-12)
    for a, b in zip(ukf.landmarks(), ekf.landmarks(), strict=True):
        np.testing.assert_allclose(a.covariance, b.covariance, rtol=0.05, atol=1e-12)


def test_a_correction_is_bayes_rule(rng):
    """Of any root and any measurement: (P^-1 + H^T H)^-1 and its gain."""
    belief = SquareRootBelief(np.zeros(3), np.diag([0.1, 0.2, 0.3]))
    for m in rng.normal(size=(4, 2)):
        belief.extend(m, rng.normal(size=(2, 3)), np.diag([0.3, 0.1]))
    P, S, n = belief.covariance, belief.S.copy(), belief.n
    H, y = rng.normal(size=(5, n)), rng.normal(size=5)
    of_state = H @ np.linalg.inv(S)
    after = np.linalg.inv(np.linalg.inv(P) + of_state.T @ of_state)
    moved = belief.absorb(H.copy(), y.copy())
    np.testing.assert_allclose(belief.covariance, after, atol=1e-10)
    np.testing.assert_allclose(moved, after @ of_state.T @ y, atol=1e-10)
    assert (np.triu(belief.S[3:, 3:], 1) == 0.0).all()


def test_a_motion_adds_its_covariance(rng):
    belief = SquareRootBelief(np.array([1.0, 2.0, 0.7]), np.diag([0.1, 0.2, 0.3]))
    for m in rng.normal(size=(3, 2)):
        belief.extend(m, rng.normal(size=(2, 3)), np.diag([0.3, 0.1]))
    before, F, noise = belief.S.copy(), rng.normal(size=(3, 3)), rng.normal(size=(3, 4))
    belief.drive(np.array([2.0, 2.0, 0.9]), F, noise)
    expected = before.copy()
    expected[:3] = np.column_stack([F, np.zeros((3, 6))])
    P = expected @ expected.T
    P[:3, :3] += noise @ noise.T
    np.testing.assert_allclose(belief.covariance, P, atol=1e-12)


def test_a_stationary_robot_without_noise_keeps_a_root():
    """Neither pose nor motion has any noise: what a tentative landmark's filter begins with."""
    belief = UnscentedKalmanFilter()
    belief.start(np.zeros(3), np.zeros((3, 3)), MODELS)
    belief.predict(Increment(1.0, np.zeros(3), np.zeros((3, 3)), 1.0))
    belief.extend([Observation("cylinder", np.ones(2), 1e-4 * np.eye(2), label=0)], 1.0)
    assert np.isfinite(belief.belief.covariance).all()
    np.testing.assert_allclose(belief.landmarks()[0].covariance, 1e-4 * np.eye(2))
