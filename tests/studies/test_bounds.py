"""Cramér-Rao bounds: derivatives by differences, closed forms, and what the best fit reaches."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.numeric import jacobian

from impslam.geometry.circles import fit_circle
from impslam.geometry.lines import fit_line
from impslam.simulation.raycast import trace
from impslam.studies.bounds import (
    bound,
    circle_jacobian,
    circle_ranges,
    wall_jacobian,
    wall_ranges,
)

RUNS = 4000
SIGMA = 0.004

angle = st.floats(-math.pi, math.pi)
metre = st.floats(-1.0, 1.0)


def fan(middle, half, count=9, origin=(0.0, 0.0)):
    return np.tile(np.asarray(origin, float), (count, 1)), middle + np.linspace(-half, half, count)


def points(origins, directions, ranges):
    return origins + ranges[:, None] * np.column_stack((np.cos(directions), np.sin(directions)))


@given(metre, metre, angle, st.floats(0.3, 5.0), st.floats(0.05, 1.3))
def test_wall_ranges_have_this_derivative(x, y, alpha, gap, half):
    rho = x * math.cos(alpha) + y * math.sin(alpha) + gap
    rays = fan(alpha, half, origin=(x, y))
    z = np.array([rho, alpha])
    numeric = jacobian(lambda at: wall_ranges(at, *rays), z)
    np.testing.assert_allclose(wall_jacobian(z, *rays), numeric, rtol=1e-6, atol=1e-6)


@given(metre, metre, angle, st.floats(0.05, 0.5), st.floats(0.3, 4.0))
def test_circle_ranges_have_this_derivative(x, y, bearing, radius, gap):
    d = radius + gap
    circle = np.array([x + d * math.cos(bearing), y + d * math.sin(bearing), radius])
    rays = fan(bearing, 0.9 * math.asin(radius / d), origin=(x, y))
    numeric = jacobian(lambda at: circle_ranges(at, *rays), circle, 1e-7)
    np.testing.assert_allclose(circle_jacobian(circle, *rays), numeric, rtol=1e-4, atol=1e-5)


def test_ranges_are_those_of_the_simulator():
    wall, circle = np.array([[2.0, -3.0, 2.0, 3.0]]), np.array([[1.0, 1.0, 0.2]])
    still = (np.empty((2, 0, 4)), np.empty((2, 0, 3)))
    origins, directions = fan(0.0, 0.5)
    lasers = np.zeros((len(directions), 3))
    cast, *_ = trace(lasers, directions, 0 * directions, (wall, np.empty((0, 3))), still, 9.0)
    np.testing.assert_allclose(wall_ranges(np.array([2.0, 0.0]), origins, directions), cast)
    origins, directions = fan(0.25 * math.pi, 0.1)
    cast, *_ = trace(lasers, directions, 0 * directions, (np.empty((0, 4)), circle), still, 9.0)
    np.testing.assert_allclose(circle_ranges(circle[0], origins, directions), cast)


def test_parallel_beams_give_the_covariance_of_linear_regression():
    y = np.array([-1.0, -0.2, 0.1, 0.5, 2.0])
    origins = np.column_stack((np.zeros(5), y))
    J = wall_jacobian(np.array([3.0, 0.0]), origins, np.zeros(5))
    got = bound(J, np.full(5, SIGMA))
    spread = np.sum((y - y.mean()) ** 2)
    assert got[1, 1] == pytest.approx(SIGMA**2 / spread)
    assert got[0, 0] == pytest.approx(SIGMA**2 * (1 / 5 + y.mean() ** 2 / spread))


def test_shared_error_is_marginalised_as_generalised_least_squares_does():
    rays = fan(0.4, 0.6)
    J, sigmas = wall_jacobian(np.array([1.5, 0.2]), *rays), np.linspace(0.002, 0.009, 9)
    whole = np.diag(sigmas**2) + 0.005**2
    expected = np.linalg.inv(J.T @ np.linalg.solve(whole, J))
    np.testing.assert_allclose(bound(J, sigmas, 0.005), expected, rtol=1e-9)
    assert (np.diag(bound(J, sigmas, 0.005)) > np.diag(bound(J, sigmas))).all()


def test_more_beams_and_less_noise_bound_lower():
    z = np.array([2.0, 0.1])
    few, many = (wall_jacobian(z, *fan(0.1, 0.5, n)) for n in (10, 20))
    assert (
        np.diag(bound(many, np.full(20, SIGMA))) < np.diag(bound(few, np.full(10, SIGMA)))
    ).all()
    np.testing.assert_allclose(
        bound(few, np.full(10, 2 * SIGMA)), 4 * bound(few, np.full(10, SIGMA))
    )


@pytest.mark.parametrize("count", [1, 0])
def test_too_few_beams_bound_nothing(count):
    J = wall_jacobian(np.array([2.0, 0.0]), *fan(0.0, 0.0, count))
    assert np.isinf(np.diag(bound(J, np.full(count, SIGMA)))).all()


def normalised(errors, covariance):
    return np.einsum("ni,ij,nj->n", errors, np.linalg.inv(covariance), errors)


def test_the_best_line_fit_reaches_the_bound():
    """A wall seen askew, from a laser that is not at the origin: RMS and correlation."""
    rng = np.random.default_rng(1)
    z, (origins, directions) = np.array([2.2, 0.3]), fan(0.6, 0.5, 60, origin=(0.15, 0.0))
    exact = wall_ranges(z, origins, directions)
    sigmas = 0.003 + 0.003 * exact
    best = bound(wall_jacobian(z, origins, directions), sigmas)
    errors = []
    for _ in range(RUNS):
        noisy = exact + sigmas * rng.standard_normal(60)
        fit = fit_line(points(origins, directions, noisy), directions, sigmas)
        errors.append([fit.rho - z[0], fit.alpha - z[1]])
    ratios = np.sqrt(np.mean(np.square(errors), axis=0) / np.diag(best))
    np.testing.assert_allclose(ratios, 1.0, atol=4.0 / math.sqrt(2 * RUNS))
    assert normalised(np.array(errors), best).mean() == pytest.approx(
        2.0, abs=4 * 2 / math.sqrt(RUNS)
    )


@pytest.mark.parametrize("known", [False, True])
def test_the_best_circle_fit_reaches_the_bound(known):
    """Beams up to 60 degrees of incidence, beyond which a range is no linear measure any more."""
    rng = np.random.default_rng(2)
    circle = np.array([1.2, 0.9, 0.15])
    half = math.asin(0.15 * math.sin(math.radians(60.0)) / 1.5)
    origins, directions = fan(math.atan2(0.9, 1.2), half, 40)
    exact, sigmas = circle_ranges(circle, origins, directions), np.full(40, 0.002)
    J = circle_jacobian(circle, origins, directions)
    best = bound(J[:, :2] if known else J, sigmas)
    errors = []
    for _ in range(RUNS):
        noisy = exact + sigmas * rng.standard_normal(40)
        fit = fit_circle(
            points(origins, directions, noisy), directions, sigmas, 0.15 if known else None
        )
        errors.append([*(fit.centre - circle[:2]), fit.radius - 0.15][: len(best)])
    ratios = np.sqrt(np.mean(np.square(errors), axis=0) / np.diag(best))
    np.testing.assert_allclose(ratios, 1.0, atol=0.02 + 4.0 / math.sqrt(2 * RUNS))
