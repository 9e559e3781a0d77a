"""Poses from a robot's own odometry, for logs that hold no wheel readings."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from pydantic import PrivateAttr

from impslam.component import parameter, register
from impslam.errors import MessageError
from impslam.geometry.se2 import between
from impslam.noise import MotionNoise
from impslam.odometry.base import Odometry
from impslam.types import Increment, Message, OdometryPose


@register("odometry_pose")
class OdometryPoses(Odometry):
    """Increments between the poses that a robot's own odometry gives."""

    consumes: ClassVar[type] = OdometryPose

    noise: MotionNoise = parameter(MotionNoise(), "", "how far this odometry strays")
    drift: tuple[float, float, float] = parameter(
        (0.0, 0.0, 0.0),
        "m, m, rad, all /sqrt(s)",
        "further error along, across and of the heading while it moves, per root second: simulators "
        "add noise to each step, however short",
    )
    max_speed: float = parameter(
        10.0, "m/s", "a step that seems faster than this is a jump and is dropped", gt=0
    )
    _last: OdometryPose | None = PrivateAttr(None)

    def update(self, message: Message) -> Increment | None:
        """Return the motion since the previous pose; see `Odometry.update`."""
        assert isinstance(message, OdometryPose)
        if not all(map(math.isfinite, message.pose.tolist())):
            raise MessageError(
                f"odometry pose {message.pose} at {message.stamp:.3f} s is not finite; it is left out"
            )
        last, self._last = self._last, message
        if last is None:
            return None
        duration = max(message.stamp - last.stamp, 0.0)
        d_pose = between(last.pose, message.pose)
        distance = math.hypot(d_pose[0], d_pose[1])
        if distance > self.max_speed * max(duration, 0.2):
            raise MessageError(
                f"odometry jumps by {distance:.3g} m in {duration:.3g} s at {message.stamp:.3f} s; "
                "the jump is left out: check the odometry, or raise odometry.max_speed"
            )
        covariance = self.noise.covariance(distance, float(d_pose[2]))
        if d_pose.any():
            covariance += np.diag(np.square(self.drift)) * duration
        return Increment(message.stamp, d_pose, covariance, duration)
