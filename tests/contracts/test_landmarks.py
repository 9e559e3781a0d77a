"""What every landmark model keeps: its inverse, its batches, and Jacobians that are its slopes."""

import math
from itertools import product

import numpy as np
import pytest
from tests.numeric import jacobian

from impslam.component import build, components
from impslam.geometry.se2 import compose, exp
from impslam.landmarks.base import LandmarkModel
from impslam.types import Observation

MODELS = {name: cls() for name, cls in components("landmark").items()}
MODELS["gps with its antenna ahead"] = build("landmark", {"kind": "gps", "antenna": [1.3, -0.4]})
HEADINGS = [0.0, 0.4, math.pi / 2, 3.0, math.pi - 1e-9, -math.pi + 1e-9, -1.2, 5.9]


@pytest.fixture(params=sorted(MODELS))
def model(request):
    return MODELS[request.param]


def measurements(model, rng, *lead):
    """Return z (*lead, dim_z) all round the robot, angles where the model says so."""
    z = rng.uniform(0.5, 5.0, (*lead, model.dim_z)) * rng.choice([-1.0, 1.0], (*lead, model.dim_z))
    for i in model.z_angles:
        z[..., i] = rng.uniform(-math.pi, math.pi, lead)
    return z


def landmarks(model, rng, pose, count=4):
    """Return m (count, dim) round a pose, moved from where a first observation puts them."""
    m = model.invert(pose, measurements(model, rng, count))
    return model.retract(m, rng.normal(0.0, 0.3, m.shape))


def seen_as(model, z):
    ends = np.array([[1.0, -2.0], [1.5, 3.0]])
    return Observation(model.name, z, 1e-4 * np.eye(model.dim_z), np.arange(20), ends)


@pytest.mark.parametrize("theta", HEADINGS)
def test_invert_is_the_inverse_of_observe(model, theta, rng):
    pose, z = np.array([3.0, -7.0, theta]), measurements(model, rng, 5)
    m = model.invert(pose, z)
    assert m.shape == (5, model.dim)
    again = model.observe(pose, m)
    assert again.shape == z.shape
    np.testing.assert_allclose(model.residual(z, again), 0.0, atol=1e-12)
    np.testing.assert_allclose(model.residual(z[0], again), model.residual(z[0], z), atol=1e-12)
    for one in z:
        start = model.initialise(pose, seen_as(model, one)).m
        seen = model.observe(pose, start[None])[0]
        np.testing.assert_allclose(model.residual(one, seen), 0.0, atol=1e-12)


def test_no_landmarks_are_predicted_as_none(model):
    """From one pose, or from those of many particles."""
    rng, pose = np.random.default_rng(0), np.array([1.0, 2.0, 0.5])
    none = landmarks(model, rng, pose)[:0]
    for lead in ((), (7,)):
        poses, m = (np.broadcast_to(a, (*lead, *a.shape)) for a in (pose, none))
        seen = model.predict(poses, m)
        assert seen.z.shape == (*lead, 0, model.dim_z)
        assert seen.z_D_pose.shape == (*lead, 0, model.dim_z, 3)
        assert seen.z_D_m.shape == (*lead, 0, model.dim_z, none.shape[1])


@pytest.mark.parametrize(("of_pose", "of_m"), list(product([(), (3,), (2, 3)], repeat=2)))
def test_a_batch_is_its_parts_one_by_one(model, of_pose, of_m, rng):
    """Poses (..., 3) and landmarks (..., k, dim), whose leading axes broadcast."""
    poses = rng.normal(0.0, 3.0, (*of_pose, 3))
    m = model.invert(np.zeros(3), measurements(model, rng, *of_m, 4))
    lead = np.broadcast_shapes(of_pose, of_m)
    z, prediction = model.observe(poses, m), model.predict(poses, m)
    back, ends = model.invert(poses, z), model.outline(m, np.ones((*of_m, 4, 2)))
    assert z.shape == (*lead, 4, model.dim_z)
    assert ends.shape == (*of_m, 4, 2, 2)
    for index in np.ndindex(lead):
        pose = np.broadcast_to(poses, (*lead, 3))[index].copy()
        one = np.broadcast_to(m, (*lead, 4, model.dim))[index].copy()
        there = model.predict(pose, one)
        np.testing.assert_allclose(z[index], model.observe(pose, one), atol=1e-12)
        np.testing.assert_allclose(prediction.z[index], z[index], atol=1e-12)
        np.testing.assert_allclose(prediction.z_D_pose[index], there.z_D_pose, atol=1e-12)
        np.testing.assert_allclose(prediction.z_D_m[index], there.z_D_m, atol=1e-12)
        np.testing.assert_allclose(back[index], model.invert(pose, z[index]), atol=1e-12)


@pytest.mark.parametrize("theta", HEADINGS)
def test_closed_jacobians_are_the_differences(model, theta, rng):
    """Of a kind that gives none, the differences are checked against slower ones."""
    pose = np.array([1.0, 2.0, theta])
    m = landmarks(model, rng, pose)
    elsewhere = compose(pose, np.array([0.7, -0.4, 0.3]))
    closed, slopes = model.predict(elsewhere, m), LandmarkModel.predict(model, elsewhere, m)
    np.testing.assert_allclose(closed.z, model.observe(elsewhere, m), atol=1e-12)
    np.testing.assert_allclose(closed.z_D_pose, slopes.z_D_pose, atol=1e-8)
    np.testing.assert_allclose(closed.z_D_m, slopes.z_D_m, atol=1e-8)
    for k, one in enumerate(m):

        def seen(pose, m, k=k):
            return model.residual(model.observe(pose, m[None])[0], closed.z[k])

        by_pose = jacobian(lambda p, one=one, seen=seen: seen(p, one), elsewhere)
        by_m = jacobian(
            lambda d, one=one, seen=seen: seen(elsewhere, model.retract(one[None], d[None])[0]),
            np.zeros(model.dim),
        )
        np.testing.assert_allclose(closed.z_D_pose[k], by_pose, atol=1e-7)
        np.testing.assert_allclose(closed.z_D_m[k], by_m, atol=1e-7)


@pytest.mark.parametrize("theta", HEADINGS)
def test_a_new_landmark_moves_so_that_it_is_still_seen_as_it_was(model, theta, rng):
    """Through observe's slopes: z_D_m m_D_z = 1 and z_D_m m_D_pose = -z_D_pose."""
    pose = np.array([-2.0, 0.5, theta])
    for z in measurements(model, rng, 4):
        new = model.initialise(pose, seen_as(model, z))
        there = model.predict(pose, new.m[None])
        assert new.slack.shape == (model.dim, model.dim)
        np.testing.assert_allclose(there.z_D_m[0] @ new.m_D_z, np.eye(model.dim_z), atol=1e-8)
        np.testing.assert_allclose(
            there.z_D_m[0] @ new.m_D_pose, -there.z_D_pose[0], atol=1e-8 * (1 + abs(z).max())
        )
        open_ = np.linalg.matrix_rank(new.slack)
        assert np.linalg.matrix_rank(new.m_D_z) + open_ == model.dim


def test_the_difference_is_what_retract_undoes(model, rng):
    m = landmarks(model, rng, np.array([2.0, -3.0, 2.5]), 5)
    delta = 0.3 * rng.normal(size=m.shape)
    np.testing.assert_allclose(model.difference(m, model.retract(m, delta)), delta, atol=1e-12)


def test_motion_jacobian_is_that_of_the_pose_at_the_origin(model, rng):
    z = measurements(model, rng, 5)
    for one, J in zip(z, model.z_D_motion(z), strict=True):
        m = model.invert(np.zeros(3), one[None])
        slope = jacobian(
            lambda p, m=m, one=one: model.residual(model.observe(p, m)[0], one), np.zeros(3)
        )
        np.testing.assert_allclose(J, slope, atol=1e-7)


def test_report_jacobian(model, rng):
    pose = np.array([1.5, 2.5, 0.8])
    for m in landmarks(model, rng, pose, 8):
        report = model.report(m)

        def values(d, m=m):
            moved = model.report(model.retract(m[None], d[None])[0])
            found = moved.position if model.is_place else [moved.values["r"], moved.values["alpha"]]
            return np.array(found)

        numeric = jacobian(values, np.zeros(model.dim))
        np.testing.assert_allclose(report.values_D_m, numeric, atol=1e-7)


def test_no_observation_tells_of_a_motion_of_everything(model, rng):
    """Robot and map moved together look the same: the two Jacobians cancel."""
    pose = np.array([2.0, -3.0, 2.5])
    pose_D_motion = jacobian(lambda xi: compose(exp(xi), pose), np.zeros(3))
    m = landmarks(model, rng, pose)
    seen = model.predict(pose, m)
    total = seen.z_D_pose @ pose_D_motion + seen.z_D_m @ model.m_D_motion(m)
    np.testing.assert_allclose(total, 0.0, atol=1e-7)


def test_carrying_is_moving_and_telling_how_the_motion_jacobian_changes(model, rng):
    m = landmarks(model, rng, np.array([2.0, -3.0, 2.5]))
    delta = 0.3 * rng.normal(size=m.shape)
    after, change = model.carry(m, delta)
    np.testing.assert_allclose(after, model.retract(m, delta), atol=1e-12)
    expected = model.m_D_motion(after) - model.m_D_motion(m)
    np.testing.assert_allclose(change, expected, atol=1e-12)


def test_what_is_somewhere_else_is_apart(model, rng):
    m = landmarks(model, rng, np.zeros(3), 5)
    metres, radians = model.distance(m, m)
    np.testing.assert_allclose([metres, radians], 0.0, atol=1e-12)
    metres, radians = model.distance(m, m[[1, 2, 3, 4, 0]])
    assert ((metres > 0.0) | (radians > 0.0)).all()
