"""Scans and odometry that differ by a little in each match: by chance, and where people walk along."""

import math

import numpy as np
import pytest
from tests.tracking.test_scan_to_map import BARE, CORRIDOR, odometry_of, path, scans_from, steps

from impslam.geometry.se2 import between
from impslam.health import SLIPPED, STALLED
from impslam.tracking.disagreement import MIN_DIFFERENCE, WRONG_SHARE, add_difference
from impslam.tracking.scan_to_map import ScanToMap

PERIOD = 0.1  # s


def added(offs, variance=1e-6, seconds=1e-6):
    """Return the total covariance (3, 3) that a series of differences adds, and the results."""
    difference, total = np.zeros(4), np.zeros((3, 3))
    results = [add_difference(difference, np.array(d), variance, seconds, total) for d in offs]
    return total, results


@pytest.mark.parametrize("direction", [0.0, 1.0, 2.5, -2.0])
def test_half_of_the_difference_becomes_uncertain_along_it(direction):
    n = np.array([math.cos(direction), math.sin(direction)])
    total, results = added([0.1 * n] * 10)
    assert not results[0]
    assert all(results[2:])
    np.testing.assert_allclose(total[:2, :2], (WRONG_SHARE * 1.0) ** 2 * np.outer(n, n), atol=1e-4)
    assert not total[2].any()


def test_differences_within_the_noise_of_odometry_add_nothing(rng):
    """By chance one window in 3000 exceeds the gate."""
    sigma, n = 0.05, 300_000
    _, results = added(sigma * rng.standard_normal((n, 2)), sigma**2, PERIOD)
    assert np.mean(results) < 1e-3


def test_small_differences_add_nothing_however_accurate_odometry_is():
    total, results = added([[0.9 * MIN_DIFFERENCE / 10, 0.0]] * 10, variance=1e-9)
    assert not any(results)
    assert not total.any()


def test_a_difference_that_ends_is_forgotten():
    total, results = added([[0.1, 0.0]] * 10 + [[0.0, 0.0]] * 200, 1e-4, PERIOD)
    assert results[9]
    assert not results[-1]
    at_end, _ = added([[0.1, 0.0]] * 10, 1e-4, PERIOD)
    np.testing.assert_allclose(total, at_end, rtol=1e-9)


def test_a_difference_that_lasts_goes_on_to_grow():
    lengths = [200, 400, 800]
    sigmas = [math.sqrt(added([[0.02, 0.0]] * n, 1e-6, PERIOD)[0][0, 0]) for n in lengths]
    assert sigmas[0] > 0.4
    assert sigmas[2] > 1.3 * sigmas[1] > 1.69 * sigmas[0]


def companions(pose):
    """People at either side and ahead who walk with the robot along a corridor: (x, y, radius)."""
    around = [(0.9, -0.6), (0.3, 0.7), (1.6, 0.5), (-0.8, 0.6), (-1.2, -0.6), (0.1, -0.7)]
    return np.array([[pose[0] + x, y, 0.2] for x, y in around])


def test_people_who_walk_along_a_corridor_leave_the_truth_inside_the_covariance():
    """Nothing but the people shows motion along the walls: the scans say that the robot stands."""
    truth = np.column_stack((0.06 * np.arange(80), np.zeros((80, 2))))
    scans = [scans_from([pose], CORRIDOR, companions(pose), **BARE)[0] for pose in truth]
    out = steps(ScanToMap(), odometry_of(truth), scans)
    last = int(np.flatnonzero(out.reference)[-1])
    off = between(truth, path(out, truth[0]))[last, 0]
    assert abs(off) > 1.0  # they do drag it
    variance = out.covariance[out.reference, 0, 0].sum()
    assert abs(off) < 3.29 * math.sqrt(variance)  # 99.9 %
    assert set(out.reasons[10:].tolist()) <= {SLIPPED, STALLED}
