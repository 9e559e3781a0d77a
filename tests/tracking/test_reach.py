"""After a gap that odometry does not cover, the tracker says how far from the match the robot may be."""

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.tracking.test_scan_to_map import (
    BARE,
    CORRIDOR,
    NOISE,
    circle,
    drive,
    odometry_of,
    scans_from,
    silent,
    straight,
)

from impslam.noise import MIN_BREAK, UNKNOWN
from impslam.types import Increment

GAP = 40  # the scan after it
SIGMA, TURN_SIGMA = 0.4, 0.05
PATH_UNKNOWN = np.diag([SIGMA, SIGMA, TURN_SIGMA]) ** 2


def after_gap(covariance, seconds=5.0):
    """Return the steps of a drive whose scan `GAP` comes `seconds` after the one before."""
    poses = circle(60)
    increments = odometry_of(poses)
    d_pose, later = increments[GAP].d_pose, seconds - increments[GAP].duration
    for k in range(GAP, len(poses)):
        increments[k] = replace(increments[k], stamp=increments[k].stamp + later)
    increments[GAP] = Increment(increments[GAP].stamp, d_pose, covariance, seconds)
    return drive(poses, increments, scans_from(poses))[1]


def test_the_reach_is_three_standard_deviations_of_odometry():
    out = after_gap(PATH_UNKNOWN)
    assert not out.reach[np.arange(60) != GAP].any()
    np.testing.assert_allclose(
        out.reach[GAP], [3.0 * math.sqrt(2.0) * SIGMA, 3.0 * TURN_SIGMA], rtol=0.05
    )
    assert out.is_keyframe[GAP]  # so that an estimator sees it


@pytest.mark.parametrize(
    ("covariance", "seconds"), [(PATH_UNKNOWN, 0.1), (NOISE, 5.0)], ids=["no gap", "covered"]
)
def test_what_odometry_covers_leaves_no_doubt(covariance, seconds):
    assert not after_gap(covariance, seconds).reach.any()


@pytest.mark.parametrize(
    ("covariance", "expected"),
    [(PATH_UNKNOWN, 3.0 * math.sqrt(2.0 * UNKNOWN)), (NOISE, 0.0)],
    ids=["jump", "standstill"],
)
def test_odometry_may_begin_anew_in_a_break(covariance, expected):
    """Then what it reports is no motion, unless it reports none."""
    out = after_gap(covariance, 2.0 * MIN_BREAK)
    np.testing.assert_allclose(out.reach[GAP], [expected, math.pi * (expected > 0.0)])


def test_a_match_along_a_wall_is_as_uncertain_as_odometry():
    """Scans show no motion along a corridor: after a gap, odometry's covariance remains there."""
    poses = np.column_stack((0.1 * np.arange(30.0), np.zeros((30, 2))))
    increments = odometry_of(poses)
    increments[20] = replace(increments[20], covariance=PATH_UNKNOWN, duration=5.0)
    out = drive(poses, increments, scans_from(poses, CORRIDOR, **BARE))[1]
    along, across, _ = np.diag(out.covariance[20] + out.error[20])
    assert along == pytest.approx(SIGMA**2, rel=0.2)
    assert across < 0.05**2


@pytest.mark.parametrize(("step", "expected"), [(0.04, 2.0), (0.005, 0.0)])
def test_without_odometry_the_robot_may_have_gone_on_at_its_speed(step, expected):
    """A scan every 0.1 s; a robot that hardly moves has not gone far in 5 s either."""
    poses = straight(60, step)
    unknown = np.diag([UNKNOWN, UNKNOWN, 10.0])
    increments = [replace(i, d_pose=np.zeros(3), covariance=unknown) for i in odometry_of(poses)]
    for k in range(50, 60):
        increments[k] = replace(increments[k], stamp=increments[k].stamp + 4.9)
    increments[50] = replace(increments[50], duration=5.0)
    out = drive(poses, increments, scans_from(poses))[1]
    assert out.reach[50, 0] == pytest.approx(expected, rel=0.2)
    assert not out.reach[:50].any()


def test_a_gap_after_the_first_scan_has_no_speed_before_it():
    poses = straight(5)
    unknown = np.diag([UNKNOWN, UNKNOWN, 10.0])
    increments = [replace(i, d_pose=np.zeros(3), covariance=unknown) for i in odometry_of(poses)]
    increments[0] = replace(increments[0], duration=0.0)
    increments[1] = replace(increments[1], duration=8.0)
    assert not drive(poses, increments, scans_from(poses))[1].reach.any()


def test_odometry_that_comes_late_is_covered_by_scans():
    """It is silent for 3 s, while the scans show where the robot goes."""
    poses = circle(80)
    increments = silent(poses, NOISE + PATH_UNKNOWN)
    assert not drive(poses, increments, scans_from(poses))[1].reach.any()
