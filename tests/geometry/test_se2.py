"""SE(2): group laws, closed forms against series, Jacobians against differences."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.numeric import jacobian, wrapped

from impslam.geometry.angles import wrap
from impslam.geometry.se2 import (
    between,
    compose,
    compose_jacobians,
    exp,
    inverse,
    log,
    rotation,
    transform,
)

coordinate = st.floats(-100, 100)
angle = st.floats(-math.pi, math.pi)
poses = st.builds(lambda x, y, t: np.array([x, y, t]), coordinate, coordinate, angle)


def close(a, b, tolerance=1e-9):
    return np.abs(wrapped(np.asarray(a) - np.asarray(b), 2)).max() < tolerance


@given(st.floats(-1e3, 1e3))
def test_wrap_keeps_direction_and_range(theta):
    w = wrap(theta)
    assert -math.pi < w <= math.pi
    assert math.isclose(math.cos(w), math.cos(theta), abs_tol=1e-9)
    assert math.isclose(math.sin(w), math.sin(theta), abs_tol=1e-9)


def test_wrap_ends():
    assert wrap(math.pi) == math.pi
    assert wrap(-math.pi) == math.pi
    np.testing.assert_allclose(wrap(np.array([3 * math.pi, -0.5])), [math.pi, -0.5])


@given(poses, poses, poses)
def test_group_laws(a, b, c):
    assert close(compose(compose(a, b), c), compose(a, compose(b, c)))
    assert close(compose(a, inverse(a)), np.zeros(3))
    assert close(compose(a, between(a, b)), b)


@given(poses, poses)
def test_transform_is_the_action_of_compose(a, b):
    np.testing.assert_allclose(transform(a, b[None, :2])[0], compose(a, b)[:2], atol=1e-9)


@given(st.floats(-3.1, 3.1), coordinate, coordinate)
def test_log_inverts_exp(theta, x, y):
    twist = np.array([x, y, theta])
    np.testing.assert_allclose(log(exp(twist)), twist, atol=1e-8)


@pytest.mark.parametrize("theta", [1e-3, 1e-4 * (1 + 1e-9), 1e-4 * (1 - 1e-9), 1e-6, 0.0])
def test_exp_is_smooth_through_zero(theta):
    # The same motion in many small pieces, whose series need no division.
    pieces = 64
    small, whole = exp(np.array([1.0, 0.3, theta]) / pieces), np.zeros(3)
    for _ in range(pieces):
        whole = compose(whole, small)
    assert close(exp(np.array([1.0, 0.3, theta])), whole, 1e-12)


@given(poses, poses)
def test_compose_jacobians(a, b):
    def difference(value):
        return wrapped(value - compose(a, b), 2)

    first, second = compose_jacobians(a, b)
    scale = 1.0 + np.abs(b).max()
    np.testing.assert_allclose(
        first, jacobian(lambda v: difference(compose(v, b)), a), atol=1e-7 * scale
    )
    np.testing.assert_allclose(
        second, jacobian(lambda v: difference(compose(a, v)), b), atol=1e-7 * scale
    )


def test_rotation_is_counter_clockwise():
    np.testing.assert_allclose(rotation(math.pi / 2) @ [1.0, 0.0], [0.0, 1.0], atol=1e-15)
