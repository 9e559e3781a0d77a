"""Faults detected from scans that do not fit the map, and from motions that disagree."""

import numpy as np
import pytest

from impslam.health import ELSEWHERE, NONE, OPEN, PUSHED, SLIPPED, STALLED, UNEXPLAINED
from impslam.tracking.match_faults import (
    DISPUTED_VARIANCE,
    MIN_FIT,
    MIN_OPEN_DISTANCE,
    MatchQuality,
    add_fit,
    add_misfit,
    check_motion,
    current_fault,
    disputed_variance,
    fits_poorly,
    initial_faults,
    turns_oppose,
)

USUAL = 0.85
AHEAD, STILL = np.array([0.1, 0.0, 0.0]), np.zeros(3)


def fit(share, points=100.0, off=STILL):
    return MatchQuality(points, share, off)


def check_fit(faults, fit, usual, duration, distance=0.0):
    if fits_poorly(faults, fit, usual):
        return add_misfit(faults, duration, distance)
    add_fit(faults, fit, usual)
    return NONE


def judged(shares, period=0.2, distance=0.0):
    faults = initial_faults()
    return [check_fit(faults, fit(share), USUAL, period, distance) for share in shares]


def test_one_poor_fit_is_unexplained_and_three_are_another_place():
    assert judged([0.8, 0.1, 0.8]) == [NONE, UNEXPLAINED, NONE]
    assert judged([0.8, 0.1, 0.1, 0.1]) == [NONE, UNEXPLAINED, UNEXPLAINED, ELSEWHERE]
    assert judged([0.8, *[0.1] * 5], period=0.15) == [
        NONE,
        *[UNEXPLAINED] * 3,
        ELSEWHERE,
        UNEXPLAINED,
    ]


def test_another_place_is_reported_if_stamps_stand_still():
    assert judged([0.1] * 25, period=0.0).index(ELSEWHERE) == 19


def test_another_place_is_reported_after_a_few_metres_if_stamps_stand_still():
    assert judged([0.1] * 25, period=0.0, distance=1.1).index(ELSEWHERE) == 2
    assert judged([0.1] * 25, period=0.0, distance=0.3).index(ELSEWHERE) == 7


@pytest.mark.parametrize("period", [0.02, 0.1, 0.2, 0.5])
def test_another_place_is_reported_within_a_second(period):
    reasons = judged([0.1] * 60, period)
    assert period * reasons.index(ELSEWHERE) < max(0.75, 2.5 * period)


def test_a_scan_fits_again_only_where_it_fits_well():
    middle = (0.5 * (MIN_FIT + 0.7)) * USUAL
    assert judged([middle, 0.1, middle, USUAL]) == [NONE, UNEXPLAINED, UNEXPLAINED, NONE]


def test_a_low_share_is_tolerated_if_shares_vary():
    faults, rng = initial_faults(), np.random.default_rng(1)
    for share in np.clip(USUAL + 0.2 * rng.standard_normal(300), 0.55, 1.0):
        assert check_fit(faults, fit(share), USUAL, 0.2) == NONE
    assert check_fit(initial_faults(), fit(0.45), USUAL, 0.2) == UNEXPLAINED
    assert check_fit(faults, fit(0.45), USUAL, 0.2) == NONE


def test_a_poor_fit_is_ignored_if_scans_seldom_fit():
    faults = initial_faults()
    for share in np.tile([0.7, 0.5], 100):
        check_fit(faults, fit(share), 0.6, 0.2)
    assert check_fit(faults, fit(0.1), 0.8, 0.2) == NONE
    assert check_fit(initial_faults(), fit(0.1), 0.6, 0.2) == NONE
    assert check_fit(initial_faults(), fit(0.1), 0.8, 0.2) == UNEXPLAINED


@pytest.mark.parametrize(
    ("odometry", "scans", "expected"),
    [(AHEAD, AHEAD, NONE), (AHEAD, STILL, STALLED), (STILL, AHEAD, PUSHED), (STILL, STILL, NONE)],
)
def test_wheels_and_scans_are_compared_over_a_second(odometry, scans, expected):
    faults = initial_faults()
    for k in range(5):
        reason, _ = check_motion(faults, odometry, scans, True, False, 0.2)
        assert reason in {NONE, expected}
        assert k > 0 or reason == NONE  # one match is not enough
    assert reason == expected


def test_a_fault_lasts_for_a_second():
    faults = initial_faults()
    assert current_fault(faults, 0.1) == (NONE, 0.0)
    for _ in range(5):
        check_motion(faults, AHEAD, STILL, True, False, 0.2)
    assert current_fault(faults, 0.9) == (STALLED, 0.0)
    assert current_fault(faults, 1.1) == (NONE, 0.0)


@pytest.mark.parametrize(("share", "expected"), [(0.85, NONE), (0.6, SLIPPED), (1.6, SLIPPED)])
def test_distances_are_compared_over_three_seconds(share, expected):
    """People who walk ahead hold the pose back by a few centimetres a scan."""
    faults = initial_faults()
    found = [check_motion(faults, AHEAD, share * AHEAD, True, False, 0.2)[0] for _ in range(30)]
    assert found[:3] == [NONE] * 3
    assert found[-1] == expected


def test_one_slip_is_no_difference_of_distances():
    faults = initial_faults()
    for k in range(30):
        scans = AHEAD + np.array([0.5 * (k == 15), 0.0, 0.0])
        assert check_motion(faults, AHEAD, scans, True, False, 0.2)[0] == NONE


def test_turns_are_compared_as_well():
    faults, turn = initial_faults(), np.array([0.0, 0.0, 0.1])
    results = [check_motion(faults, turn, STILL, True, False, 0.2)[0] for _ in range(5)]
    assert results[-1] == STALLED


def test_noise_of_turns_by_wheels_is_no_turn():
    """0.09 rad per root metre: wheels 0.24 m apart, each with noise of 1.5 cm per root metre."""
    faults, rng = initial_faults(), np.random.default_rng(2)
    for _ in range(400):
        odometry = np.array([0.05, 0.0, rng.normal(0.0, 0.09 * np.sqrt(0.05))])
        assert check_motion(faults, odometry, AHEAD / 2.0, True, False, 0.05)[0] == NONE


@pytest.mark.parametrize(("pushed", "expected"), [(0.0, NONE), (0.01, PUSHED)])
def test_a_difference_between_two_lidars_is_no_motion(pushed, expected):
    """At rest, the pose jumps by 1 cm from lidar to lidar, 40 times a second."""
    faults = initial_faults()
    for k in range(120):
        scans = np.array([pushed + 0.01 * (-1.0) ** k, 0.0, 0.0])
        reason, _ = check_motion(faults, STILL, scans, True, False, 0.025)
        assert reason in {NONE, expected}
    assert reason == expected


def test_wheels_that_turn_the_robot_on_the_spot_do_not_stand_still():
    """A lidar 0.2 m off the axis moves as well; odometry does not show this if the mount is unknown."""
    faults, turn = initial_faults(), np.array([0.0, 0.0, 0.4])
    for _ in range(8):
        scans = np.array([0.2 * np.sin(0.4), 0.2 * (1.0 - np.cos(0.4)), 0.4])
        reason, _ = check_motion(faults, turn, scans, True, False, 0.2)
        assert reason == NONE


def test_a_bare_corridor_reports_its_distance_and_compares_nothing():
    faults = initial_faults()
    results = [
        check_motion(faults, AHEAD, STILL if k < 5 else AHEAD, False, False, 0.2) for k in range(20)
    ]
    assert [reason for reason, _ in results[:5]] == [NONE] * 5
    assert results[-1] == (OPEN, pytest.approx(1.5))
    assert results[-1][1] > MIN_OPEN_DISTANCE
    assert check_motion(faults, AHEAD, AHEAD, True, False, 0.2) == (NONE, 0.0)


def test_a_pose_far_from_odometry_has_slipped():
    assert check_motion(initial_faults(), AHEAD, 3.0 * AHEAD, True, True, 0.2)[0] == SLIPPED


def test_a_poor_fit_of_few_points_is_ignored():
    assert check_fit(initial_faults(), fit(0.1, points=24.0), USUAL, 0.2) == NONE


@pytest.mark.parametrize(("off", "expected"), [(0.0, NONE), (0.1, NONE), (0.3, UNEXPLAINED)])
def test_a_scan_that_fits_somewhere_else_has_to_fit_better(off, expected):
    faults, away = initial_faults(), np.array([off, 0.0, 0.0])
    assert check_fit(faults, fit(0.1), USUAL, 0.2) == UNEXPLAINED
    assert check_fit(faults, fit(0.8 * USUAL, off=away), USUAL, 0.2) == expected
    assert check_fit(faults, fit(0.95 * USUAL, off=away), USUAL, 0.2) == NONE


@pytest.mark.parametrize(("sign", "found"), [(1.0, False), (-1.0, True)])
def test_turns_of_opposite_signs_are_reported_after_half_a_radian(sign, found):
    turns, rng = np.zeros(2), np.random.default_rng(3)
    results = [
        turns_oppose(turns, 0.1, sign * 0.1 + 0.01 * rng.standard_normal()) for _ in range(30)
    ]
    assert not any(results[:4])
    assert all(results[8:]) == any(results) == found


def test_noise_and_a_late_lidar_are_not_opposite_turns():
    turns, rng = np.zeros(2), np.random.default_rng(4)
    assert not any(turns_oppose(turns, *(0.02 * rng.standard_normal(2))) for _ in range(2000))
    rate = 0.1 * np.sin(0.1 * np.arange(300))
    assert not any(turns_oppose(turns, *pair) for pair in zip(rate[3:], rate[:-3], strict=True))


def disputed(motions, period=0.2):
    """Return the variance of the distance that pairs of motions by odometry and by scans dispute."""
    faults, total = initial_faults(), 0.0
    for odometry, scans in motions:
        check_motion(faults, odometry, scans, True, False, period)
        total += disputed_variance(faults, odometry, scans)
    return total


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_the_standard_deviation_grows_with_the_whole_disputed_distance(direction):
    """The errors have one cause, so they do not average out."""
    ahead = direction * AHEAD
    agreed = [(ahead, ahead)] * 10
    for n in (10, 20):
        variance = disputed([*agreed, *[(ahead, 0.2 * ahead)] * n, *agreed])
        assert np.sqrt(variance / DISPUTED_VARIANCE) == pytest.approx(0.08 * n, rel=0.1)


def test_a_motion_the_other_way_is_not_disputed_once_it_pauses():
    """As where a robot backs up, odometry reports the wrong direction, and one match shows no motion."""
    back, pause = [(AHEAD, -AHEAD)] * 15, [(AHEAD, STILL)]
    one = DISPUTED_VARIANCE * AHEAD[0] ** 2
    assert disputed([*back, *pause, *back, *pause, *back]) == pytest.approx(2.0 * one, rel=0.05)


def test_scans_that_show_more_motion_or_hardly_less_are_not_disputed():
    assert disputed([(AHEAD, 2.0 * AHEAD)] * 30) == 0.0
    assert disputed([(AHEAD, 0.9 * AHEAD)] * 30) == 0.0
    assert disputed([(STILL, AHEAD)] * 30) == 0.0


def test_two_disagreements_are_independent():
    one = [(AHEAD, 0.2 * AHEAD)] * 10
    agreed = [(AHEAD, AHEAD)] * 100
    assert disputed([*one, *agreed, *one]) == pytest.approx(2.0 * disputed(one), rel=0.05)
