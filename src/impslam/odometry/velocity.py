"""Odometry from commanded or reported velocities: forward speed and turn rate.

A velocity is valid from its stamp until the next one, so the body moves along an arc: the increment is
exp(dt [v, 0, omega]) in SE(2). A robot does not execute commands exactly: it reaches a commanded velocity
with a delay (`latency`), and settles at a fraction of it (`speed_scale`, `turn_scale`). Calibrate both.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from impslam.columns import Columns, Motions
from impslam.component import parameter, register
from impslam.geometry.se2 import exp
from impslam.noise import MotionNoise
from impslam.odometry.base import Odometry, diagonal, durations, gap_message, mask_unknown
from impslam.types import Mask, Velocity

_FIELDS = ("speed", "turn_rate")


@register("velocity")
class Velocities(Odometry):
    """Speed and turn rate, valid until the next reading."""

    consumes: ClassVar[type] = Velocity
    holds: ClassVar[bool] = True

    speed_scale: float = parameter(
        1.0, "1", "true speed over logged speed, from a calibration", gt=0
    )
    turn_scale: float = parameter(
        1.0, "1", "true turn rate over logged turn rate, from a calibration", gt=0
    )
    latency: float = parameter(
        0.0, "s", "delay from the stamp of a velocity until the robot reaches it", ge=0
    )
    noise: MotionNoise = parameter(MotionNoise(), "", "random error of this odometry")
    max_speed: float = parameter(10.0, "m/s", "a reading with a higher speed is ignored", gt=0)
    max_turn_rate: float = parameter(
        10.0, "rad/s", "a reading with a higher turn rate is ignored", gt=0
    )
    max_hold: float = parameter(2.0, "s", "after a longer gap the motion is unknown", gt=0)

    def usable(self, readings: Columns) -> Mask:
        """Return which velocities are finite and within the limits; see `Odometry.usable`."""
        slow = np.abs(readings["speed"]) <= self.max_speed  # false for NaN
        return np.asarray(slow & (np.abs(readings["turn_rate"]) <= self.max_turn_rate))

    def motions(self, readings: Columns) -> Motions:
        """Return the motions from each reading to the next; see `Odometry.motions`."""
        seconds, usable = durations(readings), self.usable(readings)
        speed, rate = (np.where(usable, readings[name], 0.0)[:-1] for name in _FIELDS)
        distances, turns = self.speed_scale * speed * seconds, self.turn_scale * rate * seconds
        covariance = diagonal(self.noise.variances(distances, turns))
        stamps = readings.stamps[1:] + self.latency
        motions = Motions(
            stamps,
            exp(np.column_stack((distances, np.zeros_like(distances), turns))),
            covariance,
            seconds,
        )
        return mask_unknown(motions, usable[:-1] & usable[1:] & (seconds <= self.max_hold))

    def fault(self, readings: Columns) -> str:
        """Describe the fault; see `Odometry.fault`."""
        if self.usable(readings)[-1]:
            return gap_message(readings, "velocity")
        speed, turn_rate, stamp = (float(readings[name][-1]) for name in (*_FIELDS, "stamp"))
        finite = math.isfinite(speed) and math.isfinite(turn_rate)
        return (
            f"velocity {speed:.3g} m/s and {turn_rate:.3g} rad/s at {stamp:.3f} s is "
            f"{'more than the robot can do' if finite else 'not finite'}; it is ignored: check the "
            "log, or raise odometry.max_speed or max_turn_rate"
        )
