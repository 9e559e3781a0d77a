"""SE(2): group axioms on batches, closed forms against series, Jacobians against differences."""

import math
import re
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from tests.numeric import jacobian, wrapped

import impslam
from impslam.geometry.angles import wrap, wrap_in_kernel
from impslam.geometry.se2 import (
    between,
    block_rotation,
    compose,
    compose_jacobians,
    compose_uncertain,
    exp,
    inverse,
    inverse_uncertain,
    log,
    rotation,
    sinc_cosc,
    transform,
)

coordinate = st.floats(-100, 100)
angle = st.floats(-math.pi, math.pi)
poses = st.builds(lambda x, y, t: np.array([x, y, t]), coordinate, coordinate, angle)
LEAD = st.sampled_from([(), (1,), (4,), (0,), (2, 3)])


@st.composite
def batches(draw, count):
    """Draw some batches of poses of one leading shape, or with an axis that broadcasts."""
    lead = draw(LEAD)
    out = []
    for _ in range(count):
        own = draw(st.sampled_from([lead, lead[1:]]))
        xy = draw(arrays(float, (*own, 2), elements=coordinate))
        out.append(np.concatenate([xy, draw(arrays(float, (*own, 1), elements=angle))], axis=-1))
    return out


def close(a, b, tolerance=1e-9):
    return np.abs(wrapped(np.asarray(a) - np.asarray(b), 2)).max(initial=0.0) < tolerance


@given(st.floats(-1e3, 1e3))
def test_wrap_keeps_direction_and_range(theta):
    w = wrap(theta)
    assert -math.pi < w <= math.pi
    assert math.isclose(math.cos(w), math.cos(theta), abs_tol=1e-9)
    assert math.isclose(math.sin(w), math.sin(theta), abs_tol=1e-9)
    assert w == wrap_in_kernel(theta) == wrap(np.array([theta]))[0]


@pytest.mark.parametrize(
    "theta", [1e-300, 1e-9, 1e-6, 9.9e-5, 1.01e-4, 1e-3, 0.1, 1.0, 3.1, math.pi]
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_sinc_cosc_are_exact_to_rounding(theta, sign):
    t = Fraction(sign * theta)
    series = [(-1) ** (k // 2) * t**k / math.factorial(k + 1) for k in range(40)]
    a, b = sinc_cosc(sign * theta)
    assert math.isclose(a, sum(series[::2]), rel_tol=4e-16, abs_tol=4e-16)
    assert math.isclose(b, sum(series[1::2]), rel_tol=4e-16)


def test_sinc_cosc_at_zero():
    assert sinc_cosc(0.0) == sinc_cosc(-0.0) == (1.0, 0.0)


@given(poses)
def test_the_covariance_of_an_inverse_is_propagated_by_its_jacobian(a):
    P = np.array([[2.0, 0.3, 0.1], [0.3, 1.0, -0.2], [0.1, -0.2, 0.5]])
    J = jacobian(lambda v: wrapped(inverse(v) - inverse(a), 2), a)
    back, spread = inverse_uncertain(a, P)
    np.testing.assert_array_equal(back, inverse(a))
    np.testing.assert_allclose(spread, J @ P @ J.T, atol=1e-6 * (1.0 + np.abs(a).max()) ** 2)
    again = inverse_uncertain(np.stack([back, back]), np.stack([spread, spread]))[1]
    np.testing.assert_allclose(again, [P, P], atol=1e-9 * (1.0 + np.abs(a).max()) ** 2)


@given(angle)
def test_a_block_rotation_is_that_of_a_turned_frame(theta):
    by_second = compose_jacobians(np.array([1.0, 2.0, theta]), np.array([3.0, 4.0, 5.0]))[1]
    np.testing.assert_allclose(block_rotation(theta), by_second, atol=1e-15)


def test_wrap_ends():
    assert wrap(math.pi) == math.pi
    assert wrap(-math.pi) == math.pi
    np.testing.assert_allclose(wrap(np.array([3 * math.pi, -0.5])), [math.pi, -0.5])


def test_angles_are_wrapped_in_one_place():
    """No other module takes an angle modulo a turn and moves it by half of one."""
    source = Path(impslam.__file__).parent
    half_turn = re.compile(r"pi\b[^\n]*(%|\bmod\(|remainder\(|fmod\()[^\n]*pi\b")
    found = [
        path.relative_to(source).as_posix()
        for path in source.rglob("*.py")
        if half_turn.search(path.read_text("utf-8"))
    ]
    assert found == ["geometry/angles.py"]


@given(batches(3))
def test_group_axioms(abc):
    a, b, c = abc
    identity = np.zeros(3)
    assert close(compose(compose(a, b), c), compose(a, compose(b, c)), 1e-8)
    assert close(compose(a, identity), a)
    assert close(compose(identity, a), a)
    assert close(compose(a, inverse(a)), np.zeros_like(a))
    assert close(compose(inverse(a), a), np.zeros_like(a))
    assert close(compose(a, between(a, b)), compose(b, identity) + np.zeros_like(compose(a, b)))


@given(batches(2))
def test_a_batch_is_its_poses_one_by_one(ab):
    """Every function, on broadcast leading axes, against itself on single poses."""
    a, b = (poses.copy() for poses in np.broadcast_arrays(*ab))
    P, Q = np.diag([1.0, 2.0, 3.0]), np.diag([0.1, 0.3, 0.2])
    points = np.arange(10.0).reshape(5, 2)
    for index in np.ndindex(a.shape[:-1]):
        one, two = a[index].copy(), b[index].copy()
        assert np.array_equal(compose(*ab)[index], compose(one, two))
        assert np.array_equal(between(*ab)[index], between(one, two))
        for whole, part in zip(compose_jacobians(*ab), compose_jacobians(one, two), strict=True):
            assert np.array_equal(whole[index], part)
        both = zip(
            compose_uncertain(ab[0], P, ab[1], Q), compose_uncertain(one, P, two, Q), strict=True
        )
        for whole, part in both:
            assert np.array_equal(whole[index], part)
        for function in (inverse, exp, log):
            assert np.array_equal(function(a)[index], function(one))
        np.testing.assert_allclose(rotation(a[..., 2])[index], rotation(float(one[2])), atol=1e-15)
        assert np.array_equal(transform(a, points)[index], transform(one, points))
        own = b[..., None, :2] + points
        assert np.array_equal(transform(a, own)[index], transform(one, own[index]))
        assert np.array_equal(transform(one, own)[index], transform(one, own[index]))


@given(batches(2))
def test_transform_is_the_action_of_compose(ab):
    a, b = (x.copy() for x in np.broadcast_arrays(*ab))
    moved = transform(a, b[..., None, :2])[..., 0, :]
    np.testing.assert_allclose(moved, compose(a, b)[..., :2], atol=1e-9)


def test_one_pose_moves_points_of_any_shape(rng):
    points = rng.uniform(-5, 5, (3, 4, 2))
    pose = np.array([1.0, 2.0, 0.5])
    moved = points @ rotation(0.5).T + [1.0, 2.0]
    np.testing.assert_allclose(transform(pose, points), moved)
    np.testing.assert_allclose(transform(pose, points[0, 0]), moved[0, 0])
    assert transform(pose, points[:0]).shape == (0, 4, 2)


@given(batches(1), st.floats(-3.1, 3.1))
def test_log_inverts_exp(a, theta):
    (twist,) = a
    twist[..., 2] = theta
    np.testing.assert_allclose(log(exp(twist)), twist, atol=1e-8)


@given(poses, st.floats(-1, 1), st.floats(-1, 1))
def test_exp_of_one_twist_is_a_subgroup(twist, s, t):
    assert close(compose(exp(s * twist), exp(t * twist)), exp((s + t) * twist), 1e-8)


@pytest.mark.parametrize("theta", [1e-3, 1e-4 * (1 + 1e-9), 1e-4 * (1 - 1e-9), 1e-6, 0.0])
def test_exp_is_smooth_through_zero(theta):
    # The same motion in many small pieces, whose series need no division.
    pieces = 64
    small, whole = exp(np.array([1.0, 0.3, theta]) / pieces), np.zeros(3)
    for _ in range(pieces):
        whole = compose(whole, small)
    assert close(exp(np.array([1.0, 0.3, theta])), whole, 1e-12)


@given(poses, poses)
def test_jacobians(a, b):
    first, second = compose_jacobians(a, b)
    scale = 1e-7 * (1.0 + np.abs(a).max() + np.abs(b).max())
    ab = compose(a, b)
    by_first = jacobian(lambda v: wrapped(compose(v, b) - ab, 2), a)
    by_second = jacobian(lambda v: wrapped(compose(a, v) - ab, 2), b)
    np.testing.assert_allclose(first, by_first, atol=scale)
    np.testing.assert_allclose(second, by_second, atol=scale)


def test_uncertain_composition_carries_covariances_by_the_jacobians(rng):
    a, b = rng.normal(size=3), rng.normal(size=3)
    P, Q = (A @ A.T for A in rng.normal(size=(2, 3, 3)))
    pose, covariance = compose_uncertain(a, P, b, Q)
    first, second = compose_jacobians(a, b)
    np.testing.assert_allclose(pose, compose(a, b))
    np.testing.assert_allclose(covariance, first @ P @ first.T + second @ Q @ second.T)


def test_rotation_is_counter_clockwise():
    np.testing.assert_allclose(rotation(math.pi / 2) @ [1.0, 0.0], [0.0, 1.0], atol=1e-15)


@pytest.mark.parametrize("m", [1, 2])
def test_one_covariance_serves_all_poses_of_a_batch(rng, m):
    T, poses, P, Q = rng.normal(size=3), rng.normal(size=(m, 3)), np.eye(3), 2.0 * np.eye(3)
    moved, covariance = compose_uncertain(T, P, poses, Q)
    for k in range(m):
        one, of_one = compose_uncertain(T, P, poses[k], Q)
        np.testing.assert_array_equal(moved[k], one)
        np.testing.assert_array_equal(covariance[k], of_one)
