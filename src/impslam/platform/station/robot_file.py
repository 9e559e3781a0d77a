"""The robot file: the devices and limits of a robot, as TOML.

name = "imp-1"
preset = "imp"

[devices.autopilot]
kind = "autopilot"
port = "/dev/imp-autopilot"
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import ValidationError

from impslam import toml
from impslam.component import build, explain
from impslam.config import presets
from impslam.errors import ConfigError
from impslam.parameters import Parameters, parameter
from impslam.paths import read_text
from impslam.platform.devices.base import Device

Table = dict[str, Any]


class RobotFile(Parameters):
    """A robot's devices and its limits."""

    name: str = parameter("imp", "1", "the robot's name, on the page and in certificates")
    preset: str = parameter(
        "imp", "1", "preset of live mapping, or a config beside this file; stored in logs, too"
    )
    folder: Path = parameter(Path("logs"), "1", "where logs and maps are kept")
    max_speed: float = parameter(
        0.5, "m/s", "no command exceeds it: half of walking pace, stopped within 0.3 m", gt=0
    )
    max_turn_rate: float = parameter(
        1.0, "rad/s", "no command exceeds it: a scan of 0.1 s then smears by 6 deg", gt=0
    )
    min_free_disk_mb: int = parameter(
        500, "MB", "recording ends when less is free: a system without disk does not boot", ge=0
    )
    devices: dict[str, Table] = parameter({}, "1", "a table for each: its kind and parameters")

    def make_devices(self) -> dict[str, Device]:
        """Return the devices by name, not started."""
        return {
            name: build("device", {"label": name, **table}, f"devices.{name}")
            for name, table in self.devices.items()
        }


def load_robot(path: Path, *, virtual: bool = False) -> RobotFile:
    """Read a robot file. It names at least one device, unless the robot is virtual and has its own.

    Raises
    ------
    ConfigError
        In one line, with the key and what to do.
    """
    table = toml.parse(read_text(path, "give -c a robot file", ConfigError), str(path))
    try:
        robot = RobotFile(**table)
    except ValidationError as error:
        raise ConfigError(explain(error, str(path), RobotFile.model_fields)) from None
    if not (robot.devices or virtual):
        raise ConfigError(f"{path}: names no device; add a table such as [devices.lidar]")
    robot.make_devices()
    beside = path.absolute().parent / robot.preset
    if robot.preset not in presets() and beside.is_file():  # a service runs in another folder
        return robot.model_copy(update={"preset": str(beside)})
    return robot
