"""Robust linear fits and their standard deviations."""

import numpy as np
import pytest

from impslam.diagnosis.robust import BIWEIGHT_CUTOFF, fit, jackknife

DRIVES = 150


def drives(rng, turns):
    """Return normalised errors of the turn scale, of drives with so many turns."""
    out = []
    for _ in range(DRIVES):
        A = np.column_stack((np.full(40, 0.4), np.zeros(40)))
        A[rng.choice(40, turns, replace=False), 1] = rng.uniform(0.2, 0.4, turns)
        y = A @ [0.0, 1.0] + 0.02 * rng.standard_normal(40)
        found = fit(A, y)
        out.append((found.p[1] - 1.0) / found.sigma[1])
    return np.array(out)


@pytest.mark.parametrize("turns", [1, 2, 3, 10])
def test_sigma_is_not_too_small_if_few_rows_determine_a_parameter(rng, turns):
    """3.29 sigma leave out 0.1 % of normal errors; few rows have longer tails."""
    assert np.mean(np.abs(drives(rng, turns)) > 3.29) <= 0.02


def test_sigma_matches_the_errors_with_many_rows(rng):
    assert np.std(drives(rng, 20)) == pytest.approx(1.0, abs=0.15)


def test_jackknife_leaves_out_whole_blocks(rng):
    """The covariance is that of fits repeated without each block."""
    J, y, block = rng.standard_normal((11, 2)), rng.standard_normal(11), 3
    p = np.linalg.lstsq(J, y, rcond=None)[0]
    moved = [
        np.linalg.lstsq(np.delete(J, rows, 0), np.delete(y, rows), rcond=None)[0] - p
        for rows in (np.arange(k, min(k + block, 11)) for k in range(0, 11, block))
    ]
    found = jackknife(J, y - J @ p, np.ones(11), block)
    np.testing.assert_allclose(found, sum(np.outer(d, d) for d in moved), rtol=1e-6)


def test_fit_ignores_a_minority_of_outliers(rng):
    A = rng.standard_normal((60, 2))
    y = A @ [0.5, -2.0] + 0.01 * rng.standard_normal(60)
    y[:20] += 5.0
    np.testing.assert_allclose(fit(A, y).p, [0.5, -2.0], atol=0.02)


@pytest.mark.parametrize("unit", [1.0, 1e-6])
def test_fit_is_that_of_weighted_least_squares_in_any_unit(rng, unit):
    """Without outliers, the weights at the solution are Tukey's."""
    A = rng.standard_normal((80, 3))
    y = A @ [0.5, -2.0, 1.0] + 0.01 * rng.standard_normal(80)
    A[:, 1] *= unit
    found = fit(A, y)
    residuals = y - A @ found.p
    scale = 1.4826 * np.median(np.abs(residuals))
    root = np.maximum(1.0 - (residuals / (BIWEIGHT_CUTOFF * scale)) ** 2, 0.0)
    expected = np.linalg.lstsq(A * root[:, None], y * root, rcond=None)[0]
    np.testing.assert_allclose(found.p, expected, rtol=1e-6)


def test_parameters_without_information_are_zero_or_shared(rng):
    x = rng.standard_normal(60)
    y = 2.0 * x + 0.01 * rng.standard_normal(60)
    never = fit(np.column_stack((x, np.zeros(60))), y)
    np.testing.assert_allclose(never.p, [2.0, 0.0], atol=0.01)
    alike = fit(np.column_stack((x, x)), y)
    np.testing.assert_allclose(alike.p, [1.0, 1.0], atol=0.01)
