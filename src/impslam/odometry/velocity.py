"""Velocities, as a robot is commanded or reports them: speed forward and turn rate.

A velocity holds from its stamp until the next one, so that the body moves along an arc: the increment
is exp(dt [v, 0, omega]) in SE(2). What a robot is told is not what it does. Its drive gets up to speed
late and settles at a share of what was asked for; both are constants of a robot, to be calibrated.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from pydantic import PrivateAttr

from impslam.component import parameter, register
from impslam.errors import MessageError
from impslam.geometry.se2 import exp
from impslam.noise import MotionNoise
from impslam.odometry.base import Odometry, held_for
from impslam.types import Increment, Message, Velocity


@register("velocity")
class Velocities(Odometry):
    """Speed and turn rate, each of which holds until the next one."""

    consumes: ClassVar[type] = Velocity

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
    _last: Velocity | None = PrivateAttr(None)

    def update(self, message: Message) -> Increment | None:
        """Return the motion at the previous velocity until now; see `Odometry.update`."""
        assert isinstance(message, Velocity)
        last, self._last = self._last, None
        self._refuse_wild(message)
        self._last = message
        if last is None:
            return None
        duration = held_for(last.stamp, message.stamp, self.max_hold, "velocity")
        way = self.speed_scale * last.speed * duration
        turn = self.turn_scale * last.turn_rate * duration
        d_pose = exp(np.array([way, 0.0, turn]))
        covariance = self.noise.covariance(way, turn)
        return Increment(message.stamp + self.latency, d_pose, covariance, duration)

    def _refuse_wild(self, message: Velocity) -> None:
        # Comparisons with nan are false, so that it is refused too.
        if abs(message.speed) <= self.max_speed and abs(message.turn_rate) <= self.max_turn_rate:
            return
        said = f"{message.speed:.3g} m/s and {message.turn_rate:.3g} rad/s"
        finite = math.isfinite(message.speed) and math.isfinite(message.turn_rate)
        raise MessageError(
            f"velocity {said} at {message.stamp:.3f} s is "
            f"{'more than the robot can do' if finite else 'not finite'}; it is left out: check the "
            "log, or raise odometry.max_speed or max_turn_rate"
        )
