"""A robot that stands for ten minutes stays where it is, and is as sure of it at the end as before."""

import math

import numpy as np
import pytest
from tests.odometry.test_standstill import read

from impslam.config import load
from impslam.run import Run
from impslam.simulation.lidar import LidarSimulator
from impslam.simulation.robot import Lidar
from impslam.simulation.scene import Scene
from impslam.simulation.world import load_world
from impslam.types import LaserScan, WheelAngles

SECONDS = 600


class Standing:
    """A way on which nothing moves."""

    def at(self, times):
        return np.tile(np.asarray(load_world("room").robot.start), (len(times), 1))


@pytest.fixture
def messages():
    """Trembling encoders at 100 Hz, and scans at 10 Hz with the noise of each beam."""
    device = Lidar.perfect()
    lidar = LidarSimulator(device, Scene(load_world("room")), Standing(), np.random.default_rng(0))
    ranges, rng = lidar.ranges(0.0), np.random.default_rng(1)
    sigma = np.where(ranges > 0.0, 0.003 + 0.003 * ranges, 0.0)
    left, right = read(np.zeros(100 * SECONDS))
    wheels = [WheelAngles(0.01 * k, *both) for k, both in enumerate(zip(left, right, strict=True))]
    scans = [
        LaserScan(
            0.1 * k + 0.005,
            lidar.angles,
            ranges + sigma * rng.standard_normal(len(ranges)),
            lidar.time_offsets,
            *lidar.limits,
        )
        for k in range(10 * SECONDS - 10)
    ]
    return sorted([*wheels, *scans], key=lambda message: message.stamp)


def test_ten_minutes_at_rest_with_a_lidar(messages):
    rows = Run(load("imp", ["odometry.gyro.use=false"])).play(messages).rows()
    assert len(rows.stamps) > 5900
    off = rows.poses - rows.poses[0]
    assert np.hypot(*off[:, :2].T).max() < 1e-3
    assert np.abs(off[:, 2]).max() < math.radians(0.05)
    sigma = np.sqrt(np.diagonal(rows.covariances, axis1=1, axis2=2))
    assert (sigma[-1] <= 1.01 * sigma[10] + 1e-9).all()
