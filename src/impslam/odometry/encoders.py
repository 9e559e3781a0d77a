"""Wheel encoders on a differential drive (thesis 3.5).

The body moves on an arc: with wheel travels l and r and track w, it goes d = (l + r)/2 while turning
by a = (r - l)/w, so the increment is exp([d, 0, a]) in SE(2). That is thesis Eq. 3.1 and 3.3 (the
latter with its sign corrected) in one form that is smooth through r = l, where the thesis switches
equations and divides by (r - l)^2. The state Jacobian, Eq. 3.5-3.7, is that of composing the
increment to the pose and lives in the filter; the noise Jacobian, Eq. 3.8-3.18, is here.
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
from impslam.odometry.base import Odometry
from impslam.types import Array, Increment, Message, WheelAngles

_SMALL = 1e-3  # rad: below it the series are exact to 1e-13, the closed forms no longer


def differential_drive(left: float, right: float, track: float) -> tuple[Array, Array]:
    """Return the increment (3,) of two wheel travels in m, and its Jacobian (3, 2) by them."""
    d, a = 0.5 * (left + right), (right - left) / track
    if abs(a) < _SMALL:
        s, s_D_a = 1.0 - a * a / 6.0, -a / 3.0
        c, c_D_a = a / 2.0 - a**3 / 24.0, 0.5 - a * a / 8.0
    else:
        s, c = math.sin(a) / a, (1.0 - math.cos(a)) / a
        s_D_a, c_D_a = (math.cos(a) - s) / a, (math.sin(a) - c) / a
    d_pose_D_arc = np.array([[s, d * s_D_a], [c, d * c_D_a], [0.0, 1.0]])
    arc_D_travel = np.array([[0.5, 0.5], [-1.0 / track, 1.0 / track]])
    return exp(np.array([d, 0.0, a])), d_pose_D_arc @ arc_D_travel


@register("encoders")
class Encoders(Odometry):
    """Two wheel encoders on a differential drive (thesis 3.5)."""

    consumes: ClassVar[type] = WheelAngles

    wheel_radius: float = parameter(
        ..., "m", "radius of the wheels that carry the encoders", ge=0.001, le=10
    )
    track: float = parameter(
        ..., "m", "distance between the two wheels' contact points", ge=0.001, le=100
    )
    right_left_ratio: float = parameter(
        1.0, "1", "radius of the right wheel over that of the left one", ge=0.1, le=10
    )
    per_turn: float = parameter(
        2.0 * math.pi,
        "reading",
        "how far a reading goes in one turn of the wheel: 2 pi for angles, the counts for ticks, "
        "the full scale for an absolute encoder's voltage (5 V for the MA3)",
        gt=0,
    )
    wrap: float = parameter(
        0.0,
        "reading",
        "where the reading starts again from 0: 5 (V) for the MA3, 65536 for 16-bit ticks; 0: never",
        ge=0,
    )
    wheel_noise: float = parameter(
        0.01, "m/sqrt(m)", "random error of one wheel's travel, per root metre", ge=0
    )
    slip: MotionNoise = parameter(
        MotionNoise(forward=0.0, sideways=0.01, turn_per_distance=0.01, turn_per_turn=0.05),
        "",
        "what the wheels do not tell: slip, sideways motion, a wrong track",
    )
    max_speed: float = parameter(
        5.0, "m/s", "a wheel that seems faster than this is an encoder jump and is dropped", gt=0
    )
    _last: WheelAngles | None = PrivateAttr(None)

    def update(self, message: Message) -> Increment | None:
        """Return the motion since the previous reading; see `Odometry.update`."""
        assert isinstance(message, WheelAngles)
        if not (math.isfinite(message.left) and math.isfinite(message.right)):
            raise MessageError(
                f"encoder reading ({message.left}, {message.right}) at {message.stamp:.3f} s is not "
                "finite; check the encoder's wiring"
            )
        last, self._last = self._last, message
        if last is None:
            return None
        duration = max(message.stamp - last.stamp, 0.0)
        left = self._travel(message.left - last.left)
        right = self._travel(message.right - last.right) * self.right_left_ratio
        self._refuse_jumps(max(abs(left), abs(right)), duration, message.stamp)
        d_pose, d_pose_D_travel = differential_drive(left, right, self.track)
        wheels = self.wheel_noise**2 * np.array([abs(left), abs(right)])  # thesis Eq. 3.19
        covariance = d_pose_D_travel * wheels @ d_pose_D_travel.T
        covariance += self.slip.covariance(0.5 * (left + right), float(d_pose[2]))
        return Increment(message.stamp, d_pose, covariance, duration)

    def _travel(self, difference: float) -> float:
        """Return a wheel's travel in m for a difference of readings, the shorter way round."""
        if self.wrap:
            difference -= self.wrap * round(difference / self.wrap)
        return 2.0 * math.pi * self.wheel_radius * difference / self.per_turn

    def _refuse_jumps(self, travel: float, duration: float, stamp: float) -> None:
        # Stamps jitter by tens of milliseconds on real robots: a short interval is no proof of speed.
        if travel > self.max_speed * max(duration, 0.2):
            raise MessageError(
                f"a wheel jumps by {travel:.3g} m in {duration:.3g} s at {stamp:.3f} s; its motion is "
                "left out: check the encoder, or raise odometry.max_speed"
            )
