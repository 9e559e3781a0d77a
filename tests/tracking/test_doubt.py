"""What scans that do not fit, and motions that do not agree, are said to be."""

import numpy as np
import pytest

from impslam.health import ELSEWHERE, NONE, OPEN, PUSHED, SLIPPED, STALLED, UNEXPLAINED
from impslam.tracking.doubt import BARE, FITS, Fit, compare, judge, lasting, no_doubt, opposed

USUAL = 0.85
AHEAD, STILL = np.array([0.1, 0.0, 0.0]), np.zeros(3)


def fit(share, points=100.0, off=STILL):
    return Fit(points, share, off)


def judged(shares, period=0.2):
    doubt = no_doubt()
    return [judge(doubt, fit(share), USUAL, period) for share in shares]


def test_one_scan_that_does_not_fit_is_suspected_and_three_are_another_place():
    assert judged([0.8, 0.1, 0.8]) == [NONE, UNEXPLAINED, NONE]
    assert judged([0.8, 0.1, 0.1, 0.1]) == [NONE, UNEXPLAINED, UNEXPLAINED, ELSEWHERE]
    assert judged([0.8, *[0.1] * 5], period=0.15) == [
        NONE,
        *[UNEXPLAINED] * 3,
        ELSEWHERE,
        UNEXPLAINED,
    ]


@pytest.mark.parametrize("period", [0.02, 0.1, 0.2, 0.5])
def test_another_place_is_told_within_a_second(period):
    said = judged([0.1] * 60, period)
    assert period * said.index(ELSEWHERE) < max(0.75, 2.5 * period)


def test_a_scan_fits_again_only_where_it_fits_well():
    middle = (0.5 * (FITS + 0.7)) * USUAL
    assert judged([middle, 0.1, middle, USUAL]) == [NONE, UNEXPLAINED, UNEXPLAINED, NONE]


def test_where_shares_vary_a_low_one_says_less():
    doubt, rng = no_doubt(), np.random.default_rng(1)
    for share in np.clip(USUAL + 0.2 * rng.standard_normal(300), 0.55, 1.0):
        assert judge(doubt, fit(share), USUAL, 0.2) == NONE
    assert judge(no_doubt(), fit(0.45), USUAL, 0.2) == UNEXPLAINED
    assert judge(doubt, fit(0.45), USUAL, 0.2) == NONE


def test_where_scans_seldom_fit_one_that_does_not_says_nothing():
    doubt = no_doubt()
    for share in np.tile([0.7, 0.5], 100):
        judge(doubt, fit(share), 0.6, 0.2)
    assert judge(doubt, fit(0.1), 0.8, 0.2) == NONE
    assert judge(no_doubt(), fit(0.1), 0.6, 0.2) == NONE
    assert judge(no_doubt(), fit(0.1), 0.8, 0.2) == UNEXPLAINED


@pytest.mark.parametrize(
    ("told", "shown", "said"),
    [(AHEAD, AHEAD, NONE), (AHEAD, STILL, STALLED), (STILL, AHEAD, PUSHED), (STILL, STILL, NONE)],
)
def test_wheels_and_scans_are_compared_over_a_second(told, shown, said):
    doubt = no_doubt()
    for k in range(5):
        reason, _ = compare(doubt, told, shown, True, False, 0.2)
        assert reason in {NONE, said}
        assert k > 0 or reason == NONE  # one match tells nothing
    assert reason == said


def test_what_a_match_said_lasts_for_a_second():
    doubt = no_doubt()
    assert lasting(doubt, 0.1) == (NONE, 0.0)
    for _ in range(5):
        compare(doubt, AHEAD, STILL, True, False, 0.2)
    assert lasting(doubt, 0.9) == (STALLED, 0.0)
    assert lasting(doubt, 1.1) == (NONE, 0.0)


def test_turns_are_compared_as_well():
    doubt, turn = no_doubt(), np.array([0.0, 0.0, 0.1])
    said = [compare(doubt, turn, STILL, True, False, 0.2)[0] for _ in range(5)]
    assert said[-1] == STALLED


def test_along_a_bare_corridor_nothing_is_compared_and_the_way_is_told():
    doubt = no_doubt()
    said = [compare(doubt, AHEAD, STILL if k < 5 else AHEAD, False, False, 0.2) for k in range(20)]
    assert [reason for reason, _ in said[:5]] == [NONE] * 5
    assert said[-1] == (OPEN, pytest.approx(1.5))
    assert said[-1][1] > BARE
    assert compare(doubt, AHEAD, AHEAD, True, False, 0.2) == (NONE, 0.0)


def test_a_pose_far_from_odometry_has_slipped():
    assert compare(no_doubt(), AHEAD, 3.0 * AHEAD, True, True, 0.2)[0] == SLIPPED


def test_few_points_say_nothing():
    assert judge(no_doubt(), fit(0.1, points=24.0), USUAL, 0.2) == NONE


@pytest.mark.parametrize(("off", "said"), [(0.0, NONE), (0.1, NONE), (0.3, UNEXPLAINED)])
def test_a_scan_that_fits_somewhere_else_has_to_fit_better(off, said):
    doubt, away = no_doubt(), np.array([off, 0.0, 0.0])
    assert judge(doubt, fit(0.1), USUAL, 0.2) == UNEXPLAINED
    assert judge(doubt, fit(0.8 * USUAL, off=away), USUAL, 0.2) == said
    assert judge(doubt, fit(0.95 * USUAL, off=away), USUAL, 0.2) == NONE


@pytest.mark.parametrize(("sign", "found"), [(1.0, False), (-1.0, True)])
def test_turns_of_opposite_signs_are_told_after_half_a_radian(sign, found):
    turns, rng = np.zeros(2), np.random.default_rng(3)
    said = [opposed(turns, 0.1, sign * 0.1 + 0.01 * rng.standard_normal()) for _ in range(30)]
    assert not any(said[:4])
    assert all(said[8:]) == any(said) == found


def test_noise_of_a_straight_drive_and_a_late_lidar_turn_no_opposite_way():
    turns, rng = np.zeros(2), np.random.default_rng(4)
    assert not any(opposed(turns, *(0.02 * rng.standard_normal(2))) for _ in range(2000))
    rate = 0.1 * np.sin(0.1 * np.arange(300))
    assert not any(opposed(turns, *pair) for pair in zip(rate[3:], rate[:-3], strict=True))
