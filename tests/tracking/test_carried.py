"""A robot that is carried to a place where its scans still match: new maps begin, and it is reported."""

import numpy as np
import pytest
from tests.extractors.scans import room
from tests.tracking.sweeps import steps
from tests.tracking.test_scan_to_map import PERIOD, odometry_of, scans_from

from impslam.geometry.se2 import compose
from impslam.health import CARRIED, CHANGED, NONE
from impslam.tracking.scan_to_map import ScanToMap

HALL = np.concatenate((
    room(-6.0, 6.0, -2.0, 2.0), room(2.5, 3.1, 1.2, 1.8)[:, ::-1], room(1.0, 1.6, -1.8, -1.2)[:, ::-1],
))  # fmt: skip
"""It looks the same after half a turn, except for two boxes."""
HALF_TURN = np.array([0.0, 0.0, np.pi])
LEFT = 20  # scans before


def poses(scans=60, step=0.04):
    """Return poses (m, 3) of a drive along the hall."""
    drive = np.zeros((scans, 3))
    drive[:, 0] = step * (np.arange(scans) - LEFT)
    return drive


def turned(drive):
    """Return a drive of a robot that is turned by half between two scans."""
    out = drive.copy()
    out[LEFT:] = compose(np.tile(HALF_TURN, (len(drive) - LEFT, 1)), drive[LEFT:])
    return out


def followed(truth, odometry, people=None, cut=0):
    """Return the steps for scans from true poses; the first scans show these walls as well."""
    scans = scans_from(truth, HALL)
    if people is not None:
        scans[:LEFT] = scans_from(truth[:LEFT], np.concatenate((HALL, people)))
    tracker, motions = ScanToMap(), odometry_of(odometry)
    if not cut:
        return [steps(tracker, motions, scans)]
    return [steps(tracker, motions[a:b], scans[a:b]) for a, b in ((0, cut), (cut, len(scans)))]


def test_a_robot_that_is_turned_where_it_stands_is_found_out():
    drive = poses()
    (out,) = followed(turned(drive), drive)
    assert (out.reasons[:LEFT] == NONE).all()
    assert out.reasons[LEFT] == CHANGED
    at = np.flatnonzero(out.reasons == CARRIED)
    assert len(at) == 1
    assert LEFT < at[0] <= LEFT + 1.0 / PERIOD + 1
    assert 0.05 < out.amounts[at[0]] < 0.5  # of the beams
    assert out.is_keyframe[at[0]]
    assert out.reference[at[0]]
    assert (out.reasons[at[0] + 1 :] == NONE).all()


def test_a_robot_that_stands_is_reported_with_the_next_match():
    drive = np.zeros((60, 3))
    (out,) = followed(turned(drive), drive)
    (at,) = np.flatnonzero(out.reasons == CARRIED)
    assert 0.05 < out.amounts[at] < 0.5
    assert LEFT < at <= LEFT + 1.0 / PERIOD + 2


@pytest.mark.parametrize("cut", [LEFT, LEFT + 1, LEFT + 5])
def test_cutting_the_scans_changes_nothing(cut):
    drive = poses()
    (whole,), parts = followed(turned(drive), drive), followed(turned(drive), drive, cut=cut)
    for name in ("d_pose", "covariance", "reasons", "amounts", "is_keyframe"):
        joined = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_array_equal(joined, getattr(whole, name))


def test_a_scan_with_much_that_is_new_is_in_doubt_until_that_is_known_to_be_static():
    """One wall of a hall is nearer; the scan still fits the other ones."""
    drive = poses()
    scans = scans_from(drive, room(-6.0, 6.0, -2.0, 2.0))
    scans[LEFT:] = scans_from(drive[LEFT:], room(-6.0, 6.0, -2.0, 0.9))
    out = steps(ScanToMap(), odometry_of(drive), scans)
    (at,) = np.flatnonzero(out.reasons == CARRIED)
    assert at == LEFT + 1.0 / PERIOD
    assert (out.reasons[LEFT:at] == CHANGED).all()
    assert (out.amounts[LEFT:at] > 0.12).all()
    assert not out.reasons[:LEFT].any()
    assert not out.reasons[at + 1 :].any()


@pytest.mark.parametrize("x", [0.6, 1.5, 3.0])
def test_a_person_who_stood_and_is_gone_is_no_new_place(x):
    person = room(x, x + 0.3, -0.4, 0.1)[:, ::-1]
    (out,) = followed(poses(), poses(), person)
    assert CARRIED not in out.reasons


def test_a_leg_beside_the_lidar_that_is_gone_is_no_new_place():
    """It covers a sixth of the view, but is only two decimetres wide."""
    leg = room(0.12, 0.22, -0.1, 0.1)[:, ::-1]
    (out,) = followed(np.zeros((60, 3)), np.zeros((60, 3)), leg)
    assert not {CHANGED, CARRIED} & set(out.reasons.tolist())


@pytest.mark.parametrize("x", [0.5, 0.7, 1.5])
def test_a_door_that_opens_at_once_is_no_new_place(x):
    """At 5 Hz, a second scan already shows the room behind a leaf of 1.2 m that swings open."""
    door = np.array([[[x, 0.6], [x, -0.6]]])
    (out,) = followed(np.zeros((60, 3)), np.zeros((60, 3)), door)
    assert not {CHANGED, CARRIED} & set(out.reasons.tolist())


def test_two_objects_that_are_gone_together_show_a_new_place():
    boxes = np.concatenate([room(0.8, 1.1, y, y + 0.3)[:, ::-1] for y in (-1.2, 0.9)])
    (out,) = followed(np.zeros((60, 3)), np.zeros((60, 3)), boxes)
    assert (out.reasons == CARRIED).sum() == 1


def test_a_robot_that_drives_on_is_not_carried():
    (out,) = followed(poses(), poses())
    assert not out.reasons.any()
