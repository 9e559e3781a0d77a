"""A step of the estimator: whole or not at all, and what stands around the filter in it."""

import dataclasses

import numpy as np
import pytest
from tests.filters.worlds import MODELS, drive, observe
from tests.registry import own_registry

from impslam.association.known import Known
from impslam.columns import batches
from impslam.component import components, parameter, register
from impslam.errors import NumericalError
from impslam.estimators.landmarks import Landmarks
from impslam.filters.ekf import Ekf
from impslam.lifecycle.immediate import Immediate
from impslam.lifecycle.tentative import Tentative
from impslam.map import Keyframe
from impslam.sensors.lidar2d import Lidar2D
from impslam.types import Increment, LaserScan, Observation

FAMILY = sorted(name for name, cls in components("filter").items() if issubclass(cls, Ekf))


def estimator(belief, lifecycle=None):
    made = Landmarks()
    made.start(
        np.zeros(3),
        filter=belief,
        association=Known(),
        lifecycle=lifecycle or Immediate(),
        models=MODELS,
    )
    return made


def keyframe(motion, seen=(), scan=None):
    """Return a keyframe; its stamp is the motion's."""
    none = np.zeros((3, 3))
    return Keyframe(0, motion.stamp, motion, none[0], none[0], none, None, 0, scan, tuple(seen))


@pytest.fixture(params=sorted(components("filter")))
def belief(request):
    return components("filter")[request.param]()


def mapped(belief, steps=12):
    """Return an estimator that has seen the world for some steps, and what comes next."""
    slam, rng = estimator(belief), np.random.default_rng(7)
    for pose, increment in drive(steps, rng):
        slam.add(keyframe(increment, observe(pose, rng)))
    return slam, increment, observe(pose, rng)


def test_candidates_are_kept_by_a_filter_with_the_same_parameters():
    with own_registry():

        @register("demanding")
        class Demanding(Ekf):
            strength: float = parameter(..., "1", "without a default")

        lifecycle = Tentative()
        slam = estimator(Demanding(strength=3.0, iterations=2), lifecycle)
    assert lifecycle._candidates is not slam._filter
    assert isinstance(lifecycle._candidates, Demanding)
    assert dict(lifecycle._candidates) == dict(slam._filter)


def test_a_fresh_filter_has_no_state_of_the_old_one(belief):
    slam, *_ = mapped(belief)
    fresh = slam._filter.fresh()
    fresh.start(np.zeros(3), np.eye(3), MODELS)
    assert dict(fresh) == dict(belief)
    assert fresh.landmarks() == ()
    assert len(slam.landmarks()) == 9


def open_room(belief):
    """Return an estimator with a cylinder 2 m ahead, and a scan of a wall behind that place."""
    slam = estimator(belief, Tentative(max_score=5.0))
    angles = np.linspace(-1, 1, 401)
    message = LaserScan(0.0, angles, 3.0 / np.cos(angles), np.zeros(401))
    (cut,) = batches([("lidar", message)])
    scan = Lidar2D().sweeps(cut["lidar"], np.zeros((1, 3))).row(0)
    post = Observation("cylinder", np.array([2.0, 0.0]), 1e-4 * np.eye(2), label=1)
    slam.add(keyframe(still(0), (post,)))
    return slam, scan


def still(k):
    return Increment(0.01 * k, np.zeros(3), 1e-10 * np.eye(3), 0.01)


def test_landmarks_seen_through_are_removed_even_without_matches(belief):
    slam, scan = open_room(belief)
    gone = [slam.add(keyframe(still(k), (), scan)).removed for k in range(1, 30)]
    assert [r for r in gone if r] == [(0,)]
    assert slam.landmarks() == ()


def test_a_revision_names_the_first_observations_of_new_landmarks(belief):
    slam = estimator(belief)
    ((pose, increment),) = drive(1)
    seen = observe(pose)
    slam.add(keyframe(increment, seen[2:4]))
    result = slam.add(keyframe(still(9), seen))
    assert [seen[i].label for i in result.origins] == [0, 1, 4, 100, 101, 102, 103]
    assert len(result.added) == len(result.origins)


@pytest.mark.parametrize("value", [-1.0, np.nan])
def test_a_keyframe_without_a_solution_moves_the_robot_and_nothing_else(belief, value):
    """One observation's R is no covariance: the run is that in which nothing was seen."""
    slam, increment, seen = mapped(belief)
    twin, *_ = mapped(components("filter")[belief.name]())
    matches = slam._filter.associate(seen, Known()).matches
    bad = [dataclasses.replace(seen[0], R=value * np.eye(2)), *seen[1:]]
    with pytest.raises(NumericalError, match="not positive definite"):
        slam._filter.correct(bad, matches)
    refused = slam.add(keyframe(increment, bad)).refused
    assert "is not used for the map" in refused
    assert slam.observations()[-1] == ()
    twin.add(keyframe(increment))
    for one in (slam, twin):
        one.add(keyframe(increment, seen))
    assert np.array_equal(slam._filter.belief.covariance, twin._filter.belief.covariance)
    assert np.array_equal(slam._filter.belief.mean, twin._filter.belief.mean)


@pytest.mark.parametrize("R", [np.zeros((2, 2)), np.array([[1.0, 2.0], [2.0, 1.0]])])
def test_a_new_landmark_whose_R_is_not_definite_is_refused(belief, R):
    slam = estimator(belief)
    told = slam.add(keyframe(still(0), (Observation("corner", np.array([2.0, 0.3]), R, label=1),)))
    assert "the covariance R of a corner is not positive definite" in told.refused
    assert slam.landmarks() == ()


@pytest.mark.parametrize("kind", FAMILY)
@pytest.mark.parametrize("iterations", [2, 4])
def test_a_failure_after_the_first_linearisation_changes_nothing(kind, iterations, monkeypatch):
    """The state is moved by then; it has to be put back."""
    belief = components("filter")[kind](iterations=iterations, tolerance=1e-9)
    slam, increment, seen = mapped(belief)
    slam._filter.predict(increment)
    matches = slam._filter.associate(seen, Known()).matches
    P, mean = slam._filter.belief.covariance, slam._filter.belief.mean.copy()
    calls, linearise = [], type(belief)._linearise

    def failing(self, *arguments):
        calls.append(len(calls))
        if len(calls) == 2:
            raise NumericalError("so it is told")
        return linearise(self, *arguments)

    monkeypatch.setattr(type(belief), "_linearise", failing)
    with pytest.raises(NumericalError, match="so it is told"):
        slam._filter.correct(seen, matches)
    assert np.array_equal(slam._filter.belief.covariance, P)
    assert np.array_equal(slam._filter.belief.mean, mean)
