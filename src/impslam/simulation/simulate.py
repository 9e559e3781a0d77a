"""Simulates a run in a world: all messages of a log, and the ground truth."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator

import numpy as np

from impslam.simulation.drive import Trajectory, drive
from impslam.simulation.lidar import LidarSimulator
from impslam.simulation.noise import inertial, wheel_angles
from impslam.simulation.robot import InertialUnit, OnboardCamera, SimulatedRobot, WheelEncoders
from impslam.simulation.scene import Scene
from impslam.simulation.world import World
from impslam.types import (
    Array,
    EncoderVoltages,
    Image,
    Imu,
    LaserScan,
    Message,
    TruePose,
    WheelAngles,
)

VOLTS = 5.0  # V per turn of an MA3 (thesis 3.3.1)
Timed = tuple[float, Message]


def simulate(world: World, robot: SimulatedRobot | None = None, seed: int = 0) -> Iterator[Message]:
    """Yield the messages of a run lazily, in order of arrival.

    A scan has the stamp of its first beam and arrives after its last one, so that wheel and inertial
    readings during the sweep precede it. There is a `TruePose` at every `truth_rate` tick and at every scan
    stamp. Equal worlds, robots and seeds give equal messages.

    Parameters
    ----------
    world : the world, with the robot's drive in it
    robot : default `SimulatedRobot()`; `SimulatedRobot.perfect()` for exact readings
    seed : seed of all random draws; each device has its own stream
    """
    robot = robot or SimulatedRobot()
    trajectory = drive(world.robot)
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(3)]
    start = robot.start_time
    sources: list[Iterator[Timed]] = [_truth(robot, trajectory)]
    if robot.encoders is not None:
        sources.append(_wheels(robot.encoders, trajectory, streams[0], start))
    if robot.imu is not None:
        sources.append(_imu(robot.imu, trajectory, streams[1], start))
    if robot.lidar is not None:
        lidar = LidarSimulator(robot.lidar, Scene(world), trajectory, streams[2])
        sources.append(_scans(lidar, sweep_times(robot, trajectory), start))
    if robot.camera is not None:
        sources.append(_pictures(robot.camera, Scene(world), trajectory, start))
    for _, message in heapq.merge(*sources, key=lambda timed: timed[0]):
        yield message


def ticks(rate: float, duration: float) -> Array:
    """Return the times k / rate (k = 0, 1, ...) up to a duration, in s.

    They are computed by division, so that equal times at different rates are equal numbers.
    """
    return np.arange(int(np.floor(duration * rate + 1e-9)) + 1) / rate


def sweep_times(robot: SimulatedRobot, trajectory: Trajectory) -> Array:
    """Return the begin times of the sweeps that end within the run, s from its start."""
    if robot.lidar is None:
        return np.empty(0)
    last = trajectory.duration - robot.lidar.beam_time * (robot.lidar.beams - 1)
    return ticks(robot.lidar.rate, last)


def _truth(robot: SimulatedRobot, trajectory: Trajectory) -> Iterator[Timed]:
    regular = ticks(robot.truth_rate, trajectory.duration)
    times = np.union1d(regular, sweep_times(robot, trajectory))
    for time, pose in zip(times.tolist(), trajectory.at(times), strict=True):
        yield time, TruePose(robot.start_time + time, pose)


def _wheels(
    encoders: WheelEncoders, trajectory: Trajectory, rng: np.random.Generator, start: float
) -> Iterator[Timed]:
    times = ticks(encoders.rate, trajectory.duration)
    angles = wheel_angles(encoders, trajectory, times, rng)
    for time, (left, right) in zip(times.tolist(), angles.tolist(), strict=True):
        yield time, WheelAngles(start + time, left, right)
        if encoders.voltages:
            volts = [VOLTS * (angle / (2.0 * math.pi) % 1.0) for angle in (left, right)]
            yield time, EncoderVoltages(start + time, *volts)


def _imu(
    unit: InertialUnit, trajectory: Trajectory, rng: np.random.Generator, start: float
) -> Iterator[Timed]:
    times = ticks(unit.rate, trajectory.duration)
    rates, forces = inertial(unit, trajectory, times, rng)
    for time, rate, force in zip(times.tolist(), rates, forces, strict=True):
        yield time, Imu(start + time, rate, force)


def _pictures(
    camera: OnboardCamera, scene: Scene, trajectory: Trajectory, start: float
) -> Iterator[Timed]:
    from impslam.simulation.camera import Lens, SceneCamera  # noqa: PLC0415  OpenCV, rarely needed

    focal = 0.5 * camera.width / math.tan(0.5 * camera.field)
    lens = Lens(camera.width, camera.height, focal, camera.above_floor, camera.forward)
    seen = SceneCamera(scene, lens, camera.quality)
    times = ticks(camera.rate, trajectory.duration)
    for time, pose in zip(times.tolist(), trajectory.at(times), strict=True):
        yield time, Image(start + time, "jpeg", seen.jpeg(pose, time))


def _scans(lidar: LidarSimulator, times: Array, start: float) -> Iterator[Timed]:
    limits = lidar.limits
    for time in times.tolist():
        scan = LaserScan(
            start + time, lidar.angles, lidar.ranges(time), lidar.time_offsets, *limits
        )
        yield time + lidar.duration, scan
