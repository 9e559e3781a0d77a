"""A gap is longer than the usual time between sweeps, by what is usual for the log."""

import numpy as np
import pytest

from impslam.tracking.intervals import add_interval, is_gap, no_intervals

LEAST = 1.0


def statistics(intervals):
    known = no_intervals()
    for seconds in intervals:
        add_interval(seconds, known, LEAST)
    return known


@pytest.mark.parametrize(("period", "limit"), [(0.1, LEAST), (0.3, LEAST), (2.0, 6.0), (5.0, 15.0)])
def test_a_gap_is_longer_than_a_second_and_three_regular_periods(period, limit):
    known = statistics([period] * 50)
    assert not is_gap(0.99 * limit, known, LEAST)
    assert is_gap(1.01 * limit, known, LEAST)


def test_sweeps_that_are_stamped_in_bursts_have_no_gaps(rng):
    """As on a busy computer: a second of nothing, then several sweeps at once, at 5 Hz on average."""
    times = rng.exponential(0.2, 5000)
    known, gaps = statistics(times[:100]), 0
    for seconds in times[100:]:
        gaps += is_gap(seconds, known, LEAST)
        add_interval(seconds, known, LEAST)
    assert (times > LEAST).sum() > 20
    assert gaps <= 10
    assert is_gap(5.0, known, LEAST)


def test_a_gap_does_not_hide_the_next_one():
    known = statistics([0.1] * 100 + [30.0])
    assert is_gap(3.0, known, LEAST)
    np.testing.assert_allclose(known[0], 101)
