"""Velocities, as a robot is commanded or reports them: speed forward and turn rate.

A velocity holds from its stamp until the next one, so that the body moves along an arc: the increment
is exp(dt [v, 0, omega]) in SE(2). What a robot is told is not what it does. Its drive gets up to speed
late and settles at a share of what was asked for; both are constants of a robot, to be calibrated.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from impslam.columns import Columns, Motions
from impslam.component import parameter, register
from impslam.geometry.se2 import exp
from impslam.noise import MotionNoise
from impslam.odometry.base import Odometry, diagonal, durations, known, silence
from impslam.types import Mask, Velocity

_FIELDS = ("speed", "turn_rate")


@register("velocity")
class Velocities(Odometry):
    """Speed and turn rate, each of which holds until the next one."""

    consumes: ClassVar[type] = Velocity
    holds: ClassVar[bool] = True

    speed_scale: float = parameter(
        1.0, "1", "true speed over the one in the log, from a calibration", gt=0
    )
    turn_scale: float = parameter(
        1.0, "1", "true turn rate over the one in the log, from a calibration", gt=0
    )
    latency: float = parameter(
        0.0, "s", "how much later than it is stamped a velocity is reached", ge=0
    )
    noise: MotionNoise = parameter(MotionNoise(), "", "how far this odometry strays")
    max_speed: float = parameter(10.0, "m/s", "a velocity beyond this is refused", gt=0)
    max_turn_rate: float = parameter(10.0, "rad/s", "a turn rate beyond this is refused", gt=0)
    max_hold: float = parameter(
        2.0, "s", "after a longer silence it is not known whether a velocity held on", gt=0
    )

    def usable(self, readings: Columns) -> Mask:
        """Return which velocities are finite and within the limits; see `Odometry.usable`."""
        slow = np.abs(readings["speed"]) <= self.max_speed  # false for NaN
        return np.asarray(slow & (np.abs(readings["turn_rate"]) <= self.max_turn_rate))

    def motions(self, readings: Columns) -> Motions:
        """Return the motions at each velocity until the next; see `Odometry.motions`."""
        seconds, usable = durations(readings), self.usable(readings)
        speed, rate = (np.where(usable, readings[name], 0.0)[:-1] for name in _FIELDS)
        ways, turns = self.speed_scale * speed * seconds, self.turn_scale * rate * seconds
        covariance = diagonal(self.noise.variances(ways, turns))
        stamps = readings.stamps[1:] + self.latency
        motions = Motions(
            stamps, exp(np.column_stack((ways, np.zeros_like(ways), turns))), covariance, seconds
        )
        return known(motions, usable[:-1] & usable[1:] & (seconds <= self.max_hold))

    def fault(self, readings: Columns) -> str:
        """Say what is wrong; see `Odometry.fault`."""
        if self.usable(readings)[-1]:
            return silence(readings, "velocity")
        speed, turn_rate, stamp = (float(readings[name][-1]) for name in (*_FIELDS, "stamp"))
        finite = math.isfinite(speed) and math.isfinite(turn_rate)
        return (
            f"velocity {speed:.3g} m/s and {turn_rate:.3g} rad/s at {stamp:.3f} s is "
            f"{'more than the robot can do' if finite else 'not finite'}; it is left out: check the "
            "log, or raise odometry.max_speed or max_turn_rate"
        )
