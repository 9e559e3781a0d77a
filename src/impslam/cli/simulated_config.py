"""Describe a simulated robot as a config, with which its logs are mapped."""

from __future__ import annotations

from typing import Any

import tomli_w

from impslam.config import load, merge, read_table
from impslam.parameters import Parameters
from impslam.simulation.robot import SimulatedRobot

PRESET = "imp"
"""The config of the thesis's robot, which a `SimulatedRobot` is by default."""
CHOICES = ("tracker", "estimator", "association")
"""Tables of the preset that were chosen for its lidar; with another one, the default is safer."""
ENCODERS = {"wheel_radius": "wheel_radius", "track": "track"}
LIDAR = {
    "mount": "mount",
    "range_min": "range_min",
    "range_max": "range_max",
    "sigma": "sigma",
    "sigma_rate": "sigma_per_m",
    "bias_sigma": "bias",
}
"""Parameters of the simulated devices, and the keys of the config that describe them."""
NOISE = ("sigma", "sigma_rate", "bias_sigma")
"""Parameters whose value 0 switches a fault off, which a config does not do."""


def config_of(robot: SimulatedRobot) -> str:
    """Return the name of the preset of the thesis's robot, or a complete config of another one, as TOML.

    The config has what is known of a real robot: its dimensions, and the data sheet of its lidar.
    """
    usual = SimulatedRobot()
    odometry = _differences(robot.encoders, usual.encoders, ENCODERS)
    lidar = _differences(robot.lidar, usual.lidar, LIDAR)
    if not odometry and not lidar:
        return PRESET
    table = {"robot": "simulated", "odometry": odometry, "sensors": {"lidar": lidar}}
    below = read_table(PRESET)
    if lidar:
        default = read_table("default")
        below |= {name: default[name] for name in CHOICES}
    return tomli_w.dumps(load(merge(below, table)).resolved())


def _differences(
    device: Parameters | None, usual: Parameters | None, keys: dict[str, str]
) -> dict[str, Any]:
    """Return the values of a device that are not the usual ones, by the keys of the config."""
    if device is None or usual is None:
        return {}
    values, before = device.model_dump(mode="json"), usual.model_dump(mode="json")
    changed = [name for name in keys if values[name] != before[name]]
    return {keys[name]: values[name] for name in changed if values[name] or name not in NOISE}
