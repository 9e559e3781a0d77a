"""After a gap in the data, a keyframe is placed only if no other place within reach looks the same."""

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.estimators.drives import LAP, RING, begun, driven, keyframes, scanned, way
from tests.estimators.test_sessions import compared, loaded, mapped
from tests.extractors.scans import room
from tests.recognition.plans import walls

from impslam.estimators.loop_closing import LoopCloser, LoopSearch
from impslam.estimators.sessions import MIN_CLOSURES, SessionPlacer

ROOMS, WIDTH = 15, 4.0  # m from one room of the hotel to the next
HOTEL = np.concatenate([
    room(0.0, ROOMS * WIDTH, -4.0, 4.0),
    *(
        walls([x, y, x + 1.5, y], [x + 2.5, y, x + WIDTH, y], [x, y, x, 4.0 * y])
        for x in WIDTH * np.arange(ROOMS)
        for y in (-1.0, 1.0)
    ),
])  # fmt: skip
"""A corridor between rooms that are all the same."""
SEEN = {"range_max": 7.0, "noise": 0.01}
THERE, BACK = way((2.0, 0.0), (30.0, 0.0)), way((30.0, 0.0), (16.0, 0.0))
REACH = 6.0, 0.3


def in_hotel(truth):
    """Return the keyframes of a drive through the hotel."""
    rng = np.random.default_rng(3)
    frames = keyframes(HOTEL, truth)
    return [
        replace(frame, scan=scanned(HOTEL, pose, rng=rng, **SEEN))
        for frame, pose in zip(frames, truth, strict=True)
    ]


@pytest.fixture(scope="module")
def hotel():
    return in_hotel(np.vstack((THERE, BACK[1:])))


def placed_after(frames, gap, reach):
    """Return whether each keyframe from number `gap` on is placed, if the robot has that reach there."""
    after = replace(frames[gap], reach=reach)
    revisions = driven(begun((2.0, 0.0, 0.0)), [*frames[:gap], after, *frames[gap + 1 :]])
    assert all(np.all(r.placed) for r in revisions[:gap])
    return [bool(np.all(r.placed)) for r in revisions[gap:]]


@pytest.mark.parametrize(
    ("reach", "placed"),
    [(REACH, False), ((3.0, 0.3), True), ((0.0, 0.0), True)],
    ids=["two rooms", "one room", "no gap"],
)
def test_a_room_like_the_next_one_is_not_taken_for_the_place(hotel, reach, placed):
    assert placed_after(hotel[:51], 50, reach) == [placed]


def test_among_equal_rooms_the_robot_stays_unplaced(hotel):
    """The scans fit where matching has placed it, and two closures would be enough there."""
    assert not any(placed_after(hotel, len(THERE), REACH))


def test_such_a_gap_begins_a_session_in_the_map_too(hotel, tmp_path):
    gap = len(THERE)
    frames = [*hotel[:gap], replace(hotel[gap], reach=REACH), *hotel[gap + 1 :]]
    made = begun((2.0, 0.0, 0.0))
    known = mapped(made, frames)
    assert known.keyframes.sessions.tolist() == [0] * gap + [1] * (len(frames) - gap)
    again = loaded(known, tmp_path / "map.imp")
    np.testing.assert_array_equal(again._graph.roots, made._graph.roots)


def test_in_a_place_that_is_unique_the_robot_stays_placed():
    frames = keyframes(RING, way(*LAP[:3]))
    assert placed_after(frames, len(frames) - 5, REACH) == [True] * 5


def test_where_the_map_is_out_of_sight_no_other_place_fits():
    """The scans return 60 m from the map, farther than the robot's reach and its view."""
    truth = way((2.0, 0.0), (8.0, 0.0))
    far = np.vstack((truth, truth[-1] + [60.0, 0.0, 0.0]))
    frames = keyframes(RING, far)
    assert placed_after(frames, len(truth), (3.0, 0.05)) == [True]


def test_new_ground_speaks_for_no_place():
    """Half of the scan shows what the map does not contain; the rest fits only where the robot is."""
    truth = way((3.0, 1.25), (9.0, 1.25))
    frames = keyframes(RING, np.vstack((truth, [[12.0, 1.25, 0.0]])))
    assert placed_after(frames, len(truth), REACH) == [True]


@pytest.mark.parametrize(
    ("sigma", "required"), [(0.2, math.inf), (1.0, MIN_CLOSURES)], ids=["precise", "vague"]
)
def test_odometry_that_leaves_doubt_does_not_exclude_another_place(sigma, required):
    """The map agrees with its place, but that may be a similar one."""
    placer = SessionPlacer(LoopCloser(LoopSearch()))
    placer.begin(9, (np.zeros(3), np.diag([sigma, sigma, 0.1]) ** 2))
    placer._compared = [compared(0.0, True)]
    assert placer._required() == required
