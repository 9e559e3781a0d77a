"""The heading of the lidar's mount and its clock, checked against odometry while driving."""

import itertools

import numpy as np
import pytest

from impslam.geometry.se2 import between, compose
from impslam.health import MISALIGNED, MISTIMED, NONE
from impslam.tracking.offsets import MAX_INTERVAL, check_offsets, initial_offsets, interrupt

RNG = np.random.default_rng(5)
STEP = 0.01


def drive(seconds):
    """Return times and true poses of a drive at 0.3 m/s with a turn of 90 degrees every 8 s."""
    times = np.arange(0.0, seconds, STEP)
    rate = np.where(times % 8.0 < 6.0, 0.0, np.pi / 4.0)
    heading = np.concatenate(([0.0], np.cumsum(rate[:-1] * STEP)))
    x, y = (np.cumsum(0.3 * STEP * f(heading)) for f in (np.cos, np.sin))
    return times, np.column_stack((x, y, heading))


def results(late=0.0, turned=0.0, period=0.2, seconds=60.0, noise=1.0, skip=()):
    """Return reason and amount after each match of scans `late` s, of a lidar `turned` by degrees."""
    times, poses = drive(seconds)
    every = round(period / STEP)
    shown = np.arange(round(1.0 / STEP), len(times) - round(1.0 / STEP), every)
    mount = np.array([0.0, 0.0, np.radians(turned)])
    offsets, found = initial_offsets(), []
    for a, b in itertools.pairwise(shown):
        odometry = between(poses[a], poses[b])
        early = round(late / STEP)
        seen = between(compose(poses[a - early], mount), compose(poses[b - early], mount))
        seen = seen + noise * RNG.normal(0.0, (0.003, 0.003, 0.004))
        if len(found) in skip:
            interrupt(offsets)
        found.append(check_offsets(offsets, odometry, seen, period))
    return found


@pytest.mark.parametrize("period", [0.05, 0.1, 0.25])
@pytest.mark.parametrize("late", [0.3, -0.3])
def test_a_late_or_early_clock_is_reported_in_the_first_turn(late, period):
    found = results(late, period=period)
    first = next(i for i, (reason, _) in enumerate(found) if reason == MISTIMED)
    assert 5.0 < first * period < 12.0
    assert found[-1][0] == MISTIMED
    assert found[-1][1] == pytest.approx(0.3, abs=0.5 * max(period, 0.2) + 0.01)


@pytest.mark.parametrize("late", [0.0, 0.1, -0.1])
@pytest.mark.parametrize("turned", [0.0, 1.0, -1.0])
def test_small_offsets_are_tolerated(late, turned):
    assert {reason for reason, _ in results(late, turned)} == {NONE}


@pytest.mark.parametrize("is_known", [True, False])
def test_scans_of_two_lidars_in_turn_do_not_show_a_turned_mount(is_known):
    """The second one scans 1 ms after the first, and its mount is 15 mm off to the side."""
    offsets, found, turns = initial_offsets(), [], RNG.normal(0.0, 0.02, 400)
    for k in range(400):
        is_second = k % 2
        odometry = np.array([0.0 if is_second else 0.03, 0.0, 0.0 if is_second else turns[k]])
        seen = odometry + np.array([0.0, 0.015 if is_second else -0.015, 0.0])
        offsets.changed[0] = is_known
        period = 0.001 if is_second else 0.199
        found.append(check_offsets(offsets, odometry, seen, period)[0])
    assert (MISALIGNED in found) is not is_known


@pytest.mark.parametrize("turned", [5.0, -5.0, 10.0])
def test_a_turned_mount_is_reported_within_a_few_metres(turned):
    found = results(turned=turned)
    first = next(i for i, (reason, _) in enumerate(found) if reason == MISALIGNED)
    assert first * 0.2 * 0.3 < 3.0
    assert found[-1][0] == MISALIGNED
    assert found[-1][1] == pytest.approx(abs(turned), abs=1.5)


def test_noiseless_offsets_are_found_within_what_turns_between_matches_hide():
    assert results(turned=5.0, noise=0.0)[-1] == (MISALIGNED, pytest.approx(5.0, abs=0.05))
    assert results(0.3, period=0.1, noise=0.0)[-1] == (MISTIMED, pytest.approx(0.3))


@pytest.mark.parametrize("share", [0.85, 1.15])
def test_noise_of_wheels_in_the_first_turn_is_no_lag(share):
    """Noise of 2 cm per root metre at both wheels of a small robot that slips; nothing matches before."""
    rates = np.repeat([1.0, 0.5, 0.0], [14, 4, 12])
    for _ in range(100):
        offsets = initial_offsets()
        for rate in rates:
            seen = np.array([0.02, 0.0, 0.1 * rate]) + RNG.normal(0.0, (0.003, 0.003, 0.002))
            odometry = np.array([0.02, 0.0, 0.1 * share * rate + rate * RNG.normal(0.0, 0.01)])
            assert check_offsets(offsets, odometry, seen, 0.1) == (NONE, 0.0)


def test_turns_before_and_after_an_interruption_are_not_compared():
    every_second = range(0, 400, 5)
    assert {reason for reason, _ in results(0.3, skip=every_second)} == {NONE}
    assert {reason for reason, _ in results(0.3, period=1.1 * MAX_INTERVAL)} == {NONE}


def test_a_robot_that_stands_still_has_no_offsets():
    offsets, still = initial_offsets(), np.zeros(3)
    for _ in range(500):
        assert check_offsets(offsets, still, RNG.normal(0.0, 0.003, 3), 0.1) == (NONE, 0.0)


def test_correlated_errors_of_a_robot_that_stands_are_no_travel():
    """The robot drives 2 m and stands: its scans determine only the direction across a slanting wall."""
    offsets, still = initial_offsets(), np.zeros(3)
    for _ in range(40):
        ahead = np.array([0.05, 0.0, 0.0])
        seen = ahead + RNG.normal(0.0, (0.003, 0.003, 0.004))
        assert check_offsets(offsets, ahead, seen, 0.1) == (NONE, 0.0)
    for _ in range(2000):
        seen = RNG.normal(0.0, 0.003) * np.array([1.0, 0.3, 0.0])
        assert check_offsets(offsets, still, seen, 0.1) == (NONE, 0.0)


@pytest.mark.parametrize("turned", [0.0, 10.0])
def test_a_wrong_scale_of_sideways_motion_is_no_turned_mount(turned):
    """An omnidirectional robot drives ahead and diagonally, and its odometry reports 10 % less sideways."""
    offsets, found = initial_offsets(), []
    mount = np.array([0.0, 0.0, np.radians(turned)])
    for k in range(300):
        step = np.array([0.06, 0.05 * (k // 20 % 3), 0.02 * (k // 10 % 3 - 1)])
        seen = between(mount, compose(step, mount)) + RNG.normal(0.0, (0.003, 0.003, 0.004))
        found.append(check_offsets(offsets, step * [1.0, 0.9, 1.0], seen, 0.2))
    assert {reason for reason, _ in found[100:]} == {MISALIGNED if turned else NONE}
