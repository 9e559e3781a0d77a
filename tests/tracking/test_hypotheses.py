"""Of several poses that fit a scan the most probable is kept: slips are followed, false fits are not."""

import math

import numpy as np
import pytest
from tests.tracking.test_scan_to_map import circle, drive, odometry_of, scans_from, straight

from impslam.surfaces.surface_map import Alignment, no_evidence
from impslam.tracking.hypotheses import (
    MAX_VELOCITY_CHANGE,
    Prediction,
    chi2_of,
    cost,
    near_constant_velocity,
)

MATCH = Alignment(14, 0.4, 0.06, 0.035**-2, 1, 9.0)
SIGMAS = np.array([0.01, 0.01, 0.005])


def prediction(pose=(0.0, 0.0, 0.0), extrapolated=(0.0, 0.0, 0.0)):
    return Prediction(np.array(pose), SIGMAS**-2, np.zeros(3), np.array(extrapolated), 0.8)


def evidence(inliers):
    found = no_evidence()
    found.sums[:2] = 100.0, inliers
    return found


@pytest.mark.parametrize("heading", [0.0, 2.0, math.pi])
def test_steady_is_near_constant_velocity_in_any_frame(heading):
    predicted = prediction(extrapolated=(5.0, -3.0, heading))
    ahead = np.array([5.0, -3.0, heading])
    for k, limit in enumerate(
        (MAX_VELOCITY_CHANGE[0], MAX_VELOCITY_CHANGE[0], MAX_VELOCITY_CHANGE[1])
    ):
        for share, steady in ((0.99, True), (-0.99, True), (1.01, False), (-1.01, False)):
            d = np.zeros(3)
            d[k] = share * limit
            assert near_constant_velocity(ahead + d, predicted) is steady


def test_distance_from_odometry_wraps():
    pose = np.array([0.02, 0.0, -math.pi + 0.01])
    assert chi2_of(pose, prediction((0.0, 0.0, math.pi))) == pytest.approx(4.0 + 4.0)


def test_each_point_that_fits_counts_what_alignment_weighs_it_by():
    there = np.zeros(3)
    costs = [cost(there, prediction(), MATCH, evidence(n)) for n in (50.0, 51.0)]
    assert costs[0] - costs[1] == pytest.approx(0.5 * MATCH.information * MATCH.narrow**2)


def test_points_that_usually_do_not_fit_do_not_count():
    costs = {cost(np.zeros(3), prediction(), MATCH, evidence(n)) for n in (80.0, 85.0, 100.0)}
    assert costs == {0.0}


def test_odometry_off_by_little_costs_half_its_chi_square():
    off = cost(0.1 * SIGMAS, prediction(), MATCH, evidence(50.0))
    here = cost(np.zeros(3), prediction(), MATCH, evidence(50.0))
    assert off - here == pytest.approx(0.015, rel=0.01)


def test_a_slip_costs_its_odds_however_large_it_is():
    """A uniform density of 1 / (m^2 rad), times 0.001, against the normal one at its mean."""
    here = cost(np.zeros(3), prediction(), MATCH, evidence(50.0))
    sure = MATCH._replace(slack2=1000.0)
    for metres in (0.3, 0.5):
        slipped = cost(np.array([metres, 0.0, 0.0]), prediction(), sure, evidence(50.0)) - here
        expected = math.log(1000.0 / ((2.0 * math.pi) ** 1.5 * SIGMAS.prod()))
        assert slipped == pytest.approx(expected)


@pytest.mark.parametrize(
    "slip", [(0.9, 0.3, 0.0), (-0.6, 0.8, 0.0), (0.0, -1.5, 0.0), (0.0, 0.0, 1.2)]
)
def test_slips_are_followed(slip):
    poses = circle(60)
    error = np.zeros((60, 3))
    error[40] = slip
    _, _, off = drive(poses, odometry_of(poses, error), scans_from(poses))
    assert np.hypot(off[-1, 0], off[-1, 1]) < 0.03


def test_a_robot_that_stops_at_once_is_where_it_stopped():
    poses = straight(40)
    poses = np.concatenate([poses, np.tile(poses[-1], (10, 1))])
    _, _, off = drive(poses, odometry_of(poses), scans_from(poses))
    assert np.abs(off).max() < 0.03
