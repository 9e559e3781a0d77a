"""What the checks rest on: the laser's own motion and odometry's, over the same stretches of time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from impslam.calibration.lidar_path import lidar_path
from impslam.calibration.recording import Recording, lidar_of
from impslam.columns import Columns
from impslam.config import Config
from impslam.diagnosis.agreement import FEWEST, Agreement, Axis, agreement, drive_axis
from impslam.diagnosis.timing import Timing, timing
from impslam.diagnosis.travel import Laser, Odometer, laser, odometer, stretches
from impslam.odometry.base import Odometry
from impslam.sensors.lidar2d import Lidar2D
from impslam.types import Array, Ints

HOLONOMIC = 0.1
"""Share of odometry's way that is sideways, from which on a robot is no wheeled one with an axle."""


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """A log as the checks see it.

    Attributes
    ----------
    config, name, lidar, odometry : the config, its first lidar with its name, its odometry
    recording : the rows of the log
    laser : motion by the lidar alone, with stamps as received
    timing : when scans were taken
    times : (k, 2) s, begin and end of stretches on the odometry's clock, where both are known
    moved, gone : (k, 3) twists over the stretches of the laser, and of base_link by odometry
    axis : direction in which the robot drives, from the laser; None where it cannot be told
    axle : (k, 2) m, rad: motion of the axle by the laser, ahead as the config has it, or else odometry
    agreement : how odometry relates to that; None where it cannot be told
    """

    config: Config
    name: str
    lidar: Lidar2D
    odometry: Odometry
    recording: Recording
    laser: Laser
    timing: Timing
    times: Array
    moved: Array
    gone: Array
    axis: Axis | None
    axle: Array
    agreement: Agreement | None

    @property
    def place(self) -> str:
        """The lidar's table in the config."""
        return f"sensors.{self.name}"

    @property
    def matches_scans(self) -> bool:
        """Whether a run follows the scans, and odometry is a guess only."""
        return self.config.make_tracker().matches_scans

    @property
    def goes(self) -> bool:
        """Whether odometry tells of any motion over the stretches."""
        return bool((np.abs(self.gone[:, [0, 2]]) > 1e-6).any())

    @property
    def is_mount_given(self) -> bool:
        """Whether the config, or the log for it, says where the laser is mounted."""
        return "mount" in self.config.sensors[self.name]


def evidence(config: Config, recording: Recording) -> Evidence:
    """Weigh a recording against a config that has a lidar."""
    robot = config.make_robot()
    name, lidar = lidar_of(config)
    motion = laser(lidar_path(lidar, recording.scans))
    counter = odometer(robot.odometry, recording.odometry if robot.odometry.measures_motion else ())
    when = timing(motion, counter, lidar)
    begins, ends = _known(motion, counter, when.stamps)
    times = np.column_stack((when.stamps[begins], when.stamps[ends]))
    sums = np.cumsum(motion.twists, axis=0)
    moved = sums[ends] - sums[begins]
    gone = counter.until(times[:, 1]) - counter.until(times[:, 0]) if len(times) else moved
    axis = _axis(moved, gone, lidar)
    axle, agreed = np.empty((0, 2)), None
    if axis is not None:
        axle = driven(moved, axis.angle)
        agreed = agreement(axle, gone)
        if agreed.is_astern:
            axis = axis.turned()
            axle = driven(moved, axis.angle)
            agreed = agreement(axle, gone)
    return Evidence(
        config, name, lidar, robot.odometry, recording, motion, when, times, moved, gone,
        axis, axle, agreed,
    )  # fmt: skip


def driven(moved: Array, angle: float) -> Array:
    """Return the motion (k, 2) m, rad along a beam angle, of the laser's twists (k, 3)."""
    return np.column_stack((moved[:, :2] @ [math.cos(angle), math.sin(angle)], moved[:, 2]))


def gone_by(odometry: Odometry, rows: Sequence[Columns], times: Array) -> Array:
    """Return how far (k, 3) another odometry would have the robot go over the stretches."""
    counter = odometer(odometry, rows)
    return counter.until(times[:, 1]) - counter.until(times[:, 0])


def _known(motion: Laser, counter: Odometer, stamps: Array) -> tuple[Ints, Ints]:
    begins, ends = stretches(motion)
    if not len(counter.stamps):
        return begins[:0], ends[:0]
    whole = counter.is_whole(stamps[begins], stamps[ends])
    return begins[whole], ends[whole]


def _axis(moved: Array, gone: Array, lidar: Lidar2D) -> Axis | None:
    """Return the axis in the sense that is nearer to that of the config."""
    sideways, forward = np.abs(gone[:, 1]).sum(), np.abs(gone[:, 0]).sum()
    if len(moved) < FEWEST or sideways > HOLONOMIC * forward + 0.1:
        return None
    axis = drive_axis(moved)
    expected = -lidar.mount[2]  # the beam angle that looks ahead
    if math.cos(axis.angle - expected) < 0.0:
        axis = axis.turned()
    return axis
