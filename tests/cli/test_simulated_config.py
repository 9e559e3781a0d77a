"""A simulated log carries the config of its robot."""

import pytest

from impslam.cli.simulated_config import LIDAR, PRESET, config_of
from impslam.config import load
from impslam.simulation.robot import Lidar, SimulatedRobot, WheelEncoders
from impslam.toml import parse


def test_the_robot_of_the_thesis_has_its_preset():
    assert config_of(SimulatedRobot()) == PRESET
    assert (
        config_of(SimulatedRobot(lidar=Lidar(rate=5.0, beams=360))) == PRESET
    )  # as in its messages


def test_another_robot_is_described_by_its_dimensions_and_data_sheet():
    lidar = {"mount": (0.05, 0.0, 0.1), "range_min": 0.15, "range_max": 8.0}
    noise = {"sigma": 0.02, "sigma_rate": 0.001, "bias_sigma": 0.01}
    robot = SimulatedRobot(encoders=WheelEncoders(track=0.3), lidar=Lidar(**lidar, **noise))
    table = parse(config_of(robot), "the log")
    described = load(table).make_robot()
    assert described.odometry.track == 0.3
    assert described.odometry.wheel_radius == WheelEncoders().wheel_radius
    assert table["robot"] == "simulated"
    for name, key in LIDAR.items():
        assert getattr(described.sensors["lidar"], key) == pytest.approx({**lidar, **noise}[name])
    assert table["estimator"]["kind"] == "graph"


@pytest.mark.parametrize(
    "robot", [SimulatedRobot.perfect(), SimulatedRobot(lidar=None, encoders=None)]
)
def test_devices_without_faults_and_missing_ones_leave_a_valid_config(robot):
    described = config_of(robot)
    if described != PRESET:
        load(parse(described, "the log")).make_robot()
