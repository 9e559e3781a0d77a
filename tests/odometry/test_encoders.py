"""The differential drive against integration, its Jacobian against differences, wraps and jumps."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.numeric import jacobian
from tests.odometry_steps import StepwiseOdometry

from impslam.errors import MessageError
from impslam.geometry.se2 import compose
from impslam.odometry.encoders import Encoders
from impslam.odometry.kernels import differential_drive
from impslam.types import WheelAngles

travel = st.floats(-1.0, 1.0)


def integrate(left, right, track, steps=20000):
    """Euler's midpoint rule on the unicycle: an oracle that knows no arc."""
    d, a = 0.5 * (left + right) / steps, (right - left) / track / steps
    heading = (np.arange(steps) + 0.5) * a
    return np.array([d * np.cos(heading).sum(), d * np.sin(heading).sum(), a * steps])


@pytest.mark.parametrize(
    ("left", "right"), [(0.3, 0.5), (0.5, 0.3), (-0.2, 0.2), (0.4, 0.4), (0.4, 0.4 + 1e-5), (0, 0)]
)
def test_arc_equals_integration(left, right):
    d_pose, _ = differential_drive(left, right, 0.4)
    np.testing.assert_allclose(d_pose, integrate(left, right, 0.4), atol=1e-9)


def test_turning_right_wheel_faster_turns_left():
    d_pose, _ = differential_drive(0.1, 0.2, 0.4)
    assert d_pose[2] > 0
    assert d_pose[1] > 0


@given(travel, travel, st.floats(0.1, 1.0))
def test_jacobian(left, right, track):
    _, by_travel = differential_drive(left, right, track)
    numeric = jacobian(lambda u: _unwrapped(u, track), np.array([left, right]), step=1e-5)
    np.testing.assert_allclose(by_travel, numeric, atol=1e-5)


def _unwrapped(u, track):
    d_pose, _ = differential_drive(u[0], u[1], track)
    return np.array([d_pose[0], d_pose[1], (u[1] - u[0]) / track])


@pytest.mark.parametrize("turn", [0.9e-3, 1.1e-3, 1e-7, -1e-7])
def test_jacobian_is_smooth_through_straight(turn):
    """The thesis divides by (r - l)^2 there (Eq. 3.14-3.17) and switches equations at r = l."""
    track, left = 0.4, 0.05
    _, here = differential_drive(left, left + turn * track, track)
    _, straight = differential_drive(left, left, track)
    # The fastest entry is dy/dr, whose slope in the angle is 1/2.
    assert np.abs(here - straight).max() < 0.51 * abs(turn) + 1e-12


def test_limit_is_thesis_3_9_to_3_13():
    length, w, theta = 0.05, 0.4, 0.7
    _, body = differential_drive(length, length, w)
    c, s = math.cos(theta), math.sin(theta)
    in_map = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ body
    thesis = [
        [0.5 * (c + length / w * s), 0.5 * (-length / w * s + c)],
        [0.5 * (s - length / w * c), 0.5 * (length / w * c + s)],
        [-1 / w, 1 / w],
    ]
    np.testing.assert_allclose(in_map, thesis, atol=1e-12)


def drive(encoders, readings, rate=10.0):
    pose, covariance = np.zeros(3), np.zeros((3, 3))
    for i, (left, right) in enumerate(readings):
        increment = encoders.update(WheelAngles(i / rate, left, right))
        if increment is not None:
            pose = compose(pose, increment.d_pose)
            covariance = covariance + increment.covariance
    return pose, covariance


@pytest.mark.parametrize(
    ("per_turn", "wrap"),
    [(2 * math.pi, 0.0), (2000.0, 0.0), (2000.0, 65536.0), (5.0, 5.0), (4096.0, 4096.0)],
)
def test_every_encoder_measures_the_same_distance(per_turn, wrap):
    """Angles, ticks, 16-bit ticks and the MA3's voltage, forward and back, all wrapping."""
    turns = np.cumsum(np.r_[0.0, np.full(40, 0.3), np.full(90, -0.2)])
    readings = np.stack([turns, 0.9 * turns], axis=1) * per_turn + 1.0
    if wrap:
        readings = np.mod(readings, wrap)
    encoders = StepwiseOdometry(
        Encoders(wheel_radius=0.05, track=0.4, per_turn=per_turn, wrap=wrap)
    )
    reference = StepwiseOdometry(Encoders(wheel_radius=0.05, track=0.4))
    expected, _ = drive(reference, np.stack([turns, 0.9 * turns], axis=1) * 2 * math.pi)
    np.testing.assert_allclose(drive(encoders, readings)[0], expected, atol=1e-9)


def test_noise_grows_with_the_distance_however_it_is_cut():
    coarse = np.linspace(0, 50, 11)[:, None] * [1.0, 1.0]
    fine = np.linspace(0, 50, 101)[:, None] * [1.0, 1.0]
    make = {"wheel_radius": 0.05, "track": 0.4}
    variance = [
        drive(StepwiseOdometry(Encoders(**make)), r, rate=len(r))[1][2, 2] for r in (coarse, fine)
    ]
    assert variance[0] == pytest.approx(variance[1], rel=1e-9)
    assert variance[0] > 0


def test_the_path_within_a_gap_is_unknown():
    """The end of a path of 9 m that turns at random lies within the covariance."""
    odometry = Encoders(wheel_radius=0.05, track=0.4)
    rng, length, n = np.random.default_rng(0), 9.0, 300
    headings = np.cumsum(0.15 * rng.standard_normal((200, n)), axis=1)
    ends = length / n * np.stack((np.cos(headings).sum(1), np.sin(headings).sum(1)), axis=1)
    angles = np.stack((length - 0.2 * headings[:, -1], length + 0.2 * headings[:, -1]), axis=1)
    inside = []
    for (left, right), end in zip(angles / 0.05, ends, strict=True):
        steps = StepwiseOdometry(odometry)
        steps.update(WheelAngles(0.0, 0.0, 0.0))
        motion = steps.update(WheelAngles(30.0, left, right))
        error = end - motion.d_pose[:2]
        inside.append(error @ np.linalg.solve(motion.covariance[:2, :2], error) < 9.21)
    assert np.mean(inside) > 0.97


@pytest.mark.parametrize("seconds", [0.5, 1.0, 2.0])
def test_the_bend_of_a_path_between_two_readings_is_in_its_covariance(seconds):
    """The turn rate changes by 2/3 rad/s^2 (1 sigma): the robot leaves its line, and returns to it."""
    rng, speed, n = np.random.default_rng(1), 0.3, 200
    times = (np.arange(n) + 0.5) * seconds / n
    odometry = Encoders(wheel_radius=0.05, track=0.4, wheel_noise=0.0, slip={"sideways": 0.0})
    steps = StepwiseOdometry(odometry)
    steps.update(WheelAngles(0.0, 0.0, 0.0))
    motion = steps.update(WheelAngles(seconds, *2 * [speed * seconds / 0.05]))
    bends = 0.5 * np.outer(2.0 / 3.0 * rng.standard_normal(4000), times * (seconds - times))
    across = speed * seconds * np.sin(bends).mean(axis=1)
    assert np.std(across) == pytest.approx(math.sqrt(motion.covariance[1, 1]), rel=0.05)


def test_readings_at_a_usual_rate_leave_no_room_for_a_bend():
    variances = []
    for seconds in (0.02, 0.1):
        steps = StepwiseOdometry(Encoders(wheel_radius=0.05, track=0.4))
        steps.update(WheelAngles(0.0, 0.0, 0.0))
        variances.append(steps.update(WheelAngles(seconds, 4.0, 4.0)).covariance[1, 1])
    assert variances[1] == pytest.approx(variances[0], rel=0.01)


def test_a_jump_is_left_out_and_the_next_increment_is_sound():
    encoders = StepwiseOdometry(Encoders(wheel_radius=0.05, track=0.4))
    encoders.update(WheelAngles(0.0, 0.0, 0.0))
    with pytest.raises(MessageError, match="jumps by"):
        encoders.update(WheelAngles(0.1, 1e6, 0.0))
    increment = encoders.update(WheelAngles(0.2, 1e6 + 1.0, 1.0))
    np.testing.assert_allclose(increment.d_pose, [0.05, 0, 0], atol=1e-9)


def test_not_finite_is_refused_and_forgotten():
    encoders = StepwiseOdometry(Encoders(wheel_radius=0.05, track=0.4))
    encoders.update(WheelAngles(0.0, 0.0, 0.0))
    with pytest.raises(MessageError, match="not finite"):
        encoders.update(WheelAngles(0.1, math.nan, 0.0))
    increment = encoders.update(WheelAngles(0.2, 1.0, 1.0))
    np.testing.assert_allclose(increment.d_pose, [0.05, 0, 0], atol=1e-12)


def test_constant_noise_is_that_of_a_drive_at_its_speed_whatever_the_wheels_do():
    """Thesis Eq. 2.23: the same Q in each step, here of 0.1 s; 0.3 m/s of a wheel of 0.05 m: 6 rad/s."""
    make = {"wheel_radius": 0.05, "track": 0.4}
    driven = [[0.6 * k, 0.6 * k] for k in range(11)]
    turning = [[-0.1 * k, 0.4 * k] for k in range(11)]
    standing = [[1.0, 1.0] for _ in range(11)]
    _, wanted = drive(StepwiseOdometry(Encoders(**make)), driven)
    for readings in (driven, turning, standing):
        constant = StepwiseOdometry(Encoders(**make, constant_speed=0.3))
        motion, noise = drive(constant, readings)
        np.testing.assert_allclose(noise, wanted, atol=1e-15)
    assert not motion.any()  # it stands, and is less and less sure of it
    assert wanted[2, 2] > 0.0
