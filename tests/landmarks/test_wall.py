"""Walls: what is reported, extents, and that they move with everything."""

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.numeric import jacobian, wrapped

from impslam.geometry.se2 import exp, transform
from impslam.landmarks.wall import Wall
from impslam.types import Observation


def observations(rng, count=4):
    """Walls at places all round the robot."""
    for _ in range(count):
        alpha, rho = rng.uniform(-math.pi, math.pi), rng.uniform(-1.0, 5.0)
        n = np.array([math.cos(alpha), math.sin(alpha)])
        t = np.array([-n[1], n[0]])
        ends = np.array([rho * n + s * t for s in (rng.uniform(-3, 0), rng.uniform(0.5, 3))])
        yield Observation(
            "wall", np.array([rho, alpha]), np.diag([1e-4, 1e-5]), np.arange(20), ends
        )


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
    np.testing.assert_allclose(wall.observe(pose, m)[0], thesis, atol=1e-12)


def test_a_wall_stays_smooth_when_the_robot_passes_its_line():
    wall, m = Wall(), np.array([[0.0, 0.0, 0.0]])
    before, behind = (wall.observe(np.array([x, 0.3, 0.0]), m)[0] for x in (-1e-6, 1e-6))
    np.testing.assert_allclose(before, behind, atol=1e-5)


def test_extents_and_gaps_of_walls(rng):
    wall, pose = Wall(max_gap=1.0), np.array([1.0, -2.0, 2.0])
    pieces = list(observations(rng, 3))
    states = np.array([wall.initialise(pose, o).m for o in pieces])
    ends = np.array([o.end_points for o in pieces])
    seen = wall.extents(pose, states, ends)
    assert seen.shape == (3, 2)
    outlines, there = wall.outline(states, seen), transform(pose, ends)
    for outline, both in zip(outlines, there, strict=True):
        np.testing.assert_allclose(np.sort(outline, axis=0), np.sort(both, axis=0), atol=1e-9)
    gap = wall.overlap(pose, states, seen, seen).gap
    np.testing.assert_allclose(gap, -np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1))


def test_collinear_pieces_have_the_gap_between_them():
    wall, pose = Wall(), np.zeros(3)

    def piece(a, b):
        ends = np.array([[2.0, a], [2.0, b]])
        return Observation("wall", np.array([2.0, 0.0]), np.eye(2) * 1e-4, np.arange(9), ends)

    m = wall.initialise(pose, piece(0.0, 1.0)).m[None].repeat(2, axis=0)
    ends = [piece(*ab).end_points for ab in ((0.0, 1.0), (0.0, 1.0), (6.0, 7.0), (-2.0, -0.5))]
    known, seen = (
        wall.extents(pose, m, np.array(ends[:2])),
        wall.extents(pose, m, np.array(ends[2:])),
    )
    np.testing.assert_allclose(wall.overlap(pose, m, known, seen).gap, [5.0, 0.5])


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
        return wall.extents(p, m[None], q[None])[0].mean(keepdims=True)

    known = wall.extents(pose, m[None], q[None])
    overlap = wall.overlap(pose, m[None], known, known)
    by_pose = jacobian(lambda p: place(p, m), pose)[0]
    by_m = jacobian(lambda d: place(pose, wall.retract(m[None], d[None])[0]), np.zeros(3))[0]
    np.testing.assert_allclose(overlap.gap_D_pose[0], by_pose, atol=1e-6)
    np.testing.assert_allclose(overlap.gap_D_m[0], by_m, atol=1e-6)


def local(m, other):
    """Return the perturbation that takes m to other."""
    c, s = math.cos(m[2]), math.sin(m[2])
    d = other[:2] - m[:2]
    return np.array([c * d[0] + s * d[1], c * d[1] - s * d[0], wrapped(other - m, 2)[2]])


@pytest.mark.parametrize("theta", [0.0, 3.0, math.pi - 1e-9, -math.pi + 1e-9, 5.9])
def test_a_new_wall_moves_with_the_pose_and_the_observation(theta, rng):
    """The whole frame, including its position along the wall, which is not measured."""
    wall, pose = Wall(), np.array([-2.0, 0.5, theta])
    for o in observations(rng):
        new = wall.initialise(pose, o)

        def began(pose, z, o=o, new=new):
            return local(new.m, wall.initialise(pose, replace(o, z=z)).m)

        by_pose = jacobian(lambda p, o=o, began=began: began(p, o.z), pose)
        by_z = jacobian(lambda z, began=began: began(pose, z), o.z)
        by_z[1] = 0.0  # the place along the wall is no measurement: `slack` stands for it
        np.testing.assert_allclose(new.m_D_pose, by_pose, atol=1e-7)
        np.testing.assert_allclose(new.m_D_z, by_z, atol=1e-6)


def test_a_wall_moves_with_everything(rng):
    wall, pose = Wall(), np.array([2.0, -3.0, 2.5])
    m = np.array([wall.initialise(pose, o).m for o in observations(rng)])
    for one, J in zip(m, wall.m_D_motion(m), strict=True):

        def moved(xi, one=one):
            there = transform(exp(xi), one[:2])
            return local(one, np.append(there, one[2] + xi[2]))

        np.testing.assert_allclose(J, jacobian(moved, np.zeros(3)), atol=1e-8)
