"""Assemble a virtual IMP from its setup."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Literal

import numpy as np

from impslam.parameters import Parameters, parameter
from impslam.platform.virtual.autopilot import AutopilotEmulator
from impslam.platform.virtual.base import Emulator
from impslam.platform.virtual.camera import CameraEmulator
from impslam.platform.virtual.gps import GpsEmulator
from impslam.platform.virtual.imp import VirtualImp
from impslam.platform.virtual.line import Line
from impslam.platform.virtual.pty_line import PtyLine
from impslam.platform.virtual.rplidar import A1, RPLidarEmulator
from impslam.platform.virtual.tcp_line import TcpLine
from impslam.platform.virtual.urg import UrgEmulator
from impslam.platform.virtual.wheel_speed import SpeedControl, SpeedController
from impslam.simulation.body import Body
from impslam.simulation.body_lidar import LidarSweeps
from impslam.simulation.robot import SimulatedRobot
from impslam.simulation.world import World

CLOCK_DRIFT = 30e-6  # 1, standard deviation: crystals are specified with 20 to 50 ppm
GPS_BAUD = 9600  # bit/s, of most receivers
AUTOPILOT_BAUD = 460800  # bit/s, see docs/autopilot-protocol.md


class Setup(Parameters):
    """The setup of a virtual IMP."""

    world: World
    robot: SimulatedRobot = SimulatedRobot()
    seed: int = parameter(0, "1", "of every random draw", ge=0)
    folder: Path = parameter(..., "", "where the pseudo-terminals' links are made")
    lidar: Literal["urg", "rplidar"] = parameter("urg", "", "which lidar it has")
    lidar_line: Literal["tcp", "pty"] = parameter("tcp", "", "connection of the lidar")
    autopilot_line: Literal["tcp", "pty"] = parameter(
        "tcp" if sys.platform == "win32" else "pty", "", "connection of the autopilot"
    )
    speed_control: bool = parameter(
        False,
        "",
        "whether the autopilot controls the wheels' speed; else commands go to the motor drivers",
    )
    camera: bool = parameter(True, "", "whether it has a camera")
    gps: bool = parameter(False, "", "whether it has a GNSS receiver, as under open sky")


def assemble(setup: Setup) -> VirtualImp:
    """Return a virtual IMP with open ports.

    Raises
    ------
    ConfigError
        If the robot cannot drive in the world.
    """
    streams = np.random.SeedSequence(setup.seed).spawn(8)
    seeds = [int(stream.generate_state(1)[0]) for stream in streams]
    body = Body(setup.world, setup.robot, setup.seed)
    drifts = CLOCK_DRIFT * np.random.default_rng(seeds[0]).standard_normal(2)
    emulators: dict[str, Emulator] = {
        "autopilot": AutopilotEmulator(
            body, drift=float(drifts[0]), seed=seeds[1], control=_controller(setup, body)
        ),
        "lidar": _lidar(setup, body, float(drifts[1]), seeds[2], seeds[3]),
    }
    lines: dict[str, Line] = {
        "autopilot": _line(
            setup.autopilot_line, setup.folder / "autopilot", seeds[4], AUTOPILOT_BAUD
        ),
        "lidar": _line(setup.lidar_line, setup.folder / "lidar", seeds[5]),
    }
    if setup.gps:
        emulators["gps"] = GpsEmulator(lambda: body.pose, seed=seeds[6])
        lines["gps"] = TcpLine(seed=seeds[7], baud=GPS_BAUD)
    imp = VirtualImp(body, emulators, lines)
    if setup.camera:
        imp.add_camera(CameraEmulator(body.scene, imp.pose, lambda: body.time))
    return imp


def _controller(setup: Setup, body: Body) -> SpeedController | None:
    """Return a controller for the body's motors, None without speed control."""
    if not setup.speed_control:
        return None
    train = body.drivetrain
    return SpeedController(
        SpeedControl(
            time_constant=train.time_constant,
            closed=0.5 * train.time_constant,
            feedback=2.0 * train.time_constant,
            top_speed=train.top_speed,
            acceleration=train.acceleration,
            skid=1.0 / train.turn_efficiency,
        )
    )


def _lidar(setup: Setup, body: Body, drift: float, seed: int, noise: int) -> Emulator:
    """Return the lidar's emulator; one sweep is computed here, so that the first one is not late."""
    body.advance(0.2)
    if setup.lidar == "rplidar":
        sweeps = LidarSweeps(body, noise, A1)
        sweeps.ranges(0.0)
        return RPLidarEmulator(sweeps, A1)
    sweeps = LidarSweeps(body, noise)
    sweeps.ranges(0.0)
    return UrgEmulator(sweeps, drift=drift, seed=seed)


def _line(kind: str, path: Path, seed: int, baud: int = 0) -> Line:
    return PtyLine(path, seed, baud) if kind == "pty" else TcpLine(seed=seed, baud=baud)
