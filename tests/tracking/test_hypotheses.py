"""Of several poses that fit a scan the most probable is kept: slips are followed, false fits are not."""

import math

import numpy as np
import pytest
from tests.extractors.scans import room
from tests.tracking.test_scan_to_map import (
    ROOM,
    circle,
    drive,
    odometry_of,
    scans_from,
    silent,
    straight,
)

from impslam.geometry.se2 import compose
from impslam.health import ELSEWHERE, UNEXPLAINED
from impslam.surfaces.surface_map import Alignment, add, align, empty_surface_map, no_evidence
from impslam.tracking.beams import Geometry
from impslam.tracking.hypotheses import (
    MAX_VELOCITY_CHANGE,
    PosePrediction,
    align_from_predictions,
    chi2_of,
    cost,
    is_expected,
)
from impslam.tracking.reference_scan import LastScan
from impslam.types import Increment

MATCH = Alignment(14, 0.4, 0.06, 0.035**-2, 1, 9.0)
SIGMAS = np.array([0.01, 0.01, 0.005])


BEAMS = Geometry(np.zeros(3), -math.pi, math.tau / 360)


def prediction(pose=(0.0, 0.0, 0.0), extrapolated=(0.0, 0.0, 0.0)):
    nothing = LastScan(np.zeros(360), np.zeros(3), BEAMS)
    return PosePrediction(
        np.array(pose), SIGMAS**-2, np.zeros(3), np.array(extrapolated), 0.8, nothing
    )


def cost_at(pose, match, inliers):
    """Return the cost of a pose where `inliers` of 100 points fit."""
    nothing, no_points = empty_surface_map(1.0, 1.0, 1), np.empty((0, 5), np.float32)
    return cost(nothing, no_points, np.array(pose), prediction(), match, evidence(inliers))


def evidence(inliers):
    found = no_evidence()
    found.sums[:2] = 100.0, inliers
    return found


@pytest.mark.parametrize("heading", [0.0, 2.0, math.pi])
def test_a_match_near_constant_velocity_is_expected_in_any_frame(heading):
    at = (5.0, -3.0, heading)
    predicted = prediction(at, extrapolated=at)._replace(information=np.ones(3))
    ahead = np.array([5.0, -3.0, heading])
    for k, limit in enumerate(
        (MAX_VELOCITY_CHANGE[0], MAX_VELOCITY_CHANGE[0], MAX_VELOCITY_CHANGE[1])
    ):
        for share, steady in ((0.99, True), (-0.99, True), (1.01, False), (-1.01, False)):
            d = np.zeros(3)
            d[k] = share * limit
            assert is_expected(ahead + d, predicted) is steady


@pytest.mark.parametrize(("sigmas", "expected"), [(2.7, True), (2.9, False)])
def test_a_match_far_from_odometry_is_not_expected(sigmas, expected):
    pose = np.array([sigmas * SIGMAS[0], 0.0, 0.0])
    assert is_expected(pose, prediction()) is expected


def test_an_object_in_front_of_a_wall_does_not_draw_the_pose_away():
    """It is 25 cm from that wall, within the wide kernel, and new; the others stay where they were."""

    def wall(first, last, points):
        rows = [(x, y, 0.0, -1.0, 1.0) for x, y in np.linspace(first, last, points)]
        return np.array(rows, np.float32)

    left, side = wall((-3.0, 1.0), (0.0, 1.0), 60), wall((3.0, -1.0), (3.0, 1.0), 30)
    side[:, 2:4] = -1.0, 0.0
    right, object_ = wall((0.1, 0.7), (3.0, 0.7), 60), wall((0.1, 0.45), (3.0, 0.45), 45)
    known, scan = empty_surface_map(20.0, 20.0, 5000), np.concatenate([left, object_, side])
    add(known, np.concatenate([left, right, side]), np.zeros(3), 20.0)
    predicted, pose, found = prediction()._replace(usual=0.6), np.zeros(3), no_evidence()
    align(known, scan, pose, predicted.information, MATCH, found)
    assert not is_expected(pose, predicted)
    assert pose[1] > 0.1
    align_from_predictions(known, scan, predicted, MATCH, pose, found)
    np.testing.assert_allclose(pose, 0.0, atol=1e-3)


def test_distance_from_odometry_wraps():
    pose = np.array([0.02, 0.0, -math.pi + 0.01])
    assert chi2_of(pose, prediction((0.0, 0.0, math.pi))) == pytest.approx(4.0 + 4.0)


def test_each_point_that_fits_counts_what_alignment_weighs_it_by():
    costs = [cost_at(np.zeros(3), MATCH, n) for n in (50.0, 51.0)]
    assert costs[0] - costs[1] == pytest.approx(0.5 * MATCH.information * MATCH.narrow**2)


def test_points_that_usually_do_not_fit_do_not_count():
    costs = {cost_at(np.zeros(3), MATCH, n) for n in (80.0, 85.0, 100.0)}
    assert costs == {0.0}


def test_odometry_off_by_little_costs_half_its_chi_square():
    off = cost_at(0.1 * SIGMAS, MATCH, 50.0)
    here = cost_at(np.zeros(3), MATCH, 50.0)
    assert off - here == pytest.approx(0.015, rel=0.01)


def test_a_slip_costs_its_odds_however_large_it_is():
    """A uniform density of 1 / (m^2 rad), times 0.001, against the normal one at its mean."""
    here = cost_at(np.zeros(3), MATCH, 50.0)
    sure = MATCH._replace(slack2=1000.0)
    for metres in (0.3, 0.5):
        slipped = cost_at((metres, 0.0, 0.0), sure, 50.0) - here
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


@pytest.mark.parametrize("seconds", [0.1, 5.0])
def test_after_a_gap_a_scan_that_fits_only_where_the_robot_was_is_not_matched(seconds):
    """Odometry reports 3 m to a room that looks the same; at once, it would be a slip."""
    poses = np.vstack((straight(20), np.tile(straight(20)[-1], (10, 1))))
    increments = odometry_of(poses)
    increments[20] = Increment(5.0, np.array([3.0, 0.0, 0.0]), 0.03 * np.eye(3), seconds)
    _, out, _ = drive(poses, increments, scans_from(poses))
    if seconds < 1.0:
        np.testing.assert_allclose(out.d_pose[20], 0.0, atol=0.01)
        assert (out.reasons < UNEXPLAINED).all()
    else:
        np.testing.assert_allclose(out.d_pose[20], [3.0, 0.0, 0.0], atol=0.01)
        assert (out.reasons[20:24] == UNEXPLAINED).all()
        assert (out.reasons == ELSEWHERE).any()


def test_time_in_which_the_robot_stands_is_no_gap():
    """Its scans are not matched; then odometry reports 3 m, but the robot still stands."""
    poses = np.vstack((straight(20), np.tile(straight(20)[-1], (80, 1))))
    error = np.zeros((100, 3))
    error[70] = 3.0, 0.0, 0.0
    _, out, off = drive(poses, odometry_of(poses, error), scans_from(poses))
    assert not out.reference[21:70].any()
    assert (out.reasons < UNEXPLAINED).all()
    assert np.abs(off[70:]).max() < 0.01


@pytest.mark.parametrize("sigma", [0.1, 0.2, 3.0])
def test_odometry_that_covers_a_gap_leads_to_places_that_are_not_in_the_map(sigma):
    """To a room that was never seen; odometry that does not know the path cannot tell."""
    lines = np.concatenate((ROOM, room(4.2, 9.0, -1.8, 2.4)))
    first, gap = straight(20), np.array([6.0, 0.0, 0.0])
    there = straight(10, start=compose(first[-1], gap))
    increments = odometry_of(np.vstack((first, there)))
    increments[20] = Increment(7.0, gap, sigma**2 * np.eye(3), 5.0)
    _, out, off = drive(np.vstack((first, there)), increments, scans_from([*first, *there], lines))
    if sigma < 0.15:
        assert (out.reasons < UNEXPLAINED).all()
        assert np.abs(off[20:]).max() < 0.1
    else:
        assert (out.reasons == ELSEWHERE).any()


def test_odometry_that_was_silent_while_scans_showed_the_motion_does_not_move_the_robot_again():
    """Its motion of 3 s comes with one sweep; the robot is where the scans have led it."""
    poses = circle(80)
    _, out, off = drive(poses, silent(poses), scans_from(poses))
    assert (out.reasons < UNEXPLAINED).all()
    assert np.hypot(off[61:, 0], off[61:, 1]).max() < 0.03


def test_a_robot_that_stops_at_once_is_where_it_stopped():
    poses = straight(40)
    poses = np.concatenate([poses, np.tile(poses[-1], (10, 1))])
    _, _, off = drive(poses, odometry_of(poses), scans_from(poses))
    assert np.abs(off).max() < 0.03
