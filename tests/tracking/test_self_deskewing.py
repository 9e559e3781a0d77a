"""Without odometry, sweeps are de-skewed by the tracked motion."""

from dataclasses import replace

import numpy as np
import pytest
from tests.extractors.scans import cast, room
from tests.tracking.sweeps import motions_of, sweeps_of

import impslam
from impslam.evaluation.trajectory import align
from impslam.geometry.angles import wrap
from impslam.geometry.se2 import compose
from impslam.noise import UNKNOWN
from impslam.sensors.deskewing import deskew_sweeps
from impslam.simulation.robot import Lidar, SimulatedRobot
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.sources.recording import McapWriter
from impslam.tracking.self_deskewing import deskew, set_twist, with_stamps
from impslam.types import Increment, LaserScan, TruePose

BEAMS, PERIOD = 360, 1.0 / 5.5
AFTER = (np.arange(BEAMS) / BEAMS - 0.5) * PERIOD
TWIST = np.array([0.5, 0.0, 1.0])


def sensed(twist):
    """Return end points, origins and directions of a sweep, as the sensor de-skews it with a twist."""
    ranges = 2.0 + np.sin(7.0 * np.linspace(-np.pi, np.pi, BEAMS))[None]
    beams = np.column_stack([np.linspace(-np.pi, np.pi, BEAMS), AFTER])
    limits, mount = np.array([1.0, 0.0, 0.0, 50.0]), np.array([0.2, 0.1, 0.3])
    seen = np.ones(BEAMS, np.bool_)
    parts = deskew_sweeps(ranges, beams, seen, twist[None], mount, limits, np.array([0.01, 0.0]))
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
    set_twist(np.array([0.1, 0.0, 0.2]), 0.0, AFTER, twist)
    np.testing.assert_allclose(twist, np.array([0.1, 0.0, 0.2]) / np.ptp(AFTER))
    set_twist(np.array([0.1, 0.0, 0.2]), 0.4, AFTER, twist)
    np.testing.assert_allclose(twist, np.array([0.25, 0.0, 0.5]))


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


def test_a_slow_lidar_alone_shows_turns_and_the_poses_at_its_stamps(tmp_path):
    """A sweep takes 0.18 s, in which the robot drives 5 cm and turns by up to 8 deg."""
    lidar = Lidar(
        beams=BEAMS,
        angle_min=-np.pi,
        angle_step=2.0 * np.pi / BEAMS,
        beam_time=PERIOD / BEAMS,
        rate=1.0 / PERIOD,
        mount=(0.0, 0.0, 0.0),
        range_max=12.0,
    )
    truth, log = {}, tmp_path / "slow.mcap"
    with McapWriter(log, "default") as writer:
        for message in simulate(
            load_world("arena"), SimulatedRobot(imu=None, encoders=None, lidar=lidar)
        ):
            if isinstance(message, LaserScan):
                writer.write(message)
            elif isinstance(message, TruePose):
                truth[round(message.stamp, 4)] = message.pose
    path = impslam.run(log, settings=["odometry.kind=lidar_only"]).path()
    true = np.array([truth[round(stamp, 4)] for stamp in path[:, 0]])
    found = compose(align(path[:, 1:3], true[:, :2]), path[:, 1:])
    off = np.hypot(*(found - true)[:, :2].T)
    assert np.sqrt(np.mean(off**2)) < 0.01
    assert np.abs(wrap(found[:, 2] - true[:, 2])).max() < np.radians(2.0)
