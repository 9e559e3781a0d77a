"""A car: the speed of one wheel and the steering angle (the bicycle model).

With wheelbase L the middle of the rear axle goes at speed v along an arc of curvature tan(s)/L, s
being the angle of a single front wheel in the middle. The encoder sits at a rear wheel, which goes on
another arc: at a distance H to the left of the middle it rolls at v (1 - H tan(s)/L) (Guivant and Nebot
2001, Eq. 27). Over dt the axle moves by exp([v dt, 0, v dt tan(s)/L]) in SE(2).

base_link may be elsewhere on the body, at the antenna of a GPS for instance, and then swings round the
axle in turns: with t the place of the axle on base_link, the increment is [p + t - R(a) t, a] for that
of the axle, [p, a].
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
from impslam.types import Array, Increment, Message, Steering


def bicycle(wheel_travel: float, angle: float, wheelbase: float, offset: float) -> Array:
    """Return the rear axle's increment (3,) from a rear wheel's travel (m) and the steering (rad)."""
    curvature = math.tan(angle) / wheelbase
    way = wheel_travel / (1.0 - offset * curvature)
    return exp(np.array([way, 0.0, way * curvature]))


def carried(d_axle: Array, axle: Array) -> tuple[Array, Array]:
    """Return the increment (3,) of base_link from that of the axle at `axle` (2,) on it.

    The second value is its Jacobian (3, 3) by the axle's increment.
    """
    c, s = math.cos(d_axle[2]), math.sin(d_axle[2])
    x, y = axle
    turned = np.array([c * x - s * y, s * x + c * y])
    d_base = np.array([*(d_axle[:2] + axle - turned), d_axle[2]])
    d_base_D_d_axle = np.array([[1.0, 0.0, turned[1]], [0.0, 1.0, -turned[0]], [0.0, 0.0, 1.0]])
    return d_base, d_base_D_d_axle


@register("ackermann")
class Ackermann(Odometry):
    """A car's wheel speed and steering angle, each of which holds until the next one."""

    consumes: ClassVar[type] = Steering

    wheelbase: float = parameter(..., "m", "from the rear to the front axle", gt=0)
    encoder_offset: float = parameter(
        0.0, "m", "how far left of the middle of the rear axle the measured wheel runs"
    )
    axle: tuple[float, float] = parameter(
        (0.0, 0.0), "m", "place [x, y] of the middle of the rear axle on base_link"
    )
    speed_scale: float = parameter(
        1.0, "1", "true speed over the one in the log, from a calibration", gt=0
    )
    steering_scale: float = parameter(
        1.0, "1", "true steering angle over the one in the log, from a calibration", gt=0
    )
    steering_offset: float = parameter(
        0.0, "rad", "added to the scaled steering angle, from a calibration"
    )
    noise: MotionNoise = parameter(
        MotionNoise(forward=0.05, sideways=0.03, turn_per_distance=0.01, turn_per_turn=0.05),
        "",
        "how far the rear axle strays: tyres' radii and slip, slip angle, play of the steering "
        "(0.5 deg on a wheelbase of 3 m for some 10 m), a wrong wheelbase",
    )
    max_speed: float = parameter(30.0, "m/s", "a speed beyond this is refused", gt=0)
    max_angle: float = parameter(
        0.9, "rad", "a steering angle beyond this, more than cars can do, is refused", gt=0, lt=1.5
    )
    max_hold: float = parameter(
        2.0, "s", "after a longer silence it is not known whether speed and steering held on", gt=0
    )
    _last: Steering | None = PrivateAttr(None)

    def update(self, message: Message) -> Increment | None:
        """Return the motion at the previous speed and steering until now; see `Odometry.update`."""
        assert isinstance(message, Steering)
        last, self._last = self._last, None
        self._refuse_wild(message)
        self._last = message
        if last is None:
            return None
        duration = held_for(last.stamp, message.stamp, self.max_hold, "speed and steering")
        angle = self.steering_scale * last.angle + self.steering_offset
        travel = self.speed_scale * last.speed * duration
        d_axle = bicycle(travel, angle, self.wheelbase, self.encoder_offset)
        d_pose, J = carried(d_axle, np.array(self.axle))
        Q = self.noise.covariance(math.hypot(d_axle[0], d_axle[1]), float(d_axle[2]))
        return Increment(message.stamp, d_pose, J @ Q @ J.T, duration)

    def _refuse_wild(self, message: Steering) -> None:
        # Comparisons with nan are false, so that it is refused too.
        if abs(message.speed) <= self.max_speed and abs(message.angle) <= self.max_angle:
            return
        finite = math.isfinite(message.speed) and math.isfinite(message.angle)
        raise MessageError(
            f"speed {message.speed:.3g} m/s and steering {message.angle:.3g} rad at "
            f"{message.stamp:.3f} s are {'more than a car can do' if finite else 'not finite'}; they "
            "are left out: check the log, or raise odometry.max_speed or max_angle"
        )
