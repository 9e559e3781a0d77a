"""Every landmark model: Jacobians against differences, inverses, and what is reported."""

import math

import numpy as np
import pytest
from tests.numeric import jacobian, wrapped

from impslam.component import components
from impslam.geometry.se2 import compose, exp, transform
from impslam.landmarks.wall import Wall
from impslam.types import Observation

MODELS = {name: cls() for name, cls in components("landmark").items()}
HEADINGS = [0.0, 0.4, math.pi / 2, 3.0, math.pi - 1e-9, -math.pi + 1e-9, -1.2, 5.9]


def observations(model, rng, count=4):
    """Observations of the model's kind at places all round the robot."""
    kind = model.name
    for _ in range(count):
        if model.dim == 3:
            alpha, rho = rng.uniform(-math.pi, math.pi), rng.uniform(-1.0, 5.0)
            n = np.array([math.cos(alpha), math.sin(alpha)])
            t = np.array([-n[1], n[0]])
            ends = np.array([rho * n + s * t for s in (rng.uniform(-3, 0), rng.uniform(0.5, 3))])
            yield Observation(
                kind, np.array([rho, alpha]), np.diag([1e-4, 1e-5]), np.arange(20), ends
            )
        else:
            yield Observation(kind, rng.uniform(-5, 5, 2), np.array([[2e-4, 5e-5], [5e-5, 1e-4]]))


@pytest.fixture(params=sorted(MODELS))
def model(request):
    return MODELS[request.param]


@pytest.mark.parametrize("theta", HEADINGS)
def test_prediction_inverts_initialisation(model, theta, rng):
    pose = np.array([3.0, -7.0, theta])
    for observation in observations(model, rng):
        m = model.initialise(pose, observation).m
        z = model.predict(pose, m[None]).z[0]
        np.testing.assert_allclose(model.residual(observation.z, z), 0.0, atol=1e-12)


@pytest.mark.parametrize("theta", HEADINGS)
def test_prediction_jacobians(model, theta, rng):
    pose = np.array([1.0, 2.0, theta])
    states = np.array([model.initialise(pose, o).m for o in observations(model, rng)])
    elsewhere = compose(pose, np.array([0.7, -0.4, 0.3]))
    prediction = model.predict(elsewhere, states)
    for k, m in enumerate(states):
        by_pose = jacobian(
            lambda p, m=m, k=k: model.residual(model.predict(p, m[None]).z[0], prediction.z[k]),
            elsewhere,
        )
        by_m = jacobian(
            lambda d, m=m, k=k: model.residual(
                model.predict(elsewhere, model.retract(m[None], d[None])).z[0], prediction.z[k]
            ),
            np.zeros(model.dim),
        )
        np.testing.assert_allclose(prediction.z_D_pose[k], by_pose, atol=1e-7)
        np.testing.assert_allclose(prediction.z_D_m[k], by_m, atol=1e-7)


def test_motion_jacobian_is_that_of_the_pose_at_the_origin(model, rng):
    for o in observations(model, rng):
        m = model.initialise(np.zeros(3), o).m
        expected = model.predict(np.zeros(3), m[None]).z_D_pose[0]
        np.testing.assert_allclose(model.z_D_motion(o.z), expected, atol=1e-12)


def local(model, m, other):
    """Return the perturbation that takes m to other."""
    if model.dim == 2:
        return other - m
    c, s = math.cos(m[2]), math.sin(m[2])
    d = other[:2] - m[:2]
    return np.array([c * d[0] + s * d[1], c * d[1] - s * d[0], wrapped(other - m, 2)[2]])


@pytest.mark.parametrize("theta", HEADINGS)
def test_initialisation_jacobians(model, theta, rng):
    pose = np.array([-2.0, 0.5, theta])
    for o in observations(model, rng):
        new = model.initialise(pose, o)
        by_pose = jacobian(lambda p, o=o, m=new.m: local(model, m, model.initialise(p, o).m), pose)
        by_z = jacobian(
            lambda z, o=o, m=new.m: local(
                model,
                m,
                model.initialise(pose, Observation(o.kind, z, o.R, o.beams, o.end_points)).m,
            ),
            o.z,
        )
        np.testing.assert_allclose(new.m_D_pose, by_pose, atol=1e-7)
        if model.dim == 3:
            # The place along the wall is no measurement: it is what `slack` stands for.
            by_z[1] = 0.0
        np.testing.assert_allclose(new.m_D_z, by_z, atol=1e-6)


def test_report_jacobian(model, rng):
    pose = np.array([1.5, 2.5, 0.8])
    for o in observations(model, rng, 8):
        m = model.initialise(pose, o).m
        report = model.report(m)

        def values(d, m=m):
            moved = model.report(model.retract(m[None], d[None])[0])
            return np.array(list(moved.values.values()) or moved.position)

        numeric = jacobian(values, np.zeros(model.dim))
        np.testing.assert_allclose(report.values_D_m, numeric, atol=1e-7)


def test_the_reported_foot_is_on_the_wall_and_nearest_to_the_origin():
    wall = Wall()
    for m in ([2.0, 1.0, 0.3], [2.0, 1.0, 0.3 + math.pi], [-1.0, -4.0, 2.0], [0.0, 0.0, 1.0]):
        foot = wall.report(np.array(m)).position
        n = np.array([math.cos(m[2]), math.sin(m[2])])
        assert n @ (foot - m[:2]) == pytest.approx(0.0, abs=1e-12)
        assert abs(n[0] * foot[1] - n[1] * foot[0]) < 1e-12
        values = wall.report(np.array(m)).values
        assert values["r"] >= 0
        np.testing.assert_allclose(
            values["r"] * np.array([math.cos(values["alpha"]), math.sin(values["alpha"])]),
            foot,
            atol=1e-12,
        )


def test_thesis_4_14_gives_the_same_measurement(rng):
    """Foot form of the thesis (Eq. 4.14-4.15) against ours, for a wall away from the origin."""
    wall, pose = Wall(), np.array([0.4, 0.9, 0.7])
    m = np.array([[3.0, 1.0, 0.5]])
    x2, y2 = wall.report(m[0]).position
    xr, yr, theta = pose
    cross = (x2 * yr - y2 * xr) / (x2**2 + y2**2)
    x1, y1 = x2 - y2 * cross, y2 + x2 * cross
    thesis = [math.hypot(y1 - yr, x1 - xr), math.atan2(y1 - yr, x1 - xr) - theta]
    np.testing.assert_allclose(wall.predict(pose, m).z[0], thesis, atol=1e-12)


def test_a_wall_stays_smooth_when_the_robot_passes_its_line():
    wall, m = Wall(), np.array([[0.0, 0.0, 0.0]])
    before, behind = (wall.predict(np.array([x, 0.3, 0.0]), m).z[0] for x in (-1e-6, 1e-6))
    np.testing.assert_allclose(before, behind, atol=1e-5)


def test_extents_and_gaps_of_walls(rng):
    wall = Wall(max_gap=1.0)
    pose = np.array([1.0, -2.0, 2.0])
    pieces = list(observations(wall, rng, 3))
    states = np.array([wall.initialise(pose, o).m for o in pieces])
    seen = wall.extents(pose, states, pieces)
    assert seen.shape == (3, 3, 2)
    for i, piece in enumerate(pieces):
        ends = wall.outlines(states[[i]], seen[i, [i]])[0]
        np.testing.assert_allclose(
            np.sort(ends, axis=0), np.sort(transform(pose, piece.end_points), axis=0), atol=1e-9
        )
        length = np.linalg.norm(piece.end_points[1] - piece.end_points[0])
        overlap = wall.overlap(pose, states, seen[i, i][None].repeat(3, axis=0), seen)
        assert overlap.gap[i, i] == pytest.approx(-length)


def test_collinear_pieces_have_the_gap_between_them():
    wall, pose = Wall(), np.zeros(3)

    def piece(a, b):
        ends = np.array([[2.0, a], [2.0, b]])
        return Observation("wall", np.array([2.0, 0.0]), np.eye(2) * 1e-4, np.arange(9), ends)

    m = wall.initialise(pose, piece(0.0, 1.0)).m[None]
    known = wall.extents(pose, m, [piece(0.0, 1.0)])[0]
    gaps = wall.overlap(pose, m, known, wall.extents(pose, m, [piece(6.0, 7.0), piece(-2, -0.5)]))
    np.testing.assert_allclose(gaps.gap[:, 0], [5.0, 0.5])


def test_overlap_jacobian_along_the_wall():
    wall = Wall()
    pose, q = np.array([0.5, 0.2, 0.4]), np.array([[1.0, 0.7], [1.4, 1.5]])
    n = np.array([q[0, 1] - q[1, 1], q[1, 0] - q[0, 0]]) / np.linalg.norm(q[1] - q[0])
    n *= np.sign(n @ q[0])
    o = Observation(
        "wall", np.array([n @ q[0], math.atan2(n[1], n[0])]), np.eye(2), np.arange(9), q
    )
    m = wall.initialise(pose, o).m

    def place(p, m):
        return wall.extents(p, m[None], [o])[0, 0].mean(keepdims=True)

    known = wall.extents(pose, m[None], [o])
    overlap = wall.overlap(pose, m[None], known[0], known)
    by_pose = jacobian(lambda p: place(p, m), pose)[0]
    by_m = jacobian(lambda d: place(pose, wall.retract(m[None], d[None])[0]), np.zeros(3))[0]
    np.testing.assert_allclose(overlap.gap_D_pose[0], by_pose, atol=1e-6)
    np.testing.assert_allclose(overlap.gap_D_m[0], by_m, atol=1e-6)


def test_no_observation_tells_of_a_motion_of_everything(model, rng):
    """Robot and map moved together look the same; how a landmark moves agrees with differences."""
    pose = np.array([2.0, -3.0, 2.5])
    pose_D_motion = jacobian(lambda xi: compose(exp(xi), pose), np.zeros(3))
    for observation in observations(model, rng):
        m = model.initialise(pose, observation).m[None]
        m_D_motion, seen = model.m_D_motion(m)[0], model.predict(pose, m)
        np.testing.assert_allclose(
            seen.z_D_pose[0] @ pose_D_motion + seen.z_D_m[0] @ m_D_motion, 0.0, atol=1e-8
        )

        def moved(xi, m=m):
            there = transform(exp(xi), m[0, :2])
            whole = np.append(there, m[0, 2:] + xi[2])
            return local(model, m[0], whole)

        np.testing.assert_allclose(m_D_motion, jacobian(moved, np.zeros(3)), atol=1e-8)
