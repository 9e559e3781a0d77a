"""Scans that contradict odometry replace its motion; those that agree change nothing."""

import numpy as np
import pytest
from tests.extractors.scans import cast, room
from tests.sensing import at_rest
from tests.tracking.sweeps import motions_of, same, scans_of

from impslam.geometry.se2 import compose
from impslam.health import NONE
from impslam.tracking.beams import beam_columns
from impslam.tracking.odometry_check import OdometryCheck
from impslam.types import Increment

ROOM = room(-2.0, 3.5, -1.5, 2.2)
OTHER = room(-2.3, 4.7, -1.8, 1.9)
"""Three of its walls fit those of `ROOM` if the robot is 0.4 m aside."""
CORRIDOR = np.array([[[-50.0, 1.0], [50.0, 1.0]], [[50.0, -1.0], [-50.0, -1.0]]])
STEP = np.array([0.04, 0.0, 0.01])
PERIOD = 0.1  # s
COVARIANCE = np.diag([1e-4, 1e-4, 1e-4]) * 0.04


def checked(check, increment, scan):
    """Return the increment that the check returns."""
    motions, reasons, _ = check.check(motions_of([increment]), beam_columns(scans_of([scan]), 1))
    assert (reasons[0] != NONE) != same(motions.row(0), increment)
    return motions.row(0)


def drive(odometry, true=STEP, scans=40, lines=ROOM):
    """Return the increments before and after the check, the true pose, and the composed one."""
    check, pose, composed, results = OdometryCheck(), np.zeros(3), np.zeros(3), []
    for k in range(scans):
        covariance = COVARIANCE if np.any(odometry) else np.zeros((3, 3))
        increment = Increment(k * PERIOD, np.asarray(odometry, float), covariance, PERIOD)
        if k == 0:
            increment = at_rest(0.0)
        else:
            pose = compose(pose, true)
        result = checked(check, increment, cast(lines, pose=pose).scan)
        composed = compose(composed, result.d_pose)
        results.append((increment, result))
    return results, pose, composed


@pytest.mark.parametrize("true", [STEP, np.zeros(3), -STEP])
def test_odometry_that_agrees_with_the_scans_is_handed_on_as_it_is(true):
    results, _, _ = drive(true, true)
    for increment, result in results:
        assert same(result, increment)


@pytest.mark.parametrize(
    "odometry", [np.zeros(3), [0.02, 0.0, -0.05], [0.02, 0.0, 0.06]], ids=["both", "left", "right"]
)
def test_frozen_encoders_are_found_out_and_the_scans_followed(odometry):
    """Both are frozen, or one, which reports half the distance and a turn."""
    results, pose, composed = drive(odometry)
    assert same(*results[1])
    found = [not same(increment, result) for increment, result in results]
    assert all(found[10:])
    np.testing.assert_allclose(composed[:2], pose[:2], atol=0.15)
    assert abs(composed[2] - pose[2]) < 0.05
    for _, result in results[10:]:
        assert np.linalg.eigvalsh(result.covariance)[0] > 0.0


def test_the_noise_grows_with_time_if_scans_do_not_determine_the_motion():
    """A robot moves along a bare corridor while its encoders are frozen: the distance is unknown."""
    results, _, _ = drive(np.zeros(3), np.array([0.04, 0.0, 0.02]), 25, CORRIDOR)
    odometry, last = results[-1]
    assert not same(last, odometry)
    along = float(np.linalg.eigvalsh(last.covariance[:2, :2])[1])
    assert along > 0.02**2


def test_silent_odometry_is_contradicted_as_well():
    """No message comes at all: increments without motion and without duration."""
    check, pose = OdometryCheck(), np.zeros(3)
    for k in range(20):
        increment = at_rest(k * PERIOD)
        result = checked(check, increment, cast(ROOM, pose=pose).scan)
        pose = compose(pose, STEP)
    assert not same(result, increment)


def test_what_silent_odometry_reports_at_once_is_not_driven_twice():
    """The scans give the motion until odometry returns, which then reports all of it in one step."""
    check, pose, composed, missed = OdometryCheck(), np.zeros(3), np.zeros(3), np.zeros(3)
    for k in range(60):
        silent, step = 10 <= k < 30, STEP if k else np.zeros(3)
        missed = compose(missed, step)
        moved = np.zeros(3) if silent else missed
        covariance = (0.5 * moved[0]) ** 2 * np.eye(3) if k == 30 else COVARIANCE * np.any(moved)
        motion = at_rest(0.0) if k == 0 else Increment(k * PERIOD, moved, covariance, PERIOD)
        missed = missed if silent else np.zeros(3)
        pose = compose(pose, step)
        beams = beam_columns(scans_of([cast(ROOM, pose=pose).scan]), 1)
        motions, _, _ = check.check(motions_of([motion]), beams)
        composed = compose(composed, motions.d_pose[0])
    np.testing.assert_allclose(composed, pose, atol=0.05)


def test_a_room_of_which_three_walls_fit_shows_no_motion():
    """The robot is carried to another room while its wheels stand: the scan is of another place."""
    check = OdometryCheck()
    for k in range(40):
        increment = Increment(k * PERIOD, np.zeros(3), np.zeros((3, 3)), PERIOD * (k > 0))
        result = checked(check, increment, cast(ROOM if k < 20 else OTHER).scan)
        assert same(result, increment)
