"""Circle fits: exact without noise, efficient and consistent with it, better with a known radius."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from impslam.errors import ShapeError
from impslam.geometry.circles import fit_circle

SIGMA = 0.01


def ranges_to(circle, directions):
    beams = np.column_stack((np.cos(directions), np.sin(directions)))
    along = beams @ circle[:2]
    off2 = circle[0] ** 2 + circle[1] ** 2 - along**2
    return along - np.sqrt(circle[2] ** 2 - off2), beams


def arc(circle, fraction=0.85, count=21):
    """Directions over a fraction of the visible half-width."""
    half = fraction * np.arcsin(circle[2] / np.hypot(*circle[:2]))
    return np.arctan2(circle[1], circle[0]) + np.linspace(-half, half, count)


def jacobian(circle, directions, step=1e-6):
    columns = [
        ranges_to(circle + step * e, directions)[0] - ranges_to(circle - step * e, directions)[0]
        for e in np.eye(3)
    ]
    return np.column_stack(columns) / (2 * step)


@given(
    distance=st.floats(0.5, 5.0),
    bearing=st.floats(-np.pi, np.pi),
    radius=st.floats(0.03, 0.4),
    known=st.booleans(),
)
@settings(max_examples=200, deadline=None)
def test_noiseless_is_exact(distance, bearing, radius, known):
    circle = np.array([distance * np.cos(bearing), distance * np.sin(bearing), radius])
    directions = arc(circle, count=9)
    ranges, beams = ranges_to(circle, directions)
    fit = fit_circle(
        ranges[:, None] * beams, directions, np.full(9, SIGMA), radius if known else None
    )
    np.testing.assert_allclose(fit.centre, circle[:2], atol=1e-6)
    assert fit.radius == pytest.approx(radius, abs=1e-6)
    assert fit.chi2 < 1e-6


@pytest.mark.parametrize("known", [False, True])
def test_estimator_is_efficient_and_knows_its_covariance(rng, known):
    circle = np.array([1.2, 0.5, 0.15])
    directions = arc(circle)
    ranges, beams = ranges_to(circle, directions)
    k = 2 if known else 3
    J = jacobian(circle, directions)[:, :k]
    bound = np.linalg.inv(J.T @ J) * 0.005**2
    runs = 2000
    errors, chi2 = np.empty((runs, k)), np.empty(runs)
    for i in range(runs):
        noisy = ranges + 0.005 * rng.standard_normal(len(ranges))
        fit = fit_circle(
            noisy[:, None] * beams, directions, np.full(len(ranges), 0.005), 0.15 if known else None
        )
        errors[i] = (np.append(fit.centre, fit.radius) - circle)[:k]
        chi2[i] = fit.chi2
    white = np.linalg.inv(np.linalg.cholesky(bound))
    sample = np.cov(errors.T)
    np.testing.assert_allclose(white @ sample @ white.T, np.eye(k), atol=0.15)
    np.testing.assert_allclose(white @ fit.covariance[:k, :k] @ white.T, np.eye(k), atol=0.2)
    # The bias is small beside what noise does.
    assert np.all(np.abs(errors.mean(0)) < 0.25 * np.sqrt(np.diag(bound)))
    assert chi2.mean() == pytest.approx(len(ranges) - k, rel=0.07)


def test_known_radius_is_worth_four_to_six_times_in_range(rng):
    circle = np.array([1.5, 0.0, 0.15])
    directions = arc(circle, fraction=0.9, count=31)
    ranges, beams = ranges_to(circle, directions)
    errors = np.empty((600, 2))
    for i in range(len(errors)):
        points = (ranges + 0.005 * rng.standard_normal(31))[:, None] * beams
        for k, radius in enumerate((None, 0.15)):
            errors[i, k] = fit_circle(points, directions, np.full(31, 0.005), radius).centre[0]
    unknown, known = errors.std(0)
    assert 3.5 < unknown / known < 7.0


@pytest.mark.parametrize("radius", [None, 0.15])
def test_bias_jacobian_is_the_numerical_one(radius):
    circle = np.array([1.2, -0.5, 0.15])
    directions = arc(circle)
    ranges, beams = ranges_to(circle, directions)

    def estimate(by):
        points = (ranges + by)[:, None] * beams
        fit = fit_circle(points, directions, np.full(len(ranges), SIGMA), radius)
        return np.append(fit.centre, fit.radius)

    slope = (estimate(1e-5) - estimate(-1e-5)) / 2e-5
    fit = fit_circle(ranges[:, None] * beams, directions, np.full(len(ranges), SIGMA), radius)
    np.testing.assert_allclose(fit.bias_jacobian, slope, atol=1e-3)


def test_bad_input():
    with pytest.raises(ShapeError, match="n >= 3"):
        fit_circle(np.zeros((2, 2)), np.zeros(2), np.ones(2))
    with pytest.raises(ShapeError, match="expected"):
        fit_circle(np.zeros((4, 2)), np.zeros(3), np.ones(4))
    line = np.column_stack((np.ones(6), np.linspace(-0.5, 0.5, 6)))
    with pytest.raises(ShapeError, match="define no circle"):
        fit_circle(line, np.linspace(-0.4, 0.4, 6), np.full(6, SIGMA))
    with pytest.raises(ShapeError, match="define no circle"):
        fit_circle(np.ones((4, 2)), np.zeros(4), np.ones(4))
