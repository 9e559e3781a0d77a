"""Fixes of a GPS that cannot be true."""

import numpy as np
import pytest

from impslam.evaluation.fixes import MAX_EXCESS, plausible


def fixes(n=50):
    t = np.arange(float(n))
    return np.column_stack((t, 3.0 * t, np.zeros(n), np.full(n, np.nan)))


@pytest.mark.parametrize("k", [0, 20, 49])
def test_a_lone_fix_far_off_is_left_out(k):
    made = fixes()
    made[k, 1:3] += [0.0, 100.0]
    kept = plausible(made, fixes())
    np.testing.assert_array_equal(np.flatnonzero(~kept), [k])


def test_a_shift_that_stays_may_be_true():
    made = fixes()
    made[20:, 2] += 100.0
    assert plausible(made, fixes()).all()


def test_a_gap_in_which_the_robot_drove_is_no_jump():
    made = fixes()[[*range(20), 25, *range(30, 50)]]
    assert plausible(made, fixes()).all()
    assert np.hypot(*np.diff(made[19:21, 1:3], axis=0)[0]) > MAX_EXCESS


def test_only_distances_of_odometry_count():
    turned = fixes()
    turned[:, [1, 2]] = turned[:, [2, 1]]
    assert plausible(fixes(), turned).all()


@pytest.mark.parametrize("n", [0, 1])
def test_a_single_fix_has_no_neighbour_that_speaks_against_it(n):
    assert plausible(fixes(n), fixes()).tolist() == [True] * n
