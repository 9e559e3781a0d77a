"""Odometry of a car from the speed of one wheel and the steering angle (the bicycle model).

With wheelbase L the middle of the rear axle moves at speed v along an arc of curvature tan(s)/L, where
s is the angle of a single front wheel in the middle. The encoder is at a rear wheel, which moves along
another arc: at a distance H to the left of the middle it rolls at v (1 - H tan(s)/L) (Guivant and Nebot
2001, Eq. 27). Over dt the axle moves by exp([v dt, 0, v dt tan(s)/L]) in SE(2).

base_link may be elsewhere on the body, e.g. at a GPS antenna, and then moves sideways in turns. With t
the position of the axle in base_link, an increment [p, a] of the axle is [p + t - R(a) t, a] in base_link.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from impslam.columns import Columns, Motions
from impslam.component import parameter, register
from impslam.noise import MotionNoise
from impslam.odometry.base import Odometry, durations, gap_message, mask_unknown
from impslam.odometry.kernels import axle_motions, carry
from impslam.types import Mask, Steering

_FIELDS = ("speed", "angle")


@register("ackermann")
class Ackermann(Odometry):
    """Wheel speed and steering angle of a car, valid until the next reading."""

    consumes: ClassVar[type] = Steering
    holds: ClassVar[bool] = True

    wheelbase: float = parameter(..., "m", "distance from the rear to the front axle", gt=0)
    encoder_offset: float = parameter(
        0.0,
        "m",
        "distance of the measured wheel from the middle of the rear axle, positive to the left",
    )
    axle: tuple[float, float] = parameter(
        (0.0, 0.0), "m", "position [x, y] of the middle of the rear axle in base_link"
    )
    speed_scale: float = parameter(
        1.0, "1", "true speed over logged speed, from a calibration", gt=0
    )
    steering_scale: float = parameter(
        1.0, "1", "true steering angle over logged angle, from a calibration", gt=0
    )
    steering_offset: float = parameter(
        0.0, "rad", "added to the scaled steering angle, from a calibration"
    )
    noise: MotionNoise = parameter(
        MotionNoise(forward=0.05, sideways=0.03, turn_per_distance=0.01, turn_per_turn=0.05),
        "",
        "random error of the rear axle: tyre radii and slip, slip angle, play of the steering "
        "(0.5 deg on a wheelbase of 3 m for some 10 m), a wrong wheelbase",
    )
    max_speed: float = parameter(30.0, "m/s", "a reading with a higher speed is ignored", gt=0)
    max_angle: float = parameter(
        0.9, "rad", "a reading with a larger steering angle is ignored", gt=0, lt=1.5
    )
    max_hold: float = parameter(2.0, "s", "after a longer gap the motion is unknown", gt=0)

    def usable(self, readings: Columns) -> Mask:
        """Return which readings are finite and within the limits; see `Odometry.usable`."""
        slow = np.abs(readings["speed"]) <= self.max_speed  # false for NaN
        return np.asarray(slow & (np.abs(readings["angle"]) <= self.max_angle))

    def motions(self, readings: Columns) -> Motions:
        """Return the motions from each reading to the next; see `Odometry.motions`."""
        seconds, usable = durations(readings), self.usable(readings)
        speed, angle = (np.where(usable, readings[name], 0.0)[:-1] for name in _FIELDS)
        travel = self.speed_scale * speed * seconds
        angles = self.steering_scale * angle + self.steering_offset
        d_axle = axle_motions(travel, angles, self.wheelbase, self.encoder_offset)
        variances = self.noise.variances(np.hypot(d_axle[:, 0], d_axle[:, 1]), d_axle[:, 2])
        d_pose, covariance = carry(d_axle, variances, np.array(self.axle))
        motions = Motions(readings.stamps[1:], d_pose, covariance, seconds)
        return mask_unknown(motions, usable[:-1] & usable[1:] & (seconds <= self.max_hold))

    def fault(self, readings: Columns) -> str:
        """Describe the fault; see `Odometry.fault`."""
        if self.usable(readings)[-1]:
            return gap_message(readings, "speed and steering")
        speed, angle, stamp = (float(readings[name][-1]) for name in (*_FIELDS, "stamp"))
        finite = math.isfinite(speed) and math.isfinite(angle)
        return (
            f"speed {speed:.3g} m/s and steering {angle:.3g} rad at {stamp:.3f} s are "
            f"{'more than a car can do' if finite else 'not finite'}; they are ignored: check the "
            "log, or raise odometry.max_speed or max_angle"
        )
