"""Landmarks enter after enough sightings in one place, and leave when seen through."""

import numpy as np
import pytest
from tests.filters.worlds import MODELS

from impslam.association.mahalanobis import Mahalanobis
from impslam.filters.ekf import Ekf
from impslam.lifecycle.immediate import Immediate
from impslam.lifecycle.tentative import Tentative
from impslam.sensors.lidar2d import Lidar2D
from impslam.types import Increment, LaserScan, Match, Observation

R = 1e-4 * np.eye(2)


def started(lifecycle):
    lifecycle.start(MODELS, Mahalanobis(), Ekf())
    return lifecycle


def cylinder(x, y):
    return Observation("cylinder", np.array([x, y], dtype=float), R)


def still(stamp):
    return Increment(stamp, np.zeros(3), 1e-8 * np.eye(3), 0.1)


def sightings(lifecycle, places, moved=(0.0, 0.0, 0.0), rate=0.1):
    """Show one cylinder at each place, None for not seen; return at which scans it is promoted."""
    found = []
    for i, place in enumerate(places):
        lifecycle.move(Increment(i * rate, np.array(moved), 1e-8 * np.eye(3), rate))
        seen = [] if place is None else [cylinder(*place)]
        if lifecycle.promote(seen, i * rate, lost=False):
            found.append(i)
    return found


def test_confirmed_after_sightings_and_time():
    lifecycle = started(Tentative(sightings=3, persistence=0.4))
    assert sightings(lifecycle, [(2, 1)] * 6)[:1] == [4]


def test_seen_from_a_moving_robot_it_is_the_same_landmark():
    lifecycle = started(Tentative(sightings=4, persistence=0.0))
    assert sightings(lifecycle, [(2 - 0.1 * i, 1) for i in range(6)], moved=(0.1, 0, 0))[0] == 3


def test_a_walker_is_never_confirmed():
    lifecycle = started(Tentative())
    assert sightings(lifecycle, [(2 + 0.1 * i, 1) for i in range(40)]) == []


def test_a_slow_walker_is_never_confirmed():
    """A walker is compared with where it was first seen, not with where it was last seen."""
    lifecycle = started(Tentative(sightings=8, persistence=0.7))
    assert sightings(lifecycle, [(2 + 0.02 * i, 1) for i in range(40)]) == []


def test_landmarks_seen_too_rarely_are_dropped():
    lifecycle = started(Tentative(sightings=3, timeout=0.5))
    assert sightings(lifecycle, ([(2, 1)] + [None] * 8) * 5) == []


def test_landmarks_of_the_first_scan_are_added_at_once():
    lifecycle = started(Tentative())
    assert len(lifecycle.promote([cylinder(1, 1), cylinder(2, 0)], 0.0, lost=True)) == 2


def trial(scan, matched, lifecycle=None, ids=(7,), rate=0.25):
    """Enter landmarks with the first scan, of an empty map; return when and which of them go.

    `matched` are the ids that each of the scans after it matches.
    """
    lifecycle = started(lifecycle or Tentative())
    ids, gone = list(ids), {}
    for i, seen in enumerate([(), *matched]):
        lifecycle.promote([cylinder(3, 0)] if i == 0 else [], i * rate, lost=i == 0)
        outlines = np.tile(
            [3.0, 0.0], (len(ids), 2, 1)
        )  # on the wall, so that nothing is seen through
        matches = [Match(0, number, np.zeros(2), R, 0.0) for number in seen]
        for number in lifecycle.review(scan, np.zeros(3), np.array(ids), outlines, matches):
            gone[number] = i
            ids.remove(number)
    return gone


def test_landmarks_only_in_the_first_scan_are_removed_after_the_timeout(scan_of_a_wall):
    assert trial(scan_of_a_wall, [()] * 20, Tentative(timeout=1.0)) == {7: 5}


def test_landmarks_in_the_first_scan_and_enough_others_stay(scan_of_a_wall):
    assert trial(scan_of_a_wall, [(7,)] * 4 + [()] * 40) == {}


def test_sightings_of_the_first_scans_need_time_too(scan_of_a_wall):
    at_once = trial(scan_of_a_wall, [(7,)] * 4 + [()] * 40, Tentative(persistence=1.5))
    assert at_once == {7: 9}


def test_trials_are_of_each_landmark_by_itself(scan_of_a_wall):
    matched = [(7,), (7, 8), (7,), (7,)] + [()] * 40
    assert trial(scan_of_a_wall, matched, ids=(7, 8, 9)) == {9: 5, 8: 7}


def test_only_landmarks_of_the_first_scan_are_on_trial(scan_of_a_wall):
    lifecycle = started(Tentative())
    on_the_wall = np.full((1, 2, 2), [3.0, 0.0])
    for i in range(40):
        lifecycle.promote([], 0.1 * i, lost=False)
        seen = lifecycle.review(scan_of_a_wall, np.zeros(3), np.array([7]), on_the_wall, [])
        assert seen == []


def test_a_new_run_starts_without_trials(scan_of_a_wall):
    lifecycle = started(Tentative())
    lifecycle.promote([cylinder(3, 0)], 0.0, lost=True)
    place = np.full((1, 2, 2), [3.0, 0.0])
    lifecycle.review(scan_of_a_wall, np.zeros(3), np.array([7]), place, [])
    started(lifecycle)
    lifecycle.promote([], 5.0, lost=False)
    assert lifecycle.review(scan_of_a_wall, np.zeros(3), np.array([7]), place, []) == []


def test_the_thesis_takes_all_at_once_and_keeps_all(scan_of_a_wall):
    lifecycle = started(Immediate())
    seen = [cylinder(1, 1)]
    assert lifecycle.promote(seen, 0.0, lost=False) == [0]
    gone = np.array([[[1.0, 0.0], [1.0, 0.0]]])
    assert lifecycle.review(scan_of_a_wall, np.zeros(3), np.array([0]), gone, []) == []


@pytest.fixture
def scan_of_a_wall():
    """A wall at x = 3, seen from the origin by a lidar 0.1 m ahead of it."""
    angles = np.linspace(-1, 1, 401)
    message = LaserScan(0.0, angles, 2.9 / np.cos(angles), np.zeros(401))
    return Lidar2D(mount=(0.1, 0.0, 0.0)).scan(message, np.zeros(3))


def reviews(scan, ends, pose=(0, 0, 0), count=40):
    lifecycle = started(Tentative(max_score=10.0))
    ends = np.array([ends], dtype=float)
    for i in range(count):
        if lifecycle.review(scan, np.array(pose, dtype=float), np.array([7]), ends, []):
            return i
    return None


@pytest.mark.parametrize(
    ("ends", "goes"),
    [
        ([[2.0, 0.0], [2.0, 0.0]], True),  # a cylinder that is gone: beams pass through it
        ([[2.0, -0.5], [2.0, 0.5]], True),  # a door that has opened
        ([[3.0, -1.0], [3.0, 1.0]], False),  # the wall itself, only not extracted
        ([[4.0, 0.0], [4.0, 0.0]], False),  # occluded by the wall
        ([[4.0, -1.0], [4.0, 1.0]], False),
        ([[-2.0, 0.0], [-2.0, 0.0]], False),  # behind the robot, out of view
    ],
)
def test_only_landmarks_seen_through_are_removed(scan_of_a_wall, ends, goes):
    assert (reviews(scan_of_a_wall, ends) is not None) == goes


def test_the_check_follows_the_pose(scan_of_a_wall):
    pose = (5.0, 5.0, np.pi / 2)
    assert reviews(scan_of_a_wall, [[5.0, 7.0], [5.0, 7.0]], pose) is not None
    assert reviews(scan_of_a_wall, [[5.0, 9.0], [5.0, 9.0]], pose) is None


def test_long_confirmed_landmarks_are_removed_later_than_new_ones(scan_of_a_wall):
    lifecycle = started(Tentative(max_score=10.0))
    gone, ids = np.array([[[2.0, 0.0], [2.0, 0.0]]]), np.array([7])
    for _ in range(50):
        match = Match(0, 7, np.zeros(2), R, 0.0)
        lifecycle.review(scan_of_a_wall, np.zeros(3), ids, gone, [match])
    misses = 0
    while not lifecycle.review(scan_of_a_wall, np.zeros(3), ids, gone, []):
        misses += 1
    assert misses == 10
    assert misses > reviews(scan_of_a_wall, gone[0])
