"""Wheels that slip: the landmarks tell, and the map stays what it is."""

import math

import numpy as np
import pytest
from tests.association.scenes import R_POINT, point
from tests.estimators.test_landmarks import keyframe
from tests.filters.worlds import MODELS
from tests.sensing import at_rest

from impslam.association.base import Assignment
from impslam.association.jcbb import Jcbb
from impslam.association.mahalanobis import Mahalanobis
from impslam.component import components
from impslam.estimators.landmarks import Landmarks
from impslam.estimators.slip import MIN_KNOWN, SLIP_SHARE, TRACK, Attempt, explains, slipped
from impslam.filters.ekf import Ekf
from impslam.geometry.se2 import compose
from impslam.lifecycle.immediate import Immediate
from impslam.lifecycle.tentative import Tentative
from impslam.noise import MAX_GAP
from impslam.types import Increment, Match

POSTS = [(1.0, 1.5), (2.0, -1.0), (3.5, 1.2), (4.5, -1.4), (6.0, 0.8), (7.0, -0.5)]
Q = np.diag([1e-3, 1e-3, 1e-3]) ** 2
SLIPS = "keyframes with wheel slip"


def attempt(matched, new=(), ambiguous=(), tentative=0, S=R_POINT):
    matches = [Match(i, i, np.zeros(2), S, 0.0) for i in range(matched)]
    again = [Match(9, 9, np.zeros(2), S, 0.0)] * tentative
    return Attempt(Assignment(tuple(matches), tuple(new), ambiguous=tuple(ambiguous)), again)


def drive(slip, association=None, belief=None, more=(), posts=POSTS, lifecycle=None, seconds=0.2):
    """Drive 3 m past posts, the middle third of it with wheels that tell so much too much.

    From then on there are `more` posts. Returns the estimator and the true pose at the end.
    """
    slam, pose, rng = Landmarks(), np.zeros(3), np.random.default_rng(5)
    parts = {
        "association": association or Mahalanobis(),
        "lifecycle": lifecycle or Immediate(),
        "models": MODELS,
    }
    slam.start(pose, filter=belief or Ekf(), **parts)
    for step in range(25):
        moved = np.array([0.12, 0.0, 0.0]) if step else np.zeros(3)
        pose = compose(pose, moved)
        told = moved * (1.0 + slip * (8 <= step < 16)) + rng.multivariate_normal(np.zeros(3), Q)
        places = [*posts, *more] if step >= 8 else posts
        seen = [point(pose, place, rng=rng) for place in places]
        slam.add(keyframe(Increment(float(step), told, Q, seconds), seen))
    return slam, pose


@pytest.mark.parametrize("association", [Mahalanobis, Jcbb])
@pytest.mark.parametrize("slip", [0.2, 0.5, 1.0])
def test_wheel_slip_harms_neither_pose_nor_map(slip, association):
    slam, pose = drive(slip, association())
    assert len(slam.landmarks()) == len(POSTS)
    assert math.dist(slam._filter.pose[:2], pose[:2]) < 0.03
    assert slam.counts()[SLIPS] > 0


@pytest.mark.parametrize("kind", sorted(components("filter")))
def test_every_filter_can_repeat_a_prediction(kind):
    slam, pose = drive(0.5, belief=components("filter")[kind]())
    assert len(slam.landmarks()) == len(POSTS)
    assert math.dist(slam._filter.pose[:2], pose[:2]) < 0.03


def test_a_gap_in_the_data_is_no_slip():
    slam, _ = drive(0.5, seconds=MAX_GAP + 1.0)
    assert SLIPS not in slam.counts()


def test_new_things_are_no_slip():
    """Of a motion that is tried in vain nothing is left: the belief is as if it had not been."""
    more = [(3.0, 3.0), (5.0, -3.0), (6.5, 3.0)]
    slam, pose = drive(0.0, more=more)
    assert SLIPS not in slam.counts()
    assert len(slam.landmarks()) == len(POSTS) + len(more)
    assert math.dist(slam._filter.pose[:2], pose[:2]) < 0.01


@pytest.mark.parametrize("slip", [0.2, 0.5])
def test_one_landmark_that_was_seen_just_before_is_enough(slip):
    """Where walls tell the rest: along a corridor a door's edge is often all there is."""
    slam, pose = drive(slip, posts=POSTS[4:5])
    assert len(slam.landmarks()) == 1
    assert abs(slam._filter.pose[0] - pose[0]) < 0.1
    assert slam.counts()[SLIPS] > 0


def test_tentative_landmarks_reveal_a_slip():
    """New things are seen where the robot has moved to, not where its wheels say, and so agree."""
    known, new = POSTS[4:5], [(5.0, 2.0), (6.5, -1.5)]
    slam, pose = drive(0.3, posts=known, more=new, lifecycle=Tentative())
    assert len(slam.landmarks()) == len(known) + len(new)
    for mark, place in zip(slam.landmarks(), [*known, *new], strict=True):
        assert math.dist(mark.position, place) < 0.1
    assert math.dist(slam._filter.pose[:2], pose[:2]) < 0.1


def test_slip_must_explain_most_of_the_unexplained():
    rolled = attempt(3, new=(4, 5), ambiguous=(6,))
    assert rolled.unexplained(8) == 4  # 3 and 7, which are near a landmark, 4 and 5
    assert not explains(attempt(4), rolled, 8, {3})
    assert explains(attempt(3 + MIN_KNOWN), rolled, 8, set())
    assert not explains(attempt(3 + MIN_KNOWN), attempt(3), 9, set())


def test_one_recent_observation_suffices_for_slip():
    rolled = attempt(3, new=(3,))
    assert explains(attempt(4), rolled, 4, {3})
    assert not explains(attempt(4), rolled, 4, {0, 1, 2})
    assert explains(attempt(3, tentative=1), rolled, 4, set())
    assert not explains(attempt(4, tentative=0), attempt(3, tentative=1), 5, {3})


def test_a_match_supports_slip_only_at_low_density():
    """A gate of metres holds other trees, too: to match there is no evidence."""
    assert attempt(1).evidence(lambda *_: (np.zeros(2), R_POINT), ()) > 5.0
    wide = np.eye(2) * 2.0**2
    assert attempt(1, S=wide).evidence(lambda *_: (np.zeros(2), wide), ()) < 0.0
    assert attempt(0, tentative=1, S=wide).evidence(lambda *_: (), ()) < 0.0
    assert attempt(0).evidence(lambda *_: (), ()) == 0.0


@pytest.mark.parametrize("d_pose", [(0.2, 0.0, 0.0), (0.1, 0.0, 0.5), (0.0, 0.0, 0.3)])
def test_the_covariance_covers_a_wheel_that_slips(d_pose):
    """One wheel that turns by 3 sigma of `SLIP_SHARE` in vain, of a robot as wide as `TRACK`."""
    motion = Increment(0.0, np.array(d_pose), Q, 0.2)
    ways = d_pose[0] + np.array([-0.5, 0.5]) * TRACK * d_pose[2]
    ways[0] *= 1.0 - 3.0 * SLIP_SHARE
    true = np.array([ways.mean(), 0.0, np.diff(ways)[0] / TRACK])
    error = (motion.d_pose - true)[[0, 2]]
    S = slipped(motion).covariance[np.ix_([0, 2], [0, 2])]
    assert error @ np.linalg.solve(S, error) < 13.8


def test_a_stationary_robot_does_not_slip():
    motion = at_rest(0.0)
    assert not slipped(motion).covariance.any()
