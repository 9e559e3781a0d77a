"""A gyro beside the wheels: turns that slip are corrected, and its own faults do no harm."""

import math

import numpy as np
import pytest
from scipy import stats

from impslam.columns import batches
from impslam.config import load
from impslam.types import Imu, WheelAngles

RADIUS, TRACK, RATE = 0.0635, 0.40, 100.0
STAND = 3.0  # s at the beginning


def drive(seconds=30.0, turn=0.4):
    """Body speeds (m, 2) of a robot that is stationary, then drives and turns to and fro."""
    t = np.arange(round(seconds * RATE)) / RATE
    moving = t >= STAND
    return np.column_stack([0.3 * moving, turn * np.sin(0.5 * (t - STAND)) * moving])


def log(speeds, wheels=None, rates=None, gyro_first=False):
    """(stream, message) of wheels that roll at body speeds (m, 2), and a gyro that measures `rates`."""
    v, w = (speeds if wheels is None else wheels).T
    rates = speeds[:, 1] if rates is None else rates
    left, right = (np.cumsum(v + side * 0.5 * TRACK * w) / RATE / RADIUS for side in (-1.0, 1.0))
    for k in range(len(v)):
        stamp = 50.0 + k / RATE
        turn = ("imu", Imu(stamp, np.array([0.0, 0.0, rates[k]]), np.zeros(3)))
        rolled = ("wheels", WheelAngles(stamp, float(left[k]), float(right[k])))
        yield from (turn, rolled) if gyro_first else (rolled, turn)


def corrected(messages, *settings, rows=512):
    """The robot of the preset `imp` and the motions of its odometry, by batches of `rows` rows."""
    robot = load("imp", ["odometry.jitter=0", "odometry.gyro.proven=false", *settings]).make_robot()
    found = []
    synchronise = robot._synchroniser.feed
    robot._synchroniser.feed = lambda order, motions, *rest: (
        found.append(motions),
        synchronise(order, motions, *rest),
    )[1]
    for batch in batches(messages, rows):
        list(robot.sense(batch))
    list(robot.flush())
    columns = [np.concatenate(column) for column in zip(*found, strict=True)]
    known = ~np.isnan(columns[1][:, 0])
    return robot, columns[1][known], columns[2][known]


def turned(d_pose):
    return float(d_pose[:, 2].sum())


def test_a_gyro_that_agrees_changes_no_turn():
    speeds = drive()
    for first in (False, True):
        robot, d_pose, covariance = corrected(log(speeds, gyro_first=first))
        _, alone, P = corrected(log(speeds), "odometry.gyro.use=false")
        assert robot._gyro.trusted
        np.testing.assert_allclose(d_pose.sum(axis=0), alone.sum(axis=0), atol=2e-3)
        assert covariance[:, 2, 2].sum() < 0.3 * P[:, 2, 2].sum()
        assert (np.linalg.eigvalsh(covariance)[:, 0] > -1e-18).all()
        assert robot.problems.counts == {}


def test_a_slipping_turn_is_that_of_the_gyro_and_is_reported():
    speeds = drive(turn=0.6)
    wheels = speeds * [1.0, 1.5]  # each turn looks half as long again
    wheels[:1000] = speeds[:1000]
    robot, d_pose, covariance = corrected(log(speeds, wheels), "odometry.gyro.proven=true")
    _, alone, P = corrected(log(speeds, wheels), "odometry.gyro.use=false")
    truth = np.abs(np.cumsum(speeds[1:, 1]) / RATE - np.cumsum(d_pose[:, 2])).max()
    assert truth < math.radians(3.0)
    assert np.abs(np.cumsum(speeds[1:, 1]) / RATE - np.cumsum(alone[:, 2])).max() > 0.4
    assert covariance[:, 0, 0].sum() > P[:, 0, 0].sum() + 0.5 * (0.5 * TRACK * 0.1) ** 2
    assert robot.problems.counts["wheel slip"] >= 2
    assert "the heading follows the gyro" in robot.problems.examples["wheel slip"]


def test_a_wheel_that_spins_alone_turns_nothing():
    speeds = np.zeros((1000, 2))
    spinning = speeds.copy()
    spinning[500:] = [0.15, 0.75]  # the right wheel alone
    robot, d_pose, _ = corrected(log(speeds, spinning), "odometry.gyro.proven=true")
    assert abs(turned(d_pose)) < math.radians(5.0)  # the wheels say 215
    assert robot.problems.counts["wheel slip"] >= 4


@pytest.mark.parametrize(
    ("scale", "says"), [(-1.0, "odometry.gyro.upside_down=true"), (180.0 / math.pi, "unit rad/s")]
)
def test_a_gyro_that_does_not_turn_as_the_wheels_is_not_used(scale, says):
    speeds = drive()
    robot, d_pose, _ = corrected(log(speeds, rates=scale * speeds[:, 1]))
    _, alone, _ = corrected(log(speeds), "odometry.gyro.use=false")
    np.testing.assert_array_equal(d_pose, alone)
    assert says in robot.problems.examples["gyro"]


def test_upside_down_inverts_the_gyro():
    speeds = drive()
    robot, _, _ = corrected(
        log(speeds, speeds * [1.0, 1.1], -speeds[:, 1]), "odometry.gyro.upside_down=true"
    )
    assert robot._gyro.trusted
    assert "gyro" not in robot.problems.counts


def test_silent_and_broken_readings_leave_the_wheels():
    speeds = drive()
    rates = speeds[:, 1].copy()
    rates[1000:1500] = np.nan
    _, d_pose, _ = corrected(log(speeds, rates=rates))
    _, alone, _ = corrected(log(speeds), "odometry.gyro.use=false")
    np.testing.assert_array_equal(d_pose[1030:1490], alone[1030:1490])
    np.testing.assert_allclose(d_pose.sum(axis=0), alone.sum(axis=0), atol=1e-2)


def test_a_robot_at_rest_stays_where_it_is():
    rng = np.random.default_rng(3)
    speeds = np.zeros((6000, 2))
    rates = 0.01 + rng.normal(0.0, 0.006, 6000)
    robot, d_pose, covariance = corrected(log(speeds, rates=rates), "odometry.gyro.proven=true")
    assert np.abs(d_pose).max() == 0.0
    assert covariance.max() == 0.0
    bias, sigma = robot._gyro.bias
    assert sigma < 2e-4
    assert abs(bias - 0.01) < 3.0 * sigma


def test_bias_and_heading_are_consistent():
    """NEES over 60 drives whose noise is that of the parameters (chi-square, 99.9 %)."""
    nees = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        speeds = drive(12.0)
        bias = rng.normal(0.0, 0.02)
        rates = speeds[:, 1] + bias + rng.normal(0.0, 6e-4 * math.sqrt(RATE), len(speeds))
        noise = rng.standard_normal((len(speeds), 2))
        v, w = np.abs(speeds).T
        turn = np.sqrt(0.01**2 * v + 0.05**2 * w + 2.0 * 0.01**2 * v / TRACK**2)
        wheels = speeds + np.column_stack([0.0 * v, turn * noise[:, 0] * math.sqrt(RATE)])
        robot, d_pose, covariance = corrected(
            log(speeds, wheels, rates), "odometry.gyro.proven=true"
        )
        error = turned(d_pose) - float(speeds[1:, 1].sum()) / RATE
        learned, sigma = robot._gyro.bias
        nees.append([error**2 / covariance[:, 2, 2].sum(), (learned - bias) ** 2 / sigma**2])
    low, high = stats.chi2.ppf([0.0005, 0.9995], 60) / 60
    heading, learned = np.mean(nees, axis=0)
    assert low < learned < high
    assert heading < high  # the error of the bias is taken to last for 20 s, these drives for 9


def test_corrected_turns_do_not_shorten_the_path():
    """With the noise of Eq. 3.19, the wheel that seems to travel farther has the larger error."""
    for seed in range(3):
        rng, speeds = np.random.default_rng(seed), drive(20.0, turn=0.0)
        noise = 0.01 * np.sqrt(np.abs(speeds[:, :1]) * RATE) * rng.standard_normal((len(speeds), 2))
        common, difference = noise.mean(axis=1), np.diff(noise, axis=1)[:, 0]
        wheels = speeds + np.column_stack([common, difference / TRACK])
        rates = rng.normal(0.0, 6e-4 * math.sqrt(RATE), len(speeds))
        _, d_pose, _ = corrected(log(speeds, wheels, rates), "odometry.gyro.proven=true")
        driven, measured = float(d_pose[:, 0].sum()), float(wheels[1:, 0].sum()) / RATE
        assert abs(driven - measured) < 1e-3 * measured


def test_heading_is_consistent_if_systematic_errors_are_considered():
    """NEES over 60 drives whose scale and bias are constant (chi-square, 99.9 %)."""
    nees = []
    for seed in range(60):
        rng, speeds = np.random.default_rng(seed), drive(8.0, turn=0.8)
        speeds[:, 1] = np.abs(speeds[:, 1])  # errors of the scale do not cancel
        noise = rng.normal(0.0, 6e-4 * math.sqrt(RATE), len(speeds))
        rates = (1.0 + rng.normal(0.0, 0.01)) * speeds[:, 1] + rng.normal(0.0, 0.02) + noise
        robot = load("imp", ["odometry.jitter=0"]).make_robot(for_estimator=True)
        d_pose, covariance, errors = zip(*motions_of(robot, log(speeds, rates=rates)), strict=True)
        error = sum(d[2] for d in d_pose) - float(speeds[1:, 1].sum()) / RATE
        common = np.sum(errors, axis=0)[2]
        nees.append(error**2 / (sum(P[2, 2] for P in covariance) + common @ common))
    low, high = stats.chi2.ppf([0.0005, 0.9995], 60) / 60
    assert low < np.mean(nees) < high


def motions_of(robot, messages):
    """Yield motions, their covariances, and their systematic errors (3, 4)."""
    found, synchronise = [], robot._synchroniser.feed

    def record(order, motions, *rest):
        errors = robot._turn_errors.at(order + 1)
        found.extend(zip(errors, *motions, strict=True))
        return synchronise(order, motions, *rest)

    robot._synchroniser.feed = record
    for batch in batches(messages):
        list(robot.sense(batch))
    for errors, _, d_pose, covariance, duration in found:
        if not np.isnan(d_pose[0]):
            yield d_pose, covariance, errors.errors(d_pose, duration)


def start(seed, ticks, stand):
    """(stream, message) of a start with `ticks` per turn, turning at once, and the bias of the gyro."""
    rng = np.random.default_rng(seed)
    t = np.arange(round((stand + 0.8) * RATE)) / RATE
    after = np.maximum(t - stand, 0.0)
    speeds = np.column_stack([0.5 * after, rng.choice([-2.0, 2.0]) * after])  # m/s^2, rad/s^2
    bias = rng.normal(0.0, 0.02)
    rates = speeds[:, 1] + bias + rng.normal(0.0, 6e-4 * math.sqrt(RATE), len(t))
    offsets = rng.uniform(0.0, 1.0, 2)
    step = 2.0 * math.pi / ticks
    messages = []
    for stream, m in log(speeds, rates=rates):
        if stream == "wheels":
            both = step * np.floor(np.array([m.left, m.right]) / step + offsets)
            messages.append((stream, WheelAngles(m.stamp, *map(float, both))))
        else:
            messages.append((stream, m))
    return messages, bias


@pytest.mark.parametrize(("ticks", "stand"), [(60, 0.97), (60, 1.97), (4096, 0.97), (60, 4.2)])
def test_turning_before_the_first_step_of_the_encoders_is_no_bias(ticks, stand):
    """NEES over 40 starts (chi-square, 99.9 %): coarse encoders hide the turn at the start."""
    nees, sigmas = [], []
    for seed in range(40):
        messages, bias = start(seed, ticks, stand)
        robot, _, _ = corrected(messages, "odometry.gyro.proven=true")
        learned, sigma = robot._gyro.bias
        nees.append((learned - bias) ** 2 / sigma**2)
        sigmas.append(sigma)
    assert np.mean(nees) < stats.chi2.ppf(0.9995, 40) / 40
    if ticks > 60:
        assert max(sigmas) < 3e-3  # a short standstill of fine encoders determines it
    elif stand > 4.0:
        assert max(sigmas) < 6e-4


@pytest.mark.parametrize("rows", [1, 7])
def test_cutting_the_log_changes_no_byte(rows):
    speeds = drive(8.0)
    messages = list(log(speeds, speeds * [1.0, 1.2], speeds[:, 1] + 0.01))
    whole = corrected(messages)[1:]
    for one, other in zip(whole, corrected(messages, rows=rows)[1:], strict=True):
        np.testing.assert_array_equal(one, other)


def test_the_first_slip_is_the_example_however_the_log_is_cut():
    speeds = drive(turn=0.6)
    wheels = speeds * [1.0, 1.5]
    wheels[:600] = speeds[:600]
    messages = list(log(speeds, wheels))
    setting = "odometry.gyro.proven=true"
    one, whole = (corrected(messages, setting, rows=rows)[0].problems for rows in (1, 8192))
    assert whole.counts["wheel slip"] >= 3
    assert whole.examples == one.examples
