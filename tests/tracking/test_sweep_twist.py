"""Sweeps are de-skewed by the tracked motion: without odometry, and where wheels slip in turns."""

from dataclasses import replace

import numpy as np
import pytest
from tests.extractors.scans import cast, room
from tests.tracking.sweeps import motions_of, sweeps_of

import impslam
from impslam.evaluation.trajectory import align
from impslam.geometry.angles import wrap
from impslam.geometry.se2 import compose
from impslam.health import LOST
from impslam.noise import UNKNOWN
from impslam.sensors.deskewing import RangeCalibration, deskew_sweeps
from impslam.simulation.robot import Lidar, SimulatedRobot, WheelEncoders
from impslam.simulation.simulate import simulate
from impslam.simulation.world import World, load_world
from impslam.sources.recording import McapWriter
from impslam.studies.fault_scores import LiveRecorder
from impslam.tracking.sweep_twist import deskew, set_twist, with_stamps
from impslam.types import Increment, TruePose

BEAMS, PERIOD = 360, 1.0 / 5.5
AFTER = (np.arange(BEAMS) / BEAMS - 0.5) * PERIOD
TWIST = np.array([0.5, 0.0, 1.0])


def sensed(twist):
    """Return end points, origins and directions of a sweep, as the sensor de-skews it with a twist."""
    ranges = 2.0 + np.sin(7.0 * np.linspace(-np.pi, np.pi, BEAMS))[None]
    beams = np.column_stack([np.linspace(-np.pi, np.pi, BEAMS), AFTER])
    calibration, mount = RangeCalibration(1.0, 0.0, 0.0, 50.0, 0.01, 0.0), np.array([0.2, 0.1, 0.3])
    seen = np.ones(BEAMS, np.bool_)
    parts = deskew_sweeps(ranges, beams, seen, twist[None], mount, calibration)
    return parts[2][0], parts[4][0], parts[3][0]


@pytest.mark.parametrize("known", [np.zeros(3), np.array([0.3, 0.0, -0.5])])
def test_sweeps_are_moved_as_with_odometry(known):
    parts = sensed(known)
    deskew((*parts, AFTER), TWIST, known)
    for found, expected in zip(parts, sensed(TWIST), strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-4)
    assert np.abs(sensed(TWIST)[0] - sensed(known)[0]).max() > 0.1


def test_a_sweep_takes_no_longer_than_the_time_between_sweeps():
    """Stamps may stand still."""
    twist = np.empty(3)
    motion = np.array([0.1, 0.0, 0.2])
    set_twist(motion, motion, 0.0, AFTER, twist)
    np.testing.assert_allclose(twist, np.array([0.1, 0.0, 0.2]) / np.ptp(AFTER))
    set_twist(motion, motion, 0.4, AFTER, twist)
    np.testing.assert_allclose(twist, np.array([0.25, 0.0, 0.5]))


def test_the_twist_of_a_steadily_accelerating_robot_is_that_at_the_middle_of_the_sweep():
    """Middles at 0, 0.2 and 0.4 s, at which it turns by a t^2 / 2; the mean velocity lags by 0.1 s."""
    twist, acceleration = np.empty(3), np.array([0.5, 0.0, 3.0])
    first, second, third = (0.5 * acceleration * t**2 for t in (0.0, 0.2, 0.4))
    set_twist(third - second, second - first, 0.2, AFTER, twist)
    np.testing.assert_allclose(twist, 0.4 * acceleration)


def test_the_pose_at_a_stamp_is_as_certain_as_the_velocity():
    """It may change by 0.3 m/s and 0.6 rad/s from sweep to sweep; the first sweep has none."""
    scan, lag = cast(room(-3.0, 4.0, -2.5, 3.2)).scan, 0.05
    motions = motions_of(
        [Increment(0.1 * k, np.zeros(3), UNKNOWN * np.eye(3), 0.1 * (k > 0)) for k in range(3)]
    )
    sweeps = sweeps_of([scan] * 3, motions.stamps)
    late = sweeps.columns.with_stamps(motions.stamps + lag)
    scans = replace(sweeps.scans, after=np.linspace(-lag, lag, len(scan.ranges)))
    sweeps = replace(sweeps, columns=late, scans=scans, stamp_covariance=np.ones((3, 3, 3)))
    found = with_stamps(motions, sweeps, np.full((3, 3), 0.02))
    np.testing.assert_array_equal(found.stamp_covariance[0], 1.0)
    expected = np.square(lag * np.array([0.3, 0.3, 0.6]))
    for covariance in found.stamp_covariance[1:]:
        np.testing.assert_allclose(covariance, np.diag(expected), atol=1e-12)
    np.testing.assert_allclose(found.T_middle_stamp[1:], 0.01, atol=1e-12)


@pytest.mark.parametrize(
    ("moved", "expected"), [(0.4, -0.16), (0.49, -0.2), (2.0, -0.4), (-0.1, 0.0)]
)
def test_the_heading_at_a_stamp_follows_the_scans_in_turns(moved, expected):
    """Odometry turns by 0.5 rad, 0.2 of it between stamp and middle; 0.01 rad is an error of a match."""
    scan, turn = cast(room(-3.0, 4.0, -2.5, 3.2)).scan, np.array([0.0, 0.0, 0.5])
    motions = motions_of([Increment(0.1, turn, 1e-4 * np.eye(3), 0.1)])
    sweeps = sweeps_of([scan], motions.stamps)
    scans = replace(sweeps.scans, after=np.linspace(-0.04, 0.04, len(scan.ranges)))
    sweeps = replace(sweeps, scans=scans, T_middle_stamp=np.array([[-0.02, 0.0, -0.2]]))
    found = with_stamps(motions, sweeps, np.array([[0.0, 0.0, moved]]))
    np.testing.assert_allclose(found.T_middle_stamp, [[-0.02, 0.0, expected]], atol=1e-12)
    np.testing.assert_array_equal(found.stamp_covariance, sweeps.stamp_covariance)


def driven(folder, world, range_max=12.0, rate=1.0 / PERIOD, encoders=None):
    """Simulate a robot with a slow lidar, by default alone; return its log, and its true poses by stamp."""
    lidar = Lidar(
        beams=BEAMS,
        angle_min=-np.pi,
        angle_step=2.0 * np.pi / BEAMS,
        beam_time=1.0 / rate / BEAMS,
        rate=rate,
        mount=(0.0, 0.0, 0.0),
        range_max=range_max,
    )
    truth, log = {}, folder / "slow.mcap"
    with McapWriter(log, "default") as writer:
        for message in simulate(world, SimulatedRobot(imu=None, encoders=encoders, lidar=lidar)):
            if isinstance(message, TruePose):
                truth[round(message.stamp, 4)] = message.pose
            else:
                writer.write(message)
    return log, truth


def errors(path, truth):
    """Return the distance (n,) in m and angle (n,) in rad of a path (n, 4) from the truth, aligned."""
    true = np.array([truth[round(stamp, 4)] for stamp in path[:, 0]])
    found = compose(align(path[:, 1:3], true[:, :2]), path[:, 1:])
    return np.hypot(*(found - true)[:, :2].T), np.abs(wrap(found[:, 2] - true[:, 2]))


def test_a_slow_lidar_alone_shows_turns_and_the_poses_at_its_stamps(tmp_path):
    """A sweep takes 0.18 s, in which the robot drives 5 cm and turns by up to 8 deg."""
    log, truth = driven(tmp_path, load_world("arena"))
    path = impslam.run(log, settings=["odometry.kind=lidar_only"]).path()
    off, turned = errors(path, truth)
    assert np.sqrt(np.mean(off**2)) < 0.01
    assert turned.max() < np.radians(2.0)


def corridor():
    """Return a world with a ring of corridors, and a robot that turns fast at its corners."""
    robot = {
        "start": (0.0, 0.0, 0.0),
        "waypoints": [(12.0, 0.0), (12.0, 8.0), (0.0, 8.0), (0.0, 0.0)],
        "speed": 0.8,
        "turn_rate": 2.0,
        "turn_acceleration": 8.0,
        "lookahead": 0.25,
    }
    corners = [(-1.0, -1.0), (13.0, -1.0), (13.0, 9.0), (-1.0, 9.0)]
    ends = zip(corners, corners[1:] + corners[:1], strict=True)
    walls = [{"start": start, "end": end} for start, end in ends]
    core = {"centre": (6.0, 4.0), "size": (10.0, 6.0)}
    return World.model_validate({"walls": walls, "boxes": [core], "robot": robot})


def test_a_turn_that_begins_within_a_sweep_is_no_new_place(tmp_path):
    """The turn rate changes by up to 1.6 rad/s in a sweep of 0.2 s, and half of it may fit as before."""
    log, truth = driven(tmp_path, corridor(), range_max=8.0, rate=5.0)
    seen = LiveRecorder()
    path = impslam.run(log, settings=["odometry.kind=lidar_only"], observers=[seen]).path()
    assert (seen.outcome.health.states != LOST).all()
    assert errors(path, truth)[1].max() < np.radians(5.0)


@pytest.mark.parametrize("share", [0.75, 1.0, 1.3])
def test_sweeps_are_not_distorted_by_wheels_that_turn_more_or_less_than_the_robot(tmp_path, share):
    """At 2 rad/s, odometry that turns by three quarters of it distorts a sweep by 6 deg."""
    wheels = WheelEncoders.perfect(wheel_radius=0.05, track=0.4)
    log, truth = driven(tmp_path, corridor(), range_max=8.0, rate=5.0, encoders=wheels)
    settings = ["kind=encoders", "wheel_radius=0.05", f"track={0.4 / share}"]
    known = impslam.run(log, settings=[f"odometry.{setting}" for setting in settings])
    off, turned = errors(known.path(), truth)
    assert np.sqrt(np.mean(off**2)) < 0.008
    assert turned.max() < np.radians(1.5)
