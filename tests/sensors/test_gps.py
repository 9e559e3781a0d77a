"""A GPS corrects a path that drifts, in a frame that it finds itself, and outliers are left out."""

import math

import numpy as np
import pytest

from impslam.columns import Sweeps, batches
from impslam.config import load
from impslam.errors import ConfigError
from impslam.geometry.se2 import compose, inverse, transform
from impslam.run import Run
from impslam.sensors.gps import Gps
from impslam.types import Fix, Velocity

SETTINGS = (
    'odometry.kind="velocity"',
    'sensors.lidar.kind="none"',
    'sensors.gps.kind="gps"',
    "sensors.gps.sigma=0.5",
    'tracker.kind="odometry"',
    'estimator.kind="landmarks"',
    "keyframes.distance=1.0",
)
SPEED, TURN, DRIFT, STEP = 2.0, 0.1, 0.003, 0.1  # m/s, rad/s, rad/s of gyro bias, s
T_MAP_EAST = np.array([40.0, -25.0, 2.3])
SIGMA, TIME = 0.5, 240.0


def drive(rng, outliers=False, antenna=(0.0, 0.0)):
    """Return wheels that turn too far, fixes of the true way in a frame of its own, and the way."""
    times = np.arange(0.0, TIME, STEP)
    pose, poses, messages = np.zeros(3), [], []
    for k, time in enumerate(times.tolist()):
        turn = TURN * math.sin(0.05 * time)
        messages.append(Velocity(time, SPEED, turn + DRIFT))
        if k % 10 == 5:
            place = transform(pose, np.array(antenna))
            fix = transform(inverse(T_MAP_EAST), place) + SIGMA * rng.standard_normal(2)
            if outliers and k % 50 == 5 and k > 300:
                fix += 40.0
            messages.append(Fix(time, fix, np.full((2, 2), math.nan)))
        poses.append([time, *pose])
        pose = compose(pose, np.array([SPEED * STEP, 0.0, turn * STEP]))
    return messages, np.array(poses)


def mapped(messages, *settings):
    """Return the rows of the path, and the frame that was found."""
    known = Run(load("default", [*SETTINGS, *settings])).play(messages)
    (frame,) = (mark for mark in known.landmarks if mark.kind == "gps")
    return known.rows(), frame


def errors(rows, truth, T_map_east):
    """Return the errors (n,) m of a path in the frame of the fixes."""
    true = np.column_stack([np.interp(rows.stamps, truth[:, 0], truth[:, i]) for i in (1, 2)])
    places = transform(inverse(T_map_east), rows.poses[:, :2])
    return np.hypot(*(places - transform(inverse(T_MAP_EAST), true)).T)


@pytest.mark.parametrize("outliers", [False, True])
def test_fixes_bound_the_error_of_wheels_that_drift(outliers, rng):
    messages, truth = drive(rng, outliers)
    rows, frame = mapped(messages)
    found = errors(rows, truth, np.array([*frame.position, frame.parameters["yaw"]]))
    wheels = np.hypot(*(rows.odometry[-1] - truth[-1, 1:])[:2])
    assert wheels > 20.0
    assert found[-1] < 1.5
    assert np.median(found) < 1.5
    assert frame.observations > 180


def test_an_antenna_elsewhere_on_the_robot_is_taken_into_account(rng):
    """Ten times as far as the noise of the mean: taken for base_link the path is a lever too long."""
    antenna = (4.0, -3.0)
    messages, truth = drive(rng, antenna=antenna)
    off = {}
    for where in (antenna, (0.0, 0.0)):
        rows, frame = mapped(messages, f"landmarks.gps.antenna={list(where)}")
        found = errors(rows, truth, np.array([*frame.position, frame.parameters["yaw"]]))
        off[where] = np.median(found)
    assert off[antenna] < 1.5
    assert off[(0.0, 0.0)] > 2.5


def test_estimators_that_cannot_use_it_say_so_at_once():
    with pytest.raises(ConfigError, match=r"sensors\.gps: .*estimator\.kind=landmarks"):
        Run(load("default", ['sensors.gps.kind="gps"']))


def test_without_a_course_nothing_is_observed():
    fixes = [Fix(float(k), np.array([0.5 * k, 0.0]), np.full((2, 2), math.nan)) for k in range(5)]
    wheels = [Velocity(0.1 * k, 0.5, 0.0) for k in range(60)]
    messages = sorted([*fixes, *wheels], key=lambda message: message.stamp)
    known = Run(load("default", SETTINGS)).play(messages)
    assert not known.landmarks


def test_the_course_depends_on_earlier_fixes_of_the_log_only():
    """Also if a clock is set back: then later fixes have earlier stamps."""
    stamps = np.append(1000.0 + np.arange(40.0), 900.0 + np.arange(40.0))
    messages = [
        Fix(stamp, np.array([2.0 * k, 0.05 * k**2]), np.full((2, 2), math.nan))
        for k, stamp in enumerate(stamps.tolist())
    ]
    found = []
    for size in (1, 512):
        gps, observed = Gps(), []
        for part in batches([("gps", message) for message in messages], size):
            (columns,) = part.values()
            gps.spans(columns)
            sweeps = Sweeps("gps", columns, *[np.zeros(0)] * 4, None)
            observed += [
                gps.observe(sweeps, k, np.random.default_rng()) for k in range(len(columns))
            ]
        found.append([[o.attributes for o in row] for row in observed])
    assert found[0] == found[1]
    assert sum(map(bool, found[0])) > 60
