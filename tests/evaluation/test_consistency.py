"""Normalised errors have the distribution they are tested against."""

import numpy as np
import pytest

from impslam.evaluation.consistency import (
    chi2_bounds,
    effective_count,
    nees,
    pose_errors,
    resampled_means,
    score_innovations,
    share_within,
)


def draw(rng, n, scale=1.0):
    A = rng.normal(size=(n, 3, 3))
    P = A @ A.transpose(0, 2, 1) + 0.1 * np.eye(3)
    errors = np.linalg.cholesky(P) @ rng.normal(size=(n, 3, 1))
    return scale * errors[..., 0], P


def test_one_value_by_hand():
    assert nees(np.array([[1.0, 2.0, 3.0]]), np.diag([1.0, 4.0, 9.0])[None]) == pytest.approx([3.0])


def test_consistent_errors_average_to_their_degrees_of_freedom(rng):
    values = nees(*draw(rng, 20000))
    low, high = chi2_bounds(3, 20000, 0.999)
    assert low < values.mean() < high
    assert share_within(values, 1, 3) == pytest.approx(0.95, abs=0.01)


def test_overconfidence_shows(rng):
    values = nees(*draw(rng, 50, scale=2.0))
    assert values.mean() > chi2_bounds(3, 50)[1]


def test_bounds_as_printed_in_tables():
    assert chi2_bounds(2) == pytest.approx((0.0506, 7.3778), abs=1e-4)
    assert chi2_bounds(3, 50) == pytest.approx((2.3597, 3.7160), abs=1e-3)


def test_headings_are_compared_the_short_way():
    error = pose_errors(np.array([[0.0, 0.0, 3.1]]), np.array([[0.0, 0.0, -3.1]]))
    assert error[0, 2] == pytest.approx(6.2 - 2 * np.pi)


def test_a_singular_covariance_is_refused():
    with pytest.raises(np.linalg.LinAlgError):
        nees(np.ones((1, 3)), np.zeros((1, 3, 3)))


def test_resampled_means_scatter_as_the_mean_does(rng):
    values = rng.normal([1.0, -5.0], [1.0, 3.0], size=(400, 2))
    means = resampled_means(values, rng, times=4000)
    np.testing.assert_allclose(means.mean(axis=0), values.mean(axis=0), atol=0.01)
    np.testing.assert_allclose(means.std(axis=0), values.std(axis=0) / 20.0, rtol=0.05)


def test_resampling_keeps_the_steps_of_a_run_together(rng):
    run = rng.normal(size=(30, 1))
    means = resampled_means(np.hstack([run, -run]), rng)
    np.testing.assert_allclose(means[:, 0], -means[:, 1], atol=1e-12)


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_correlated_values_count_as_fewer(rng, correlation):
    """Of an AR(1) process: n (1 - r) / (1 + r) (Bartlett 1946)."""
    values = np.empty(20_000)
    values[0] = 0.0
    for k, noise in enumerate(rng.normal(size=len(values) - 1), start=1):
        values[k] = correlation * values[k - 1] + noise
    expected = len(values) * (1.0 - correlation) / (1.0 + correlation)
    assert effective_count(values) == pytest.approx(expected, rel=0.1)


def test_values_that_are_all_the_same_count_once():
    assert effective_count(np.ones(50)) == 1.0


def test_innovations_of_the_right_size_lie_in_their_interval(rng):
    dof = rng.integers(0, 12, 400).astype(float)
    nis = np.where(dof > 0.0, rng.chisquare(np.maximum(dof, 1.0)), 0.0)
    rows = np.column_stack((dof // 2, nis, dof))
    score = score_innovations(rows)
    assert score.count == int((dof > 0.0).sum())
    assert score.matches == int((dof // 2).sum())
    assert score.low < 1.0 < score.high
    assert score.mean == pytest.approx(1.0, abs=3.0 * (score.high - 1.0) / 1.96)
    assert score.within == pytest.approx(0.95, abs=0.04)
    twice = score_innovations(rows * (1.0, 2.0, 1.0))
    assert twice.mean > score.high
    assert twice.within < 0.9
    assert score_innovations(np.zeros((3, 3))) is None
