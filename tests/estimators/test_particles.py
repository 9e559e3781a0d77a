"""FastSLAM: its posterior is Bayes's, particles share landmarks, and association is each one's own."""

import numpy as np
import pytest
from tests.filters.worlds import MODELS, R_POINT, drive, observe, step
from tests.numeric import wrapped

from impslam.association.mahalanobis import Mahalanobis
from impslam.component import build
from impslam.errors import ConfigError
from impslam.estimators.particle_kernels import systematic
from impslam.estimators.particle_landmarks import LandmarkTable
from impslam.estimators.particles import Particles
from impslam.filters.ekf import Ekf
from impslam.landmarks.point import Cylinder
from impslam.map import Keyframe, Map
from impslam.types import Increment, Observation


def parts(association="known"):
    kinds = {"filter": "ekf", "association": association, "lifecycle": "immediate"}
    return {role: build(role, {"kind": kind}) for role, kind in kinds.items()}


def started(association="known", **parameters):
    made = Particles(**parameters)
    made.start(np.zeros(3), models=MODELS, **parts(association))
    return made


def keyframe(motion, seen=()):
    none = np.zeros((3, 3))
    return Keyframe(
        0, motion.stamp, motion, none[0], none[0], none, None, 0, observations=tuple(seen)
    )


@pytest.mark.parametrize(("version", "off"), [(1, 0.4), (2, 0.1)])
def test_many_particles_have_the_posterior_of_the_ekf(version, off):
    """After few steps, before ancestors are few: the same mean and covariance, up to the draws."""
    rng = np.random.default_rng(3)
    steps = [(motion, observe(pose, rng)) for pose, motion in drive(3, rng)]
    made, ekf = started(particles=4000, version=version, resample_below=0.1), Ekf()
    ekf.start(np.zeros(3), 1e-8 * np.eye(3), MODELS)
    for motion, seen in steps:
        revision = made.add(keyframe(motion, seen))
        step(ekf, motion, seen)
    sigmas = np.sqrt(np.diag(ekf.covariance))
    assert (np.abs(wrapped(revision.poses[0] - ekf.pose, 2)) < off * sigmas).all()
    assert np.sqrt(np.diag(revision.covariances[0])) == pytest.approx(sigmas, rel=0.1)
    for one, other in zip(made.landmarks(), ekf.landmarks(), strict=True):
        apart = one.position - other.position
        if one.kind != "wall":
            assert apart @ np.linalg.solve(other.covariance, apart) < 2.0 * off**2
        assert np.trace(one.covariance) == pytest.approx(np.trace(other.covariance), rel=0.25)


def test_sampling_with_the_scan_keeps_more_particles():
    """Precise sensor, poor odometry: of FastSLAM 1's particles few are anywhere near."""
    kept = []
    for version in (1, 2):
        rng, made = np.random.default_rng(4), started(version=version, resample_below=1e-9)
        for pose, motion in drive(2, rng):
            made.add(keyframe(motion, observe(pose, rng)))
        weights = made._weights()
        kept.append(1.0 / (weights @ weights))
    assert kept[0] < 10.0
    assert kept[1] > 3.0 * kept[0]


def test_survivors_share_landmarks_until_one_corrects_its_own():
    table = LandmarkTable("cylinder", Cylinder(), 4)
    table.add(0, -1, 0.0, np.arange(4), np.arange(8.0).reshape(4, 2), np.tile(np.eye(2), (4, 1, 1)))
    table.resample(np.array([1, 1, 1, 3]))
    assert len(set(table.rows[:3, 0])) == 1
    assert sorted(table.users[table.users > 0]) == [1, 3]
    rows = table.unshare(np.array([0, 2, 3]), np.zeros(3, np.int64))
    assert len(set(rows)) == 3
    assert len(set(table.rows[:, 0])) == 4
    np.testing.assert_array_equal(table.m[table.rows[:3, 0]], [[2.0, 3.0]] * 3)
    table.m[rows] += 1.0
    np.testing.assert_array_equal(table.m[table.rows[1, 0]], [2.0, 3.0])


def test_the_pool_grows_with_what_differs_and_no_further():
    made, rng = started(particles=50), np.random.default_rng(5)
    for pose, motion in drive(60, rng):
        made.add(keyframe(motion, observe(pose, rng)))
    for table in made._tables.values():
        assert (table.users > 0).sum() <= table.rows.size
        assert len(table.m) <= 2 * table.rows.size + 256
        np.testing.assert_array_equal(
            table.users, np.bincount(table.rows[table.rows >= 0], minlength=len(table.users))
        )


def test_systematic_resampling_is_as_even_as_possible(rng):
    weights = rng.dirichlet(np.ones(50))
    for start in (0.0, 0.5, 0.999):
        counts = np.bincount(systematic(weights, start), minlength=50)
        assert (np.abs(counts - 50 * weights) < 1.0 + 1e-9).all()


def test_each_particle_matches_by_its_own_pose():
    """Two posts 0.6 m apart, a turn that is unsure by 0.2 rad: some take the one for the other."""
    made = started("mahalanobis", particles=200, version=1)
    posts = np.array([[3.0, -0.3], [3.0, 0.3]])
    still = Increment(0.0, np.zeros(3), np.zeros((3, 3)), 1.0)
    R = 0.02**2 * np.eye(2)
    made.add(keyframe(still, [Observation("cylinder", z, R) for z in posts]))
    turn = Increment(1.0, np.zeros(3), np.diag([1e-4, 1e-4, 0.2]) ** 2, 1.0)
    revision = made.add(keyframe(turn, [Observation("cylinder", posts[0], R)]))
    headings, weights = made._poses[:, 2], made._weights()
    wrong = np.abs(headings - 0.2) < 0.05  # as if the second post were seen
    assert (np.abs(headings) < 0.05).any()
    assert wrong.any()
    assert 0.1 < weights[wrong].sum() / weights[np.abs(headings) < 0.05].sum() < 2.0
    assert len(revision.matches) <= 1


def test_a_scan_without_a_match_changes_no_weight():
    made, rng = started(), np.random.default_rng(6)
    for pose, motion in drive(3, rng):
        made.add(keyframe(motion, observe(pose, rng)))
    before = made._log_weights.copy()
    made.add(keyframe(motion, [Observation("cylinder", np.array([50.0, 0.0]), R_POINT, label=77)]))
    np.testing.assert_allclose(made._weights(), _normalised(before), rtol=1e-12)


def _normalised(log_weights):
    weights = np.exp(log_weights - log_weights.max())
    return weights / weights.sum()


class Joint(Mahalanobis):
    """Judges a scan as a whole, and not otherwise."""

    is_joint = True


def test_what_it_cannot_do_is_refused():
    with pytest.raises(ConfigError, match="estimator 'particles' cannot use"):
        Particles().start(np.zeros(3), models=MODELS, **{**parts(), "association": Joint()})
    with pytest.raises(ConfigError, match="cannot continue a map"):
        Particles().resume(Map.__new__(Map))
