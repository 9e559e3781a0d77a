"""The lag of scans on the clock of odometry, which only turns that begin and end show."""

import numpy as np
import pytest

from impslam.diagnosis.lag import estimate_lag
from impslam.diagnosis.travel import Odometer, SweepMotions

STEP, PERIOD = 0.02, 0.1  # s, of odometry and of sweeps
MATCH_SIGMA, ODOMETRY_SIGMA = 0.001, 1e-2  # rad, rad/sqrt(rad)
SEEDS = range(8)


def constant(times, rng):
    return np.full(len(times), 0.3)


def to_and_fro(times, rng):
    """Return turns of a second or two, with straight drives in between."""
    parts = rng.choice([-0.8, 0.0, 0.8], 40)
    rates = np.repeat(parts, int(1.5 / STEP))[: len(times)]
    return np.convolve(rates, np.full(10, 0.1), mode="same")


def lag(turn_rates, seed, late=0.0):
    """Return the estimate for scans stamped `late` s late."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, 60.0, STEP)
    steps = turn_rates(times, rng) * STEP
    read = steps + ODOMETRY_SIGMA * np.sqrt(np.abs(steps)) * rng.standard_normal(len(steps))
    sums = np.column_stack([np.zeros((len(times), 2)), np.cumsum(read)])
    rows = np.column_stack([times, sums])
    odometer = Odometer(times, sums, np.zeros(len(times), np.int64), rows)
    stamps = np.arange(0.5, 59.0, PERIOD)
    twists = np.zeros((len(stamps), 3))
    twists[1:, 2] = np.diff(np.interp(stamps, times, np.cumsum(steps)))
    twists[1:, 2] += MATCH_SIGMA * rng.standard_normal(len(stamps) - 1)
    return estimate_lag(SweepMotions(stamps + late, twists, stamps > stamps[0]), odometer)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("late", [0.0, 0.1, 3.0])
def test_turns_that_begin_and_end_show_the_lag(seed, late):
    found = lag(to_and_fro, seed, late)
    assert found.seconds == pytest.approx(late, abs=5.0 * found.sigma)
    assert found.sigma < 0.005


@pytest.mark.parametrize("seed", SEEDS)
def test_a_constant_turn_rate_shows_no_lag(seed):
    """The noise of odometry fits best at some lag, by chance."""
    assert lag(constant, seed) is None
