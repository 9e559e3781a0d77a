"""The sweep clock: jitter is averaged, the period followed, lost sweeps skipped, breaks begun anew."""

import numpy as np
import pytest
from tests.odometry_steps import stacked

from impslam.sensors.clock import SweepClock
from impslam.sensors.lidar2d import Lidar2D
from impslam.types import LaserScan

PERIOD = 0.1
SETTLED = 100  # sweeps


def smoothed(stamps, period=PERIOD):
    clock = SweepClock(period)
    return clock.smooth(np.asarray(stamps))


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def test_the_first_stamp_is_returned_as_it_is():
    assert smoothed([1234.567]) == [1234.567]


def test_any_cutting_gives_the_same_bytes(rng):
    stamps = PERIOD * np.arange(100) + rng.uniform(-0.03, 0.03, 100)
    stamps[50:] += 100.0
    clock = SweepClock(PERIOD)
    one_by_one = np.concatenate([clock.smooth(stamps[k : k + 1]) for k in range(100)])
    assert one_by_one.tobytes() == smoothed(stamps).tobytes()


def test_steady_stamps_stay():
    stamps = 5.0 + PERIOD * np.arange(500)
    np.testing.assert_allclose(smoothed(stamps), stamps, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_jitter_is_averaged_to_a_third(seed):
    rng = np.random.default_rng(seed)
    true = PERIOD * np.arange(3000)
    jitter = rng.uniform(-0.03, 0.03, len(true))
    error = smoothed(true + jitter) - true
    assert rms(error[SETTLED:]) < rms(jitter[SETTLED:]) / 3.0


@pytest.mark.parametrize("stated", [0.98, 1.02])
def test_a_period_stated_wrong_by_two_percent_is_found(stated, rng):
    true = PERIOD * np.arange(3000)
    jitter = rng.uniform(-0.01, 0.01, len(true))
    error = smoothed(true + jitter, stated * PERIOD) - true
    assert rms(error[SETTLED:]) < rms(jitter) / 3.0
    assert abs(error[SETTLED:].mean()) < 1e-3


def test_drift_of_the_period_is_followed():
    """One percent within 1000 sweeps, as of a motor that warms up: no lag that grows."""
    true = np.cumsum(PERIOD * np.linspace(1.0, 1.01, 1000))
    assert np.abs(smoothed(true) - true).max() < 1e-3


def test_lost_sweeps_are_skipped(rng):
    true = PERIOD * np.arange(2000)
    seen = true[rng.random(len(true)) > 0.2]
    np.testing.assert_allclose(smoothed(seen), seen, atol=1e-9)
    jitter = rng.uniform(-0.03, 0.03, len(seen))
    error = smoothed(seen + jitter) - seen
    assert rms(error[SETTLED:]) < rms(jitter) / 2.0  # fewer stamps, averaged over more time
    assert np.abs(error[SETTLED:]).max() < 0.5 * PERIOD  # never a sweep ahead or behind


@pytest.mark.parametrize("jump", [100.0 * PERIOD + 0.03, -3.0, -100.0])
def test_a_long_pause_or_a_step_back_begins_anew(jump, rng):
    before = PERIOD * np.arange(200) + rng.uniform(-0.01, 0.01, 200)
    after = before[-1] + jump + PERIOD * np.arange(50)
    out = smoothed(np.concatenate((before, after)))
    assert out[200] == after[0]
    np.testing.assert_allclose(out[200:], after, atol=5e-3)


def test_smoothed_stamps_rise():
    """Two sweeps that arrive together are still a period apart."""
    stamps = PERIOD * np.arange(300)
    stamps[100::10] += 0.9 * PERIOD
    steps = np.diff(smoothed(stamps))
    assert steps.min() > 0.5 * PERIOD


# --------------------------------------------------------------------------- in the lidar


def sweep(stamp):
    n = 20
    return LaserScan(stamp, np.linspace(-1.0, 1.0, n), np.full(n, 2.0), 1e-3 * np.arange(n))


def test_the_lidar_smooths_its_stamps(rng):
    stamps = PERIOD * np.arange(100) + rng.uniform(-0.03, 0.03, 100)
    begins, ends = Lidar2D(period=PERIOD, latency=0.02).spans(stacked(map(sweep, stamps.tolist())))
    np.testing.assert_array_equal(begins, smoothed(stamps) - 0.02)
    np.testing.assert_array_equal(ends, begins + 0.019)


def test_without_a_period_the_stamps_are_true(rng):
    stamps = rng.uniform(0.0, 10.0, 20)
    begins, _ = Lidar2D().spans(stacked(map(sweep, stamps.tolist())))
    np.testing.assert_array_equal(begins, stamps)


def test_each_lidar_has_its_own_clock():
    first, second = Lidar2D(period=PERIOD), Lidar2D(period=PERIOD)
    first.spans(stacked([sweep(0.0)]))
    assert second.spans(stacked([sweep(0.13)]))[0] == [0.13]
