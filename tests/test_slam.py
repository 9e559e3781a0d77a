"""A step of the estimator: whole or not at all, and what stands around the filter in it."""

import dataclasses

import numpy as np
import pytest
from tests.filters.worlds import MODELS, drive, observe
from tests.registry import own_registry

from impslam.association.known import Known
from impslam.component import components, parameter, register
from impslam.errors import NumericalError
from impslam.filters.ekf import Ekf
from impslam.lifecycle.immediate import Immediate
from impslam.lifecycle.tentative import Tentative
from impslam.sensors.base import Reading
from impslam.sensors.lidar2d import Lidar2D
from impslam.slam import Slam
from impslam.types import Increment, LaserScan, Observation


def estimator(belief, lifecycle=None):
    return Slam(belief, Known(), lifecycle or Immediate(), MODELS)


@pytest.fixture(params=sorted(components("filter")))
def belief(request):
    return components("filter")[request.param]()


def mapped(belief, steps=12):
    """Return an estimator that has seen the world for some steps, and what comes next."""
    slam, rng = estimator(belief), np.random.default_rng(7)
    for pose, increment in drive(steps, rng):
        slam.step(increment, Reading(None, observe(pose, rng)))
    return slam, increment, observe(pose, rng)


def test_candidates_are_kept_by_a_filter_with_the_same_parameters():
    with own_registry():

        @register("demanding")
        class Demanding(Ekf):
            strength: float = parameter(..., "1", "without a default")

        lifecycle = Tentative()
        slam = estimator(Demanding(strength=3.0, iterations=2), lifecycle)
    assert lifecycle._candidates is not slam.filter
    assert isinstance(lifecycle._candidates, Demanding)
    assert dict(lifecycle._candidates) == dict(slam.filter)


def test_a_fresh_filter_knows_nothing_of_the_old_one(belief):
    slam, *_ = mapped(belief)
    fresh = slam.filter.fresh()
    fresh.start(np.zeros(3), np.eye(3), MODELS)
    assert dict(fresh) == dict(belief)
    assert fresh.landmarks() == ()
    assert len(slam.landmarks()) == 9


def open_room(belief):
    """Return an estimator with a cylinder 2 m ahead, and a scan of a wall behind that place."""
    slam = estimator(belief, Tentative(confidence=5.0))
    angles = np.linspace(-1, 1, 401)
    message = LaserScan(0.0, angles, 3.0 / np.cos(angles), np.zeros(401))
    scan = Lidar2D().scan(message, np.zeros(3))
    post = Observation("cylinder", np.array([2.0, 0.0]), 1e-4 * np.eye(2), label=1)
    slam.step(still(0), Reading(None, (post,)))
    return slam, scan


def still(k):
    return Increment(0.01 * k, np.zeros(3), 1e-10 * np.eye(3), 0.01)


def test_what_is_seen_through_goes_even_if_nothing_else_is_seen(belief):
    slam, scan = open_room(belief)
    gone = [slam.step(still(k), Reading(scan, ())).removed for k in range(1, 30)]
    assert [r for r in gone if r] == [(0,)]
    assert slam.landmarks() == ()


def test_a_scan_that_nobody_searched_is_no_evidence(belief):
    slam, scan = open_room(belief)
    for k in range(1, 30):
        assert slam.step(still(k), Reading(scan, (), searched=False)).removed == ()
    assert len(slam.landmarks()) == 1


def test_a_step_says_which_observations_its_new_landmarks_began_with(belief):
    slam = estimator(belief)
    ((pose, increment),) = drive(1)
    seen = observe(pose)
    slam.step(increment, Reading(None, seen[2:4]))
    result = slam.step(still(9), Reading(None, seen))
    assert [seen[i].label for i in result.born] == [0, 1, 4, 100, 101, 102, 103]
    assert len(result.new) == len(result.born)


@pytest.mark.parametrize("value", [-1.0, np.nan])
def test_a_scan_without_a_solution_changes_nothing(belief, value):
    """One observation's R is no covariance; afterwards the run is the one without that scan."""
    slam, increment, seen = mapped(belief)
    twin, *_ = mapped(components("filter")[belief.name]())
    P, mean = slam.filter.belief.covariance, slam.filter.belief.mean.copy()
    matches = slam.filter.associate(seen, Known()).matches
    bad = [dataclasses.replace(seen[0], R=value * np.eye(2)), *seen[1:]]
    with pytest.raises(NumericalError, match="not positive definite"):
        slam.filter.correct(bad, matches)
    with pytest.raises(NumericalError):
        slam.step(increment, Reading(None, tuple(bad)))
    assert np.array_equal(slam.filter.belief.covariance, P)
    assert np.array_equal(slam.filter.belief.mean, mean)
    for one in (slam, twin):
        one.step(increment, Reading(None, seen))
    assert np.array_equal(slam.filter.belief.covariance, twin.filter.belief.covariance)
    assert np.array_equal(slam.filter.belief.mean, twin.filter.belief.mean)
    assert slam._odometry.tolist() == twin._odometry.tolist()


@pytest.mark.parametrize("iterations", [2, 4])
def test_a_failure_after_the_first_linearisation_changes_nothing(belief, iterations, monkeypatch):
    """The state is moved by then; it has to be put back."""
    belief = type(belief)(iterations=iterations, tolerance=1e-9)
    slam, increment, seen = mapped(belief)
    slam.filter.predict(increment)
    matches = slam.filter.associate(seen, Known()).matches
    P, mean = slam.filter.belief.covariance, slam.filter.belief.mean.copy()
    calls, linearise = [], type(belief)._linearise

    def failing(self, *arguments):
        calls.append(len(calls))
        if len(calls) == 2:
            raise NumericalError("so it is told")
        return linearise(self, *arguments)

    monkeypatch.setattr(type(belief), "_linearise", failing)
    with pytest.raises(NumericalError, match="so it is told"):
        slam.filter.correct(seen, matches)
    assert np.array_equal(slam.filter.belief.covariance, P)
    assert np.array_equal(slam.filter.belief.mean, mean)
