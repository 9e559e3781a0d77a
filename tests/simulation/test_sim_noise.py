"""What wheels and inertial unit read: exact without faults, of the stated statistics with them."""

import math

import numpy as np
import pytest

from impslam.geometry.se2 import compose, exp
from impslam.simulation.drive import Trajectory, advance, drive
from impslam.simulation.noise import inertial, wheel_angles
from impslam.simulation.robot import InertialUnit, WheelEncoders
from impslam.simulation.simulate import ticks
from impslam.simulation.world import load_world


def travelling(v: float, omega: float, seconds: float) -> Trajectory:
    n = round(seconds * 100)
    poses = [np.zeros(3)]
    for _ in range(n):
        poses.append(advance(poses[-1], (v, omega), 0.01))
    return Trajectory(np.arange(n + 1) / 100, np.array(poses), np.tile([v, omega], (n, 1)))


STRAIGHT = travelling(1.0, 0.0, 4.0)
TURN = travelling(0.0, 0.5, 4.0)


def readings(way: Trajectory, seed: int = 0, **faults: float) -> np.ndarray:
    """Both wheels' travel (k, 2) in m of otherwise perfect encoders."""
    encoders = WheelEncoders.perfect(**faults)
    times = ticks(encoders.rate, way.duration)
    angles = wheel_angles(encoders, way, times, np.random.default_rng(seed))
    return encoders.wheel_radius * (angles - angles[0])


@pytest.mark.parametrize("name", ["arena", "corridor"])
def test_perfect_encoders_integrate_to_the_true_path(name):
    plan = load_world(name).robot
    way = drive(plan)
    encoders = WheelEncoders.perfect()
    pose = way.poses[0]
    worst = 0.0
    for (left, right), true in zip(np.diff(readings(way), axis=0), way.poses[1:], strict=True):
        turn = (right - left) / encoders.track
        pose = compose(pose, exp(np.array([0.5 * (left + right), 0.0, turn])))
        worst = max(worst, math.dist(pose[:2], true[:2]))
    assert worst < 1e-9


def test_encoder_variance_grows_with_distance():
    ways = np.array([readings(STRAIGHT, seed, noise=4e-4)[[100, 400]] for seed in range(400)])
    errors = ways - np.array([1.0, 4.0])[None, :, None]
    variance = (errors**2).mean(axis=(0, 2))
    # 800 draws each: relative standard deviation of the variance is sqrt(2 / 800) = 5 %.
    np.testing.assert_allclose(variance, 4e-4 * np.array([1.0, 4.0]), rtol=0.2)
    left, right = errors[:, 1].T
    assert abs(np.corrcoef(left, right)[0, 1]) < 0.2


def test_encoders_at_rest_are_silent():
    still = travelling(0.0, 0.0, 1.0)
    assert np.ptp(readings(still, noise=1.0, skid_rate=5.0), axis=0).max() == 0.0


def test_systematic_errors_scale_distance_and_turn():
    rates = np.array([readings(STRAIGHT, seed, radius_sigma=0.01)[-1] / 4.0 for seed in range(500)])
    assert (1.0 / rates - 1.0).std() == pytest.approx(0.01, rel=0.15)
    turns = np.array([readings(TURN, seed, track_sigma=0.02)[-1] for seed in range(500)])
    np.testing.assert_allclose(turns[:, 0], -turns[:, 1])
    assert (turns[:, 1] / (0.5 * 0.4 * 2.0) - 1.0).std() == pytest.approx(0.02, rel=0.15)


def test_slip_loses_rotation_in_turns_and_nothing_on_straights():
    np.testing.assert_allclose(readings(STRAIGHT, 3, slip_sigma=0.5)[-1], [4.0, 4.0])
    turns = np.array([readings(TURN, seed, slip_sigma=0.05)[-1, 1] for seed in range(500)])
    lost = 1.0 - turns / 0.4
    assert lost.min() >= 0.0
    assert lost.mean() == pytest.approx(0.05 * math.sqrt(2 / math.pi), rel=0.15)


def test_slip_is_drawn_once_per_turn():
    twists = np.repeat([[0.0, 0.5], [0.2, 0.0], [0.0, 0.5]], 100, axis=0)
    poses = [np.zeros(3)]
    for twist in twists:
        poses.append(advance(poses[-1], tuple(twist), 0.01))
    way = Trajectory(np.arange(301) / 100, np.array(poses), twists)
    kept = np.diff(readings(way, 1, slip_sigma=0.1)[:, 1])
    assert np.ptp(kept[:100]) < 1e-12
    assert np.ptp(kept[200:]) < 1e-12
    assert abs(kept[0] - kept[250]) > 1e-6


def test_skids_have_the_given_frequency_and_length():
    lost = [4.0 - readings(STRAIGHT, s, skid_rate=0.5, skid_length=0.02)[-1] for s in range(300)]
    assert np.min(lost) >= -1e-12
    assert np.mean(lost) == pytest.approx(4.0 * 0.5 * 0.02, rel=0.2)
    assert np.mean(np.array(lost) < 1e-9) == pytest.approx(math.exp(-2.0), abs=0.06)


def test_readings_are_multiples_of_the_encoders_step():
    encoders = WheelEncoders.perfect(counts=4096)
    times = ticks(100.0, STRAIGHT.duration)
    angles = wheel_angles(encoders, STRAIGHT, times, np.random.default_rng(2))
    steps = angles * 4096 / (2 * math.pi)
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
    exact = times / encoders.wheel_radius
    # A reading lags by up to one step; begin and end each do.
    assert np.abs(angles[:, 0] - angles[0, 0] - exact).max() <= 2 * math.pi / 4096 + 1e-12


def test_perfect_gyro_sums_to_the_angle_and_accelerometer_measures_the_curve():
    way = travelling(0.5, 0.4, 2.0)
    times = ticks(100.0, way.duration)
    rates, forces = inertial(InertialUnit.perfect(), way, times, np.random.default_rng(0))
    assert rates[1:, 2].sum() / 100.0 == pytest.approx(0.8)
    np.testing.assert_allclose(rates[:, :2], 0.0)
    np.testing.assert_allclose(forces, np.tile([0.0, 0.2, 9.80665], (len(times), 1)), atol=1e-9)


def test_a_single_inertial_reading_is_that_of_a_standing_robot():
    way, times = travelling(0.5, 0.4, 2.0), np.zeros(1)
    rates, forces = inertial(InertialUnit.perfect(), way, times, np.random.default_rng(0))
    np.testing.assert_array_equal(rates, [[0.0, 0.0, 0.0]])
    np.testing.assert_array_equal(forces, [[0.0, 0.0, 9.80665]])


def test_gyro_noise_and_bias():
    unit = InertialUnit.perfect(gyro_sigma=0.01, gyro_bias_sigma=0.1)
    still = travelling(0.0, 0.0, 10.0)
    times = ticks(100.0, 10.0)
    runs = [inertial(unit, still, times, np.random.default_rng(s))[0] for s in range(100)]
    assert np.mean([run.std(axis=0) for run in runs]) == pytest.approx(0.01, rel=0.02)
    assert np.std([run.mean(axis=0) for run in runs]) == pytest.approx(0.1, rel=0.15)
