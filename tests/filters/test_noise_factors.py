"""Noise with heavy tails, and errors that repeat: what a correction makes of R."""

from dataclasses import replace

import numpy as np
import pytest
from tests.filters.worlds import MODELS, R_POINT, drive, observe

from impslam.association.known import Known
from impslam.component import components
from impslam.filters.ekf import Ekf
from impslam.filters.gaussian import GaussianFilter
from impslam.types import Observation

FAMILY = sorted(n for n, cls in components("filter").items() if issubclass(cls, GaussianFilter))


def worst(seed, spoil=None, **parameters):
    """Return how far the pose is off at worst in 40 noisy steps; `spoil` moves a cylinder at times."""
    rng, errors = np.random.default_rng(seed), []
    belief = components("filter")[parameters.pop("kind")](**parameters)
    belief.start(np.zeros(3), 1e-8 * np.eye(3), MODELS)
    for k, (pose, increment) in enumerate(drive(40, rng)):
        seen = observe(pose, rng)[:5]  # the cylinders
        if spoil is not None and k % 10 == 5:
            seen = (replace(seen[0], z=seen[0].z + spoil), *seen[1:])
        belief.predict(increment)
        choice = belief.associate(seen, Known())
        belief.correct(seen, choice.matches)
        belief.extend([seen[i] for i in choice.new], increment.stamp)
        errors.append(np.hypot(*(belief.pose - pose)[:2]))
    return float(max(errors))


@pytest.mark.parametrize("kind", FAMILY)
def test_outliers_fade_where_tails_are_heavy(kind):
    """Four detections 3 m off, of 200: with Gaussian noise they throw the robot off its way."""
    spoil, seeds = np.array([2.0, -2.2]), range(5)
    plain = np.mean([worst(s, spoil, kind=kind) for s in seeds])
    heavy = np.mean([worst(s, spoil, kind=kind, dof=4.0) for s in seeds])
    clean = np.mean([worst(s, kind=kind) for s in seeds])
    assert heavy < 1.5 * clean
    assert plain > 4.0 * clean


def corrected(z, **parameters):
    """Return the pose after one detection of a landmark that is known at [2, 0], and its P."""
    belief = Ekf(**parameters)
    belief.start(np.zeros(3), np.diag([0.1, 0.1, 1e-4]) ** 2, MODELS)
    belief.extend([Observation("cylinder", np.array([2.0, 0.0]), 1e-8 * np.eye(2), label=0)], 0.0)
    belief.predict(next(drive(1))[1])
    before = belief.pose
    seen = (Observation("cylinder", np.array(z), R_POINT, label=0),)
    choice = belief.associate(seen, Known())
    belief.correct(seen, choice.matches)
    return belief.pose - before, belief.covariance, choice.matches[0]


def test_a_fitting_detection_has_full_weight():
    once, heavy = corrected(match_z() + 0.01), corrected(match_z() + 0.01, dof=4.0)
    assert heavy[2].distance2 < 2.0
    np.testing.assert_array_equal(once[0], heavy[0])
    np.testing.assert_array_equal(once[1], heavy[1])


def test_an_outlier_has_the_weight_of_students_t():
    z = match_z() + 0.2
    moved, P, match = corrected(z, dof=4.0)
    assert match.distance2 > 20.0
    wider, P_wider = one_of(z, (4.0 + match.distance2) / (4.0 + 2.0) * R_POINT)
    np.testing.assert_allclose(moved, wider, rtol=1e-12)
    np.testing.assert_allclose(P, P_wider, rtol=1e-12)


def match_z():
    """What a detection without any innovation reads."""
    pose, increment = next(drive(1))
    c, s = np.cos(pose[2]), np.sin(pose[2])
    d = np.array([2.0, 0.0]) - increment.d_pose[:2]
    return np.array([c * d[0] + s * d[1], c * d[1] - s * d[0]])


def test_repetition_is_a_wider_r_of_corrections_alone():
    z = match_z() + 0.01
    several, P, match = corrected(z, repeats=9.0)
    wider, P_wider = one_of(z, 9.0 * R_POINT)
    np.testing.assert_allclose(several, wider, rtol=1e-12)
    np.testing.assert_allclose(P, P_wider, rtol=1e-12)
    np.testing.assert_array_equal(match.S, corrected(z)[2].S)


def one_of(z, R):
    belief = Ekf()
    belief.start(np.zeros(3), np.diag([0.1, 0.1, 1e-4]) ** 2, MODELS)
    belief.extend([Observation("cylinder", np.array([2.0, 0.0]), 1e-8 * np.eye(2), label=0)], 0.0)
    belief.predict(next(drive(1))[1])
    before = belief.pose
    seen = (Observation("cylinder", z, R, label=0),)
    belief.correct(seen, belief.associate(seen, Known()).matches)
    return belief.pose - before, belief.covariance
