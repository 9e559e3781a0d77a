"""Poses from a robot's own odometry, for logs without wheel readings."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from impslam.columns import Columns, Motions
from impslam.component import parameter, register
from impslam.geometry.se2 import between, exp, log
from impslam.noise import MIN_BREAK, MotionNoise
from impslam.odometry.base import Odometry, add_path_uncertainty, diagonal, durations, mask_unknown
from impslam.types import Array, Mask, OdometryPose


@register("odometry_pose")
class OdometryPoses(Odometry):
    """Increments between the poses of a robot's own odometry."""

    consumes: ClassVar[type] = OdometryPose

    distance_scale: float = parameter(
        1.0, "1", "true distance over logged distance, from a calibration", gt=0
    )
    turn_scale: float = parameter(1.0, "1", "true turn over logged turn, from a calibration", gt=0)
    turn_per_metre: float = parameter(
        0.0,
        "rad/m",
        "turn per distance missing in the log, from a calibration: wheels of unequal size",
    )
    noise: MotionNoise = parameter(MotionNoise(), "", "random error of this odometry")
    drift: tuple[float, float, float] = parameter(
        (0.0, 0.0, 0.0),
        "m, m, rad, all /sqrt(s)",
        "further error along, across and of the heading while it moves, per root second: simulators "
        "add noise to each step, however short",
    )
    max_speed: float = parameter(
        10.0, "m/s", "a step that seems faster than this is a jump and is dropped", gt=0
    )

    def usable(self, readings: Columns) -> Mask:
        """Return which poses are finite; see `Odometry.usable`."""
        return np.asarray(np.isfinite(readings["pose"]).all(axis=1))

    def motions(self, readings: Columns) -> Motions:
        """Return the motions between the poses; see `Odometry.motions`."""
        d_pose, seconds = self._calibrated(_steps(readings)), durations(readings)
        distances = np.hypot(d_pose[:, 0], d_pose[:, 1])
        moved = d_pose.any(axis=1)
        variances = self.noise.variances(distances, d_pose[:, 2])
        variances += np.square(self.drift) * (seconds * moved)[:, None]
        covariance = diagonal(variances)
        # The robot integrates its path between two readings, unless it was switched off.
        add_path_uncertainty(covariance, distances, seconds > MIN_BREAK)
        motions = Motions(readings.stamps[1:], d_pose, covariance, seconds)
        return mask_unknown(motions, distances <= self.max_speed * np.maximum(seconds, 0.2))

    def _calibrated(self, steps: Array) -> Array:
        """Return the logged motions (m, 3) after calibration."""
        scale = self.distance_scale, self.distance_scale, self.turn_scale
        if scale == (1.0, 1.0, 1.0) and self.turn_per_metre == 0.0:
            return steps
        twists = log(steps)
        true = twists * scale
        true[:, 2] += self.turn_per_metre * twists[:, 0]
        return exp(true)

    def fault(self, readings: Columns) -> str:
        """Describe the fault; see `Odometry.fault`."""
        pose, stamp = readings["pose"][-1], readings.stamps[-1]
        if not self.usable(readings)[-1]:
            return f"odometry pose {pose} at {stamp:.3f} s is not finite; it is left out"
        (step,) = _steps(readings)
        return (
            f"odometry jumps by {math.hypot(step[0], step[1]):.2f} m in "
            f"{durations(readings)[-1]:.2f} s at {stamp:.3f} s; "
            "the jump is left out: check the odometry, or raise odometry.max_speed"
        )


def _steps(readings: Columns) -> Array:
    """Return the motions (m, 3) from each of m + 1 poses to the next."""
    return between(readings["pose"][:-1], readings["pose"][1:])
