"""The time between scans, whatever the jitter of their stamps and however many are lost."""

import numpy as np
import pytest

from impslam.diagnosis.timing import scan_period

PERIOD, SCANS = 0.2, 400


@pytest.fixture
def rng():
    return np.random.default_rng(4)


def regular():
    return PERIOD * np.arange(SCANS)


def test_regular_stamps_show_the_period_whatever_share_of_scans_is_lost(rng):
    kept = rng.random(SCANS) > 0.4
    assert scan_period(regular()[kept]) == pytest.approx(PERIOD)


@pytest.mark.parametrize("jitter", [0.01, 0.05, 0.1])
def test_jitter_does_not_change_it(rng, jitter):
    stamps = np.sort(regular() + rng.uniform(0.0, 2.0 * jitter, SCANS))
    assert scan_period(stamps) == pytest.approx(PERIOD, rel=0.02)


def test_polled_scans_show_it_though_most_times_between_them_are_short():
    """A driver that polls stamps every third scan late; the others come soon after one another."""
    stamps = np.cumsum(np.tile([0.1, 0.15, 0.35], SCANS // 3))
    assert np.median(np.diff(stamps)) == pytest.approx(0.15)
    assert scan_period(stamps) == pytest.approx(PERIOD, rel=0.03)


def test_a_few_scans_lost_on_the_way_of_jittering_stamps_change_it_little(rng):
    stamps = np.sort(regular() + rng.uniform(0.0, 0.15, SCANS))[rng.random(SCANS) > 0.05]
    assert scan_period(stamps) == pytest.approx(PERIOD, rel=0.06)


@pytest.mark.parametrize("stamps", [[], [1.0], [3.0, 3.0, 3.0], [3.0, 2.0, 1.0]])
def test_it_is_unknown_without_times_between_scans(stamps):
    assert scan_period(np.array(stamps)) == 0.0
