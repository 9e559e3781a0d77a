"""Landmarks that are not where the estimate predicts them, suddenly or by a persistent offset."""

from types import SimpleNamespace

import numpy as np
import pytest

from impslam.health import CARRIED, DISPLACED, INCONSISTENT, NONE
from impslam.observers.landmark_watch import MAX_RATIO, LandmarkWatch

STILL = SimpleNamespace(d_pose=np.zeros(3), covariance=np.zeros((3, 3)))
ALONG = np.array([[0.0, 1.0], [4.0, 1.0]])
ACROSS = np.array([[4.0, -1.0], [4.2, 1.0]])


def keyframes(
    watch,
    matched,
    seen=5,
    added=(),
    ratio=1.0,
    count=1,
    lost=False,
    *,
    walls=(),
    ambiguous=(),
    reason=NONE,
):
    """Return the reasons that keyframes give in which these landmarks are matched.

    Of them the first are `walls`, by their end points, and the others points.
    """
    out = []
    for _ in range(count):
        matches = [
            SimpleNamespace(
                landmark=k, distance2=2.0 * ratio, innovation=np.zeros(2), observation=i
            )
            for i, k in enumerate(matched)
        ]
        ends = [*walls, *[None] * (seen - len(walls))]
        observations = [SimpleNamespace(end_points=one) for one in ends]
        keyframe = SimpleNamespace(
            observations=observations, lost=lost, reason=reason, motion=STILL
        )
        revision = SimpleNamespace(
            matches=matches, added=added, ambiguous=ambiguous, ids=[0], poses=np.zeros((1, 3)),
            covariances=np.zeros((1, 3, 3)),
        )  # fmt: skip
        out.append(watch.revise(keyframe, revision)[0])
    return out


@pytest.fixture
def watch():
    known = LandmarkWatch()
    keyframes(known, (), added=range(5))
    assert keyframes(known, range(5), count=40) == [NONE] * 40
    return known


def test_a_robot_is_displaced_when_landmarks_vanish_until_they_are_seen_again(watch):
    assert keyframes(watch, (), count=2) == [NONE, DISPLACED]
    keyframes(watch, (), added=range(5, 10))
    assert keyframes(watch, range(5, 10), count=50) == [DISPLACED] * 50  # the same things once more
    assert keyframes(watch, [0, 1, 5, 6, 7], count=50) == [DISPLACED] * 50
    assert keyframes(watch, range(5), count=4) == [DISPLACED, DISPLACED, NONE, NONE]


def test_fewer_observations_are_no_displacement(watch):
    assert keyframes(watch, [0, 1], seen=2, count=20) == [NONE] * 20


def test_ambiguous_matches_with_earlier_landmarks_are_no_displacement(watch):
    """They pass their gates; it is another matter which of two walls they show."""
    assert keyframes(watch, [0, 1], ambiguous=[2, 3], count=20) == [NONE] * 20


def test_new_ground_is_no_displacement(watch):
    for k in range(10):
        assert keyframes(watch, range(k, 5 + k), seen=8, count=5) == [NONE] * 5
        keyframes(watch, range(k, 5 + k), seen=8, added=[5 + k])


def test_a_lost_tracker_is_displaced(watch):
    assert keyframes(watch, (), lost=True) == [DISPLACED]
    assert keyframes(watch, range(5), count=3)[-1] == NONE


def test_a_carried_robot_is_displaced_until_it_sees_nothing_but_earlier_landmarks(watch):
    """Elsewhere, some landmarks fit by chance; those that do not fit are initialised."""
    assert keyframes(watch, range(3), reason=CARRIED) == [DISPLACED]
    keyframes(watch, range(4), added=[5])
    assert keyframes(watch, [0, 1, 2, 3, 5], count=50) == [DISPLACED] * 50
    assert keyframes(watch, range(5), count=3) == [DISPLACED, DISPLACED, NONE]


def test_a_robot_that_sees_the_usual_landmarks_was_not_carried(watch):
    """A lidar looks through the windows of a car only from some places."""
    assert keyframes(watch, range(4), reason=CARRIED) == [NONE]
    assert keyframes(watch, range(5), walls=[ALONG] * 5, reason=CARRIED) == [DISPLACED]


def test_a_map_that_has_just_begun_does_not_show_that_the_robot_was_carried():
    new = LandmarkWatch()
    keyframes(new, (), added=range(5))
    assert keyframes(new, (), reason=CARRIED) == [NONE]


def test_landmarks_seen_just_before_a_jump_is_found_may_belong_to_the_new_place(watch):
    keyframes(watch, range(5), added=range(5, 10), count=3)
    assert keyframes(watch, range(5, 10), reason=CARRIED) == [DISPLACED]
    assert keyframes(watch, range(5, 10), count=50) == [DISPLACED] * 50
    assert keyframes(watch, range(5), count=3)[-1] == NONE


def test_only_large_innovations_are_inconsistent(watch):
    assert keyframes(watch, range(5), ratio=0.2, count=40) == [NONE] * 40
    assert keyframes(watch, range(5), ratio=1.1 * MAX_RATIO, count=100)[-1] == INCONSISTENT
    assert keyframes(watch, range(5, 9), added=range(5, 9), count=100)[-1] == DISPLACED
    assert keyframes(watch, range(5), ratio=1.0, count=100)[-1] == NONE


def test_one_keyframe_of_large_innovations_is_no_displacement(watch):
    """One in a hundred has them by chance, and earlier landmarks may not be seen again."""
    newer = range(5, 10)
    assert keyframes(watch, newer, added=newer, ratio=8.0) == [INCONSISTENT]
    assert keyframes(watch, newer, ratio=0.3, count=10)[-1] == NONE


def test_slip_along_matched_walls_is_detected(watch):
    assert keyframes(watch, [0, 1], count=3) == [NONE, NONE, DISPLACED]


def test_walls_along_a_corridor_do_not_locate_the_robot_along_it(watch):
    keyframes(watch, (), count=2)
    assert keyframes(watch, range(5), walls=[ALONG] * 5, count=50) == [DISPLACED] * 50
    told = keyframes(watch, range(5), walls=[*[ALONG] * 4, ACROSS], count=4)
    assert told == [DISPLACED, DISPLACED, NONE, NONE]
