"""The commands and files of the guide work."""

import re
import tomllib
from pathlib import Path

import pytest

from impslam.cli.app import make_app
from impslam.component import build
from impslam.config import load
from impslam.platform.devices.base import DriveDevice
from impslam.platform.station.robot_file import load_robot

GUIDE = Path(__file__).parents[3] / "docs" / "robot-guide.md"


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", GUIDE.read_text("utf-8"), re.DOTALL)


def test_the_robot_file_makes_its_devices(tmp_path):
    file = tmp_path / "robot.toml"
    file.write_text(blocks("toml")[0], "utf-8")
    devices = load_robot(file).make_devices()
    assert set(devices) == {"autopilot", "lidar", "camera", "gps"}
    assert isinstance(devices["autopilot"], DriveDevice)


def test_the_measured_config_loads(tmp_path):
    file = tmp_path / "imp-1.toml"
    text = blocks("toml")[1]
    file.write_text(text, "utf-8")
    config = load(str(file), ["sensors.lidar.range_min=0.15", "sensors.lidar.range_max=12.0"])
    written = tomllib.loads(text)
    wheels = build("odometry", config.odometry)
    assert (wheels.track, wheels.wheel_radius) == (
        written["odometry"]["track"],
        written["odometry"]["wheel_radius"],
    )
    lidar = build("sensor", config.sensors["lidar"])
    assert list(lidar.mount) == written["sensors"]["lidar"]["mount"]
    assert lidar.range_max == 12.0  # as for an RPLidar


COMMANDS = [
    line.split("#")[0].split("|")[0].strip()
    for block in blocks("sh")
    for line in block.splitlines()
    if line.startswith("imp ")
]


@pytest.mark.parametrize("command", [*COMMANDS, "imp robot --virtual"])
def test_its_commands_are_valid(command):
    make_app().parse_args(command.removeprefix("imp "), exit_on_error=False, print_error=False)


def test_its_links_are_valid():
    linked = re.findall(r"\]\(([^)#:]+)\)", GUIDE.read_text("utf-8"))
    assert linked
    for link in set(linked):
        assert (GUIDE.parent / link).exists(), link
