"""The voltages of absolute encoders, as the robot logs them, are an odometry: they wrap once a turn."""

import numpy as np
import pytest

from impslam.cli.simulate import load_robot
from impslam.run import run
from impslam.simulation.simulate import simulate
from impslam.simulation.world import load_world
from impslam.sources.base import recognise
from impslam.sources.recording import McapWriter
from impslam.types import EncoderVoltages, WheelAngles

SETTINGS = [
    "odometry.stream=/encoders/voltage",
    "odometry.per_turn=5.0",
    "odometry.wrap=5.0",
    "odometry.jitter=0.0",
    "odometry.gyro.use=false",
]


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("voltages") / "room.mcap"
    robot = load_robot(settings=["encoders.voltages=true", "imu=none"])
    with McapWriter(path, "imp") as writer:
        for message in simulate(load_world("room"), robot, 3):
            writer.write(message)
    return path


def test_voltages_match_the_angles():
    robot = load_robot(settings=["encoders.voltages=true", "lidar=none", "imu=none"])
    told = list(simulate(load_world("room"), robot, 3))
    angles = np.array([(m.left, m.right) for m in told if isinstance(m, WheelAngles)])
    volts = np.array([(m.left, m.right) for m in told if isinstance(m, EncoderVoltages)])
    assert len(volts) == len(angles)
    assert volts.min() >= 0.0
    assert volts.max() < 5.0
    assert (np.abs(np.diff(volts, axis=0)) > 2.5).sum() > 5  # they wrap
    np.testing.assert_allclose(np.exp(1j * angles), np.exp(2j * np.pi * volts / 5.0), atol=1e-9)


def test_dead_reckoning_is_that_of_the_angles(log):
    ways = []
    for settings in (["odometry.jitter=0.0", "odometry.gyro.use=false"], SETTINGS):
        known = run(log, "imp", settings)
        ways.append(known.rows().odometry)
    assert np.ptp(ways[0][:, :2]) > 1.0
    np.testing.assert_allclose(ways[1], ways[0], atol=1e-6)


def test_a_vector_topic_is_not_used_for_wheels_by_default(log):
    with recognise(log)(path=log) as source:
        used = {stream.name for stream in source.streams() if stream.used}
    assert "/encoders/voltage" not in used
