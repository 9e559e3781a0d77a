"""The bicycle model against circles and integration; base_link off the axle; what is refused."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.numeric import jacobian
from tests.odometry_steps import StepwiseOdometry

from impslam.errors import MessageError
from impslam.geometry.se2 import compose, compose_uncertain, inverse
from impslam.noise import MotionNoise
from impslam.odometry.ackermann import Ackermann
from impslam.odometry.kernels import bicycle, carried
from impslam.types import Steering

WHEELBASE, OFFSET = 2.83, 0.76
NOISELESS = MotionNoise(forward=0.0, sideways=0.0, turn_per_distance=0.0, turn_per_turn=0.0)
steering = st.floats(-0.6, 0.6)
place = st.tuples(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))


def drive(car, readings, step=0.025):
    """Return where base_link is after (speed, angle) readings, and its covariance."""
    pose, covariance = np.zeros(3), np.zeros((3, 3))
    for i, (speed, angle) in enumerate(readings):
        increment = car.update(Steering(i * step, speed, angle))
        if increment is not None:
            pose, covariance = compose_uncertain(
                pose, covariance, increment.d_pose, increment.covariance
            )
    return pose, covariance


@pytest.mark.parametrize("angle", [0.3, -0.5])
def test_a_turn_of_the_measured_wheel_closes_the_axles_circle(angle):
    """The wheel's own circle is smaller by the offset if it is on the inside of the turn."""
    radius = WHEELBASE / math.tan(angle)
    wheel = 2.0 * math.pi * abs(radius - OFFSET)
    quarter = bicycle(wheel / 4.0, angle, WHEELBASE, OFFSET)
    turn = math.copysign(math.pi / 2.0, angle)
    np.testing.assert_allclose(quarter, [abs(radius), radius, turn], atol=1e-12)


def test_the_front_wheel_rolls_where_it_points():
    """An oracle that knows no curvature: the front axle's velocity is along the wheel."""
    angle, small = 0.4, 1e-6
    moved = bicycle(small, angle, WHEELBASE, 0.0)
    front = compose(moved, np.array([WHEELBASE, 0.0, 0.0]))[:2] - [WHEELBASE, 0.0]
    assert math.atan2(front[1], front[0]) == pytest.approx(angle, abs=1e-6)


def test_a_wheel_on_the_inside_travels_less():
    left, right = (bicycle(1.0, 0.3, WHEELBASE, side * OFFSET) for side in (1.0, -1.0))
    assert left[2] > right[2] > 0.0


def test_straight_on_the_offset_does_not_matter():
    np.testing.assert_allclose(bicycle(2.0, 0.0, WHEELBASE, OFFSET), [2.0, 0.0, 0.0], atol=1e-15)


@given(st.floats(-2.0, 2.0), steering, place)
def test_base_link_moves_rigidly_with_the_axle(distance, angle, axle):
    d_axle = bicycle(distance, angle, WHEELBASE, OFFSET)
    T_base_axle = np.array([*axle, 0.0])
    d_base, _ = carried(d_axle, np.array(axle))
    np.testing.assert_allclose(
        d_base, compose(compose(T_base_axle, d_axle), inverse(T_base_axle)), atol=1e-12
    )


@given(st.floats(-2.0, 2.0), steering, place)
def test_jacobian_of_the_carried_increment(distance, angle, axle):
    d_axle, axle = bicycle(distance, angle, WHEELBASE, OFFSET), np.array(axle)
    numeric = jacobian(lambda d: carried(d, axle)[0], d_axle, step=1e-5)
    np.testing.assert_allclose(carried(d_axle, axle)[1], numeric, atol=1e-8)


def test_a_reading_is_valid_until_the_next_one():
    car = StepwiseOdometry(Ackermann(wheelbase=WHEELBASE))
    assert car.update(Steering(1.0, 2.0, 0.0)) is None
    increment = car.update(Steering(1.5, 9.0, 0.5))
    np.testing.assert_allclose(increment.d_pose, [1.0, 0.0, 0.0])
    assert (increment.stamp, increment.duration) == (1.5, 0.5)


def test_the_position_of_base_link_does_not_change_the_cars_path():
    readings = [(2.0, 0.5 * math.sin(0.05 * i)) for i in range(200)]
    at_axle, _ = drive(
        StepwiseOdometry(Ackermann(wheelbase=WHEELBASE, encoder_offset=OFFSET)), readings
    )
    car = Ackermann(wheelbase=WHEELBASE, encoder_offset=OFFSET, axle=(-3.78, -0.5))
    ahead, _ = drive(StepwiseOdometry(car), readings)
    T_base_axle = np.array([-3.78, -0.5, 0.0])
    np.testing.assert_allclose(
        compose(ahead, T_base_axle), compose(T_base_axle, at_axle), atol=1e-10
    )


def test_scales_and_offset_are_those_of_a_calibration():
    readings = [(2.0, 0.1)] * 50
    meant = [(2.0 * 1.1, 0.9 * 0.1 + 0.02)] * 50
    calibrated = {"speed_scale": 1.1, "steering_scale": 0.9, "steering_offset": 0.02}
    one, _ = drive(StepwiseOdometry(Ackermann(wheelbase=WHEELBASE, **calibrated)), readings)
    two, _ = drive(StepwiseOdometry(Ackermann(wheelbase=WHEELBASE)), meant)
    np.testing.assert_allclose(one, two, atol=1e-12)


def test_covariance_is_that_of_many_noisy_drives(rng):
    """The axle strays by its noise at every step; base_link is carried 4 m ahead of it."""
    noise = MotionNoise(forward=0.02, sideways=0.01, turn_per_distance=0.01, turn_per_turn=0.02)
    axle, steps, distance = np.array([-3.78, -0.5]), 40, 0.25
    readings = [(10.0 * distance, 0.2)] * (steps + 1)
    car = Ackermann(wheelbase=WHEELBASE, axle=tuple(axle), noise=noise)
    mean, covariance = drive(StepwiseOdometry(car), readings, step=0.1)
    d_axle = bicycle(distance, 0.2, WHEELBASE, 0.0)
    root = np.linalg.cholesky(noise.covariance(math.hypot(*d_axle[:2]), d_axle[2]))
    ends = []
    for _ in range(1500):
        pose = np.zeros(3)
        for error in rng.standard_normal((steps, 3)):
            pose = compose(pose, carried(d_axle + root @ error, axle)[0])
        ends.append(pose - mean)
    d2 = np.einsum("ni,ij,nj->n", ends, np.linalg.inv(covariance), ends)
    assert np.mean(d2) == pytest.approx(3.0, abs=5.0 * math.sqrt(6.0 / 1500))


def test_noiseless_parameters_have_no_covariance():
    _, covariance = drive(
        StepwiseOdometry(Ackermann(wheelbase=WHEELBASE, noise=NOISELESS)), [(1.0, 0.2)] * 10
    )
    assert not covariance.any()


@pytest.mark.parametrize(
    ("speed", "angle", "why"),
    [
        (31.0, 0.0, "more than a car can do"),
        (-31.0, 0.0, "more than a car can do"),
        (1.0, 1.0, "more than a car can do"),
        (1.0, math.nan, "not finite"),
        (math.inf, 0.0, "not finite"),
    ],
)
def test_wild_readings_are_refused_and_do_not_hold(speed, angle, why):
    car = StepwiseOdometry(Ackermann(wheelbase=WHEELBASE))
    car.update(Steering(0.0, 1.0, 0.0))
    with pytest.raises(MessageError, match=why):
        car.update(Steering(0.1, speed, angle))
    assert car.update(Steering(0.2, 1.0, 0.0)) is None
    np.testing.assert_allclose(car.update(Steering(0.3, 1.0, 0.0)).d_pose, [0.1, 0.0, 0.0])


def test_a_silence_is_no_motion():
    car = StepwiseOdometry(Ackermann(wheelbase=WHEELBASE))
    car.update(Steering(0.0, 5.0, 0.0))
    with pytest.raises(MessageError, match=r"no speed and steering for 10\.0 s"):
        car.update(Steering(10.0, 5.0, 0.0))
    assert car.update(Steering(10.1, 5.0, 0.0)).d_pose[0] == pytest.approx(0.5)
