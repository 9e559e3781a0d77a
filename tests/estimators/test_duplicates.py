"""Landmarks that were begun twice become one; two that are near each other stay two."""

import numpy as np
import pytest
from tests.association.scenes import R_POINT, point, wall
from tests.filters.worlds import MODELS

from impslam.association.mahalanobis import Mahalanobis
from impslam.component import components
from impslam.estimators.landmarks import Landmarks
from impslam.filters.ekf import Ekf
from impslam.filters.symmetry import pose_D_motion
from impslam.geometry.se2 import compose
from impslam.lifecycle.immediate import Immediate
from impslam.map import Keyframe
from impslam.types import Increment, Match

ORIGIN = np.zeros(3)
POST, OTHER = (2.0, 1.0), (1.0, -2.0)
FAMILY = sorted(name for name, cls in components("filter").items() if issubclass(cls, Ekf))


def match(observation, landmark):
    return Match(observation, landmark, np.zeros(2), R_POINT, 0.0)


def drive(kind, seed, numbers):
    """Drive with a heading that is known, so that all is linear; the post's landmark by step is given."""
    belief, rng, pose = components("filter")[kind](), np.random.default_rng(seed), ORIGIN
    belief.start(ORIGIN, np.diag([1e-2, 1e-2, 0.0]), MODELS)
    for step, number in enumerate(numbers):
        moved, Q = np.array([0.3, 0.1, 0.4]), np.diag([4e-4, 1e-4, 0.0])
        pose = compose(pose, moved)
        belief.predict(Increment(float(step), moved + rng.multivariate_normal(ORIGIN, Q), Q, 1.0))
        seen = (point(pose, POST, 7, rng=rng), point(pose, OTHER, 8, rng=rng))
        if step == 0:
            belief.extend(seen, 0.0)
            continue
        known = {m.id for m in belief.landmarks()}
        matches = [match(1, 1), *([match(0, number)] if number in known else [])]
        belief.correct(seen, matches)
        belief.note(seen, matches, float(step))
        belief.extend([seen[0]] if number not in known else [], float(step))
    return belief


@pytest.mark.parametrize("kind", FAMILY)
def test_fusion_equals_correct_matching(kind):
    """The same posterior, whichever of both each observation was taken for, to rounding.

    But `oc`, whose Jacobians depend on both first estimates.
    """
    right, twice = drive(kind, 3, [0] * 9), drive(kind, 3, [0, 0, 2, 2, 0, 2, 0, 2, 2])
    assert len(twice.landmarks()) == 3
    twice.fuse(0, 2)
    within = 1e-3 if kind == "oc" else 1e-9
    np.testing.assert_allclose(twice.belief.mean[:7], right.belief.mean[:7], atol=within)
    np.testing.assert_allclose(twice.belief.covariance, right.belief.covariance, atol=within)
    for one, other in zip(twice.landmarks(), right.landmarks(), strict=True):
        assert (one.id, one.observations) == (other.id, other.observations)
        assert (one.first_stamp, one.last_stamp) == (other.first_stamp, other.last_stamp)


@pytest.mark.parametrize("kind", FAMILY)
def test_fusing_gains_no_information_on_a_rigid_motion(kind):
    belief = components("filter")[kind]()
    belief.start(np.array([1.0, 2.0, 0.5]), 0.01 * np.eye(3), MODELS)
    belief.extend([point(ORIGIN, (2, 1)), point(ORIGIN, (2.05, 1.1))], 0.0)
    _, entries, J = belief._difference(0, 1)
    states = belief.belief.mean[entries[3:]].reshape(2, 2)
    of_map = MODELS["cylinder"].m_D_motion(states).reshape(4, 3)
    N = np.vstack([pose_D_motion(belief.pose), of_map])
    np.testing.assert_allclose(J @ N, 0.0, atol=1e-12)


def test_a_fused_wall_has_the_extent_of_both():
    belief = Ekf()
    belief.start(ORIGIN, 1e-6 * np.eye(3), MODELS)
    belief.extend([wall(ORIGIN, [[2, -2], [2, 0]]), wall(ORIGIN, [[2, -1], [2, 2]])], 0.0)
    belief.fuse(0, 1)
    (whole,) = belief.landmarks()
    np.testing.assert_allclose(np.sort(whole.end_points[:, 1]), [-2, 2], atol=1e-6)
    assert whole.observations == 2


# --------------------------------------------------------------------------- the estimator


def started():
    slam, belief = Landmarks(), components("filter")["riekf"]()
    parts = {"association": Mahalanobis(), "lifecycle": Immediate(), "models": MODELS}
    slam.start(ORIGIN, filter=belief, **parts)
    return slam


def add(slam, k, places, rng, sigma=(0.01, 0.01, 0.005)):
    """Let a robot that stands see some places."""
    seen = tuple(point(ORIGIN, place, rng=rng) for place in places)
    motion = Increment(float(k), ORIGIN, np.diag(np.square(sigma)), 1.0)
    none = np.zeros((3, 3))
    return slam.add(
        Keyframe(k, float(k), motion, none[0], none[0], none, None, 0, observations=seen)
    )


def test_a_duplicate_is_fused_after_enough_scans_of_one_object(rng):
    slam = started()
    add(slam, 0, (POST, OTHER), rng)
    slam._filter.extend([point(ORIGIN, POST, rng=rng)], 0.0)
    told = [add(slam, k, (POST, OTHER), rng) for k in range(1, 7)]
    assert [r.removed for r in told] == [(), (), (), (2,), (), ()]
    assert [m.id for m in slam.landmarks()] == [0, 1]
    assert {m.landmark for m in told[-1].matches} == {0, 1}
    assert slam.counts() == {"landmarks fused": 1}


def test_an_unknown_difference_keeps_both(rng, monkeypatch):
    slam = started()
    add(slam, 0, (POST, OTHER), rng)
    slam._filter.extend([point(ORIGIN, POST, rng=rng)], 0.0)
    monkeypatch.setattr(Ekf, "difference", lambda *_: (np.zeros(2), np.zeros((2, 2))))
    told = [add(slam, k, (POST, OTHER), rng) for k in range(1, 7)]
    assert all(r.removed == () and not r.refused for r in told)
    assert len(slam.landmarks()) == 3


@pytest.mark.parametrize("hidden", [False, True])
def test_distinct_neighbours_are_not_fused(hidden):
    """A few standard deviations of one sight apart; where one hides the other at times, too."""
    for seed in range(10):
        slam, rng = started(), np.random.default_rng(seed)
        places = [POST, (POST[0], POST[1] + 0.06), OTHER]
        add(slam, 0, places, rng)
        for k in range(1, 30):
            some = places if not hidden or k % 3 == 0 else [places[k % 2], OTHER]
            assert add(slam, k, some, rng).removed == ()
        assert {0, 1, 2} <= {m.id for m in slam.landmarks()}
