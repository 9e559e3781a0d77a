"""Line fits: exact without noise, efficient and consistent with it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from impslam.errors import ShapeError
from impslam.geometry.lines import fit_line

SIGMA = 0.02


def wall(rho, alpha, directions, origin=(0.0, 0.0)):
    """Ranges from `origin` along `directions` to the line, and the unit vectors."""
    beams = np.column_stack((np.cos(directions), np.sin(directions)))
    normal = np.array([np.cos(alpha), np.sin(alpha)])
    return (rho - np.dot(origin, normal)) / (beams @ normal), beams


def oblique():
    """A wall seen from 23 degrees one side to 60 the other, from a laser off the frame's origin."""
    directions = np.linspace(-0.1, 1.35, 60)
    origin = np.array([0.3, -0.2])
    ranges, beams = wall(2.0, 0.3, directions, origin)
    return directions, origin, ranges, beams


@given(
    rho=st.floats(0.2, 30.0),
    alpha=st.floats(-np.pi, np.pi),
    half=st.floats(0.05, 1.2),
    tilt=st.floats(-0.3, 0.3),
)
@settings(max_examples=200, deadline=None)
def test_noiseless_is_exact(rho, alpha, half, tilt):
    directions = alpha + tilt + np.linspace(-half, half, 25)
    ranges, beams = wall(rho, alpha, directions)
    fit = fit_line(ranges[:, None] * beams, directions, np.full(25, SIGMA))
    assert fit.rho == pytest.approx(rho, abs=1e-8 * rho)
    assert np.cos(fit.alpha - alpha) == pytest.approx(1.0, abs=1e-14)
    assert fit.chi2 < 1e-12


def test_estimator_is_unbiased_efficient_and_knows_its_covariance(rng):
    directions, origin, ranges, beams = oblique()
    sigmas = np.linspace(0.5, 2.0, 60) * SIGMA
    # Cramer-Rao: ranges r(rho, alpha) with independent noise; Jacobian by central differences.
    step = 1e-6
    rho_up, _ = wall(2.0 + step, 0.3, directions, origin)
    rho_down, _ = wall(2.0 - step, 0.3, directions, origin)
    alpha_up, _ = wall(2.0, 0.3 + step, directions, origin)
    alpha_down, _ = wall(2.0, 0.3 - step, directions, origin)
    jacobian = np.column_stack((rho_up - rho_down, alpha_up - alpha_down)) / (2 * step)
    bound = np.linalg.inv(jacobian.T @ (jacobian / sigmas[:, None] ** 2))
    runs = 4000
    errors, chi2 = np.empty((runs, 2)), np.empty(runs)
    for k in range(runs):
        noisy = ranges + sigmas * rng.standard_normal(60)
        fit = fit_line(origin + noisy[:, None] * beams, directions, sigmas)
        errors[k], chi2[k] = (fit.rho - 2.0, fit.alpha - 0.3), fit.chi2
    # Bias below a tenth of the standard deviation, and nothing that 4000 runs can tell from zero.
    assert np.all(np.abs(errors.mean(0)) < 4.0 * np.sqrt(np.diag(bound) / runs))
    # In units of the bound; the standard deviation of a variance from 4000 runs is 2.2 %.
    white = np.linalg.inv(np.linalg.cholesky(bound))
    np.testing.assert_allclose(white @ np.cov(errors.T) @ white.T, np.eye(2), atol=0.08)
    np.testing.assert_allclose(white @ fit.covariance @ white.T, np.eye(2), atol=0.08)
    assert chi2.mean() == pytest.approx(58.0, rel=0.03)


def test_covariance_is_that_of_the_numerical_jacobian():
    directions, origin, ranges, beams = oblique()
    sigmas = np.full(60, SIGMA)

    def estimate(r):
        fit = fit_line(origin + r[:, None] * beams, directions, sigmas)
        return np.array([fit.rho, fit.alpha])

    step = 1e-6
    columns = [
        (estimate(ranges + step * e) - estimate(ranges - step * e)) / (2 * step) for e in np.eye(60)
    ]
    jacobian = np.column_stack(columns)
    fit = fit_line(origin + ranges[:, None] * beams, directions, sigmas)
    np.testing.assert_allclose(fit.covariance, jacobian @ jacobian.T * SIGMA**2, rtol=1e-3)
    np.testing.assert_allclose(fit.bias_jacobian, jacobian.sum(1), rtol=1e-3)


def test_moves_with_the_frame():
    directions, origin, ranges, beams = oblique()
    noisy = origin + (ranges + SIGMA * np.sin(17.0 * np.arange(60)))[:, None] * beams
    here = fit_line(noisy, directions, np.full(60, SIGMA))
    turn, shift = 2.5, np.array([-4.0, 1.5])
    rot = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    there = fit_line(noisy @ rot.T + shift, directions + turn, np.full(60, SIGMA))
    normal = np.array([np.cos(here.alpha + turn), np.sin(here.alpha + turn)])
    rho = here.rho + normal @ shift
    sign = np.sign(rho)
    assert there.rho == pytest.approx(abs(rho), abs=1e-12)
    assert np.cos(there.alpha - here.alpha - turn) == pytest.approx(sign, abs=1e-14)
    assert there.chi2 == pytest.approx(here.chi2, rel=1e-9)
    tangent = np.array([-normal[1], normal[0]])
    move = np.array([[sign, sign * tangent @ shift], [0.0, 1.0]])
    np.testing.assert_allclose(there.covariance, move @ here.covariance @ move.T, rtol=1e-9)


def test_line_through_the_origin_and_line_behind_it():
    points = np.column_stack((np.linspace(1.0, 2.0, 10), np.linspace(1.0, 2.0, 10)))
    fit = fit_line(points, np.full(10, -0.5), np.full(10, SIGMA))
    assert fit.rho == pytest.approx(0.0, abs=1e-12)
    behind = fit_line(points - [0.0, 1.0], np.full(10, -0.5), np.full(10, SIGMA))
    assert behind.rho == pytest.approx(np.sqrt(0.5))
    assert behind.alpha == pytest.approx(-np.pi / 4)


def test_a_beam_along_the_line_does_not_dominate_the_fit():
    directions = np.array([0.0, 1.2, 1.4, 1.6, 1.8])
    points = np.array([[3.0, 1.0], [0.4, 1.01], [0.2, 0.99], [0.0, 1.0], [-0.2, 1.0]])
    fit = fit_line(points, directions, np.full(5, SIGMA), flatness=0.01)
    assert fit.rho == pytest.approx(1.0, abs=0.02)
    assert np.all(np.linalg.eigvalsh(fit.covariance) > 0.0)


@pytest.mark.parametrize("n", [0, 1])
def test_too_few_points(n):
    with pytest.raises(ShapeError, match="n >= 2"):
        fit_line(np.zeros((n, 2)), np.zeros(n), np.ones(n))


def test_wrong_shapes_and_points_in_one_place():
    with pytest.raises(ShapeError, match="expected"):
        fit_line(np.zeros((4, 2)), np.zeros(3), np.ones(4))
    with pytest.raises(ShapeError, match="define no line"):
        fit_line(np.ones((4, 2)), np.zeros(4), np.ones(4))
