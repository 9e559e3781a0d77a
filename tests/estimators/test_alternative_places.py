"""After a gap in the data, places that look like the one chosen are reported until scans differ."""

import tracemalloc

import numpy as np
import pytest
from tests.filters.worlds import MODELS, R_POINT, R_WALL, wall_seen

from impslam.association.mahalanobis import Mahalanobis
from impslam.estimators.alternative_places import MIN_KEYFRAMES, AlternativePlaces
from impslam.estimators.landmarks import Landmarks
from impslam.filters.riekf import RightInvariantEkf
from impslam.geometry.se2 import inverse, transform
from impslam.landmarks.gps import GpsFrame
from impslam.lifecycle.immediate import Immediate
from impslam.map import Keyframe
from impslam.types import Increment, Landmark, Observation

DOORS = np.array([[x, 1.0] for x in (2.0, 8.0, 14.0)])
PILLAR = np.array([10.0, -0.8])
SIDES = np.array([[[-2, 1], [18, 1]], [[18, -1], [-2, -1]]], float)
FACES = np.array([[[x, 1.0], [x, 1.4]] for x in (3.0, 9.0, 15.0)])
"""Walls across the corridor, one beside each door."""
WIDE = np.diag([9.0, 1.0])
REACH = 3.0


def seen_from(x, *, points=True, faces=False):
    """Return what a robot sees from (x, 0): both sides of the corridor, and what is within `REACH`."""
    pose = np.array([x, 0.0, 0.0])
    near = [point for point in (*DOORS, PILLAR) if points and abs(point[0] - x) < REACH]
    seen = [Observation("corner", transform(inverse(pose), point), R_POINT) for point in near]
    walls = [np.clip(side, [x - REACH, -1], [x + REACH, 1]) for side in SIDES]
    walls += [face for face in FACES if faces and abs(face[0, 0] - x) < REACH]
    for ends in walls:
        z, in_base = wall_seen(pose, ends)
        seen.append(Observation("wall", z, R_WALL, end_points=in_base))
    return tuple(seen)


def mark(number, kind, ends):
    """Return a landmark: a point, or a wall with these ends."""
    none, is_wall = np.zeros((2, 2)), np.ndim(ends) == 2
    position = np.mean(ends, axis=0) if is_wall else ends
    return Landmark(number, kind, position, {}, none, ends if is_wall else None, 9, 0.0, 0.0)


LANDMARKS = [mark(k, "corner", point) for k, point in enumerate((*DOORS, PILLAR))]
LANDMARKS += [mark(10 + k, "wall", ends) for k, ends in enumerate((*SIDES, *FACES))]


def at(x):
    return np.array([x, 0.0, 0.0])


def after_gap(estimate, truth, spread=WIDE, **what):
    """Return the state after the first scan after a gap, taken at `truth` and matched at `estimate`."""
    found = AlternativePlaces()
    found.begin(spread, 99)
    found.review(at(estimate), at(estimate), seen_from(truth, **what), LANDMARKS)
    return found


@pytest.mark.parametrize("what", [{}, {"points": False, "faces": True}])
def test_doors_at_equal_distances_are_other_places(what):
    assert after_gap(3.0, 3.0, **what).exist


def test_a_motion_that_is_certain_enough_excludes_other_places():
    assert not after_gap(3.0, 3.0, spread=np.diag([1.0, 1.0])).exist


def test_a_place_that_differs_by_several_landmarks_does_not_look_alike():
    landmarks = [
        *LANDMARKS,
        mark(20, "corner", np.array([2.5, -0.7])),
        mark(21, "corner", DOORS[0] + 1),
    ]
    points = [DOORS[0], landmarks[-2].position, landmarks[-1].position]
    seen = [Observation("corner", point - at(3.0)[:2], R_POINT) for point in points]
    found = AlternativePlaces()
    found.begin(WIDE, 99)
    found.review(at(3.0), at(3.0), seen, landmarks)
    assert not found.exist
    assert not found.watching


def test_the_search_waits_for_a_scan_that_shows_the_position_along_the_corridor():
    found = after_gap(5.0, 5.0, points=False)
    assert found.watching
    assert not found.exist
    found.review(at(3.0), at(3.0), seen_from(3.0), LANDMARKS)
    assert found.exist


def test_scans_tell_the_places_apart():
    found = after_gap(
        8.5, 8.5, spread=np.diag([16.0, 1.0])
    )  # with the pillar, one missing elsewhere
    assert found.exist
    for x in np.linspace(8.6, 9.0, MIN_KEYFRAMES - 1):
        found.review(at(x), at(x), seen_from(x), LANDMARKS)
        assert found.exist
    found.review(at(9.1), at(9.1), seen_from(9.1), LANDMARKS)
    assert not found.exist
    assert not found.watching


def test_landmarks_that_are_new_since_the_gap_do_not_confirm_the_place():
    """A robot at 8 m that was matched at 2 m maps the pillar anew there, and finds it again."""
    found = after_gap(2.5, 8.5)
    mapped = [*LANDMARKS, mark(100, "corner", PILLAR - [6.0, 0.0])]
    for x in np.linspace(8.6, 9.5, 10):
        found.review(at(x - 6.0), at(x - 6.0), seen_from(x), mapped)
    assert found.exist


def test_the_estimator_searches_after_an_uncertain_motion_only():
    for sigma, expected in ((0.01, False), (4.0, True)):
        slam = Landmarks()
        parts = {
            "filter": RightInvariantEkf(),
            "association": Mahalanobis(),
            "lifecycle": Immediate(),
        }
        slam.start(at(2.0), models=MODELS, **parts)
        drive(slam, np.arange(2.2, 15.0, 0.3), 0.01)
        revision = drive(slam, [14.2], sigma)
        assert revision.fits_elsewhere == expected


def test_walls_that_are_out_of_reach_change_nothing_and_take_no_memory():
    """Of 1000 walls elsewhere, each pair with other directions would intersect: 240 MB."""
    far = [
        mark(1000 + k, "wall", [[x, 50.0 + k], [x + 1.0, 50.0 + k + slope]])
        for k in range(500)
        for x, slope in ((0.0, 0.0), (-30.0, 40.0))
    ]
    found, alone = AlternativePlaces(), after_gap(2.2, 2.2, faces=True)
    found.begin(WIDE, 9999)
    tracemalloc.start()
    found.review(at(2.2), at(2.2), seen_from(2.2, faces=True), [*LANDMARKS, *far])
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    np.testing.assert_array_equal(found._shifts, alone._shifts)
    assert alone.exist
    assert peak < 20e6


def test_the_frame_of_a_gps_and_a_wall_without_ends_are_no_objects():
    """A fix is a position of the robot in that frame, not of an object beside it."""
    slam = Landmarks()
    models = MODELS | {"gps": GpsFrame()}
    parts = {"association": Mahalanobis(), "lifecycle": Immediate()}
    slam.start(at(0.0), models=models, filter=RightInvariantEkf(), **parts)
    fix = Observation("gps", np.zeros(2), np.eye(2))
    wall = Observation("wall", np.array([1.0, 0.0]), R_WALL)
    corner = Observation("corner", np.array([1.0, 0.0]), R_POINT)
    assert [slam._has_place(one) for one in (fix, wall, corner)] == [False, False, True]
    assert [slam._has_place(one) for one in LANDMARKS] == [True] * len(LANDMARKS)


def drive(slam, places, sigma):
    """Drive along the corridor, each motion with this standard deviation; return the last revision."""
    for x in places:
        step = x - slam._filter.pose[0]
        motion = Increment(x, np.array([step, 0.0, 0.0]), np.diag([sigma, 0.01, 0.001]) ** 2, 1.0)
        none = np.zeros((3, 3))
        seen = seen_from(x)
        revision = slam.add(Keyframe(0, x, motion, none[0], none[0], none, None, 0, None, seen))
    return revision
