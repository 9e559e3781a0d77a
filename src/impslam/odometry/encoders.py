"""Wheel encoders on a differential drive (thesis 3.5).

The body moves on an arc: with wheel travels l and r and track w, it moves by d = (l + r)/2 while turning
by a = (r - l)/w, so the increment is exp([d, 0, a]) in SE(2). That is thesis Eq. 3.1 and 3.3 (the
latter with its sign corrected) in one form that is smooth through r = l, at which the thesis switches
equations and divides by (r - l)^2. The state Jacobian, Eq. 3.5-3.7, is that of composing the
increment with the pose, in the filter; the noise Jacobian, Eq. 3.8-3.18, is in `kernels`.
"""

from __future__ import annotations

import math
from typing import ClassVar, Literal

import numpy as np

from impslam.columns import Columns, Motions
from impslam.component import parameter, register
from impslam.geometry.kernels import plain
from impslam.noise import MAX_GAP, MotionNoise
from impslam.odometry.base import DIAGONAL, Odometry, add_path_uncertainty, durations, mask_unknown
from impslam.odometry.gyro import Gyro
from impslam.odometry.kernels import wheel_motions
from impslam.odometry.standstill import Band
from impslam.types import Array, Mask, WheelAngles

_SIGNS = {"none": (1.0, 1.0), "left": (-1.0, 1.0), "right": (1.0, -1.0), "both": (-1.0, -1.0)}


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
        "change of the reading per turn of the wheel: 2 pi for angles, the tick count for ticks, "
        "the full scale for an absolute encoder's voltage (5 V for the MA3)",
        gt=0,
    )
    swapped: bool = parameter(
        False, "", "the readings of the left and the right wheel are swapped in the log"
    )
    reversed: Literal["none", "left", "right", "both"] = parameter(
        "none", "", "wheels (after swapping) whose reading falls while they roll forward"
    )
    wrap: float = parameter(
        0.0,
        "reading",
        "value at which the reading wraps to 0: 5 (V) for the MA3, 65536 for 16-bit ticks; 0: never",
        ge=0,
    )
    jitter: float = parameter(
        0.0,
        "reading",
        "largest difference between readings of a stationary wheel: noise and one step of the encoder. "
        "While readings stay within it, the robot is stationary and its covariance does not grow",
        ge=0,
    )
    wheel_noise: float = parameter(
        0.01, "m/sqrt(m)", "random error of one wheel's travel, per root metre", ge=0, noise=True
    )
    slip: MotionNoise = parameter(
        MotionNoise(
            forward=0.0, sideways=0.01, turn_per_distance=0.01, turn_per_turn=0.05, systematic=0.9
        ),
        "",
        "errors that the encoders do not measure: slip, sideways motion, a wrong track. On smooth "
        "floor, wheels slip sideways by 2 to 2.6 mm/sqrt(m) (OptiOdom, 119 drives). The default is "
        "larger, because parameters of the wheels may be off by some per cent: a track known to 5 %, "
        "radii that differ by 0.4 %. This is most of the error in turns",
    )
    constant_speed: float = parameter(
        0.0,
        "m/s",
        "above 0, each motion has the noise of a straight drive at this speed, whatever the robot "
        "does: the constant Q of thesis Eq. 2.23; 0: the noise of the measured distance",
        ge=0,
    )
    max_speed: float = parameter(
        5.0, "m/s", "a faster wheel is an encoder jump; its motion is ignored", gt=0
    )

    gyro: Gyro = parameter(Gyro(use=True), "", "the gyro that corrects its turns, if there is one")

    @property
    def lever(self) -> float:
        """Half the track: a wheel that slips by e turns the robot by e / track and moves it by e / 2."""
        return 0.5 * self.track

    @property
    def standstill_band(self) -> Band:
        """The worst case, both readings off in opposite directions; see `Odometry.standstill_band`."""
        distance = 2.0 * math.pi * self.wheel_radius / self.per_turn * self.jitter
        return Band(distance, 2.0 * distance / self.track)

    def usable(self, readings: Columns) -> Mask:
        """Return which readings are finite; see `Odometry.usable`."""
        return np.asarray(np.isfinite(readings["left"]) & np.isfinite(readings["right"]))

    def motions(self, readings: Columns) -> Motions:
        """Return the motions between the readings; see `Odometry.motions`."""
        left, right, seconds = *self._travels(readings), durations(readings)
        d_pose, covariance = wheel_motions(left, right, self.track, self.wheel_noise**2)
        path = travel = np.maximum(np.abs(left), np.abs(right))
        if self.constant_speed:
            distance = self.constant_speed * seconds
            path = np.where(seconds > MAX_GAP, travel, distance)
            _, covariance = wheel_motions(distance, distance, self.track, self.wheel_noise**2)
            covariance[DIAGONAL] += self.slip.variances(distance, np.zeros(len(distance)))
        else:
            covariance[DIAGONAL] += self.slip.variances(0.5 * (left + right), d_pose[:, 2])
        # A change of the turn rate bends a path by an angle that grows with the time squared.
        add_path_uncertainty(covariance, path, np.minimum(seconds / MAX_GAP, 1.0) ** 2)
        motions = Motions(readings.stamps[1:], d_pose, covariance, seconds)
        # Stamps jitter by tens of milliseconds on real robots, so short intervals overestimate the speed.
        limits = self.max_speed * np.maximum(seconds, 0.2)
        return mask_unknown(motions, travel <= limits)

    def _travels(self, readings: Columns) -> tuple[Array, Array]:
        """Return the travels (m,) in m of both wheels between the readings, in the shorter direction."""
        per_reading = 2.0 * math.pi * self.wheel_radius / self.per_turn
        left, right = self._changes(readings)
        return per_reading * left, per_reading * right * self.right_left_ratio

    def turns(self, readings: Columns) -> tuple[Array, Array]:
        """Return the turns (m,) in rad of the left and the right wheel between the readings."""
        left, right = self._changes(readings)
        return 2.0 * math.pi / self.per_turn * left, 2.0 * math.pi / self.per_turn * right

    def _changes(self, readings: Columns) -> tuple[Array, Array]:
        """Return the changes (m,) of the readings of the left and the right wheel, forward positive."""
        left, right = np.diff(plain(readings["left"])), np.diff(plain(readings["right"]))
        if self.wrap:
            left -= self.wrap * np.rint(left / self.wrap)
            right -= self.wrap * np.rint(right / self.wrap)
        if self.swapped:
            left, right = right, left
        left_sign, right_sign = _SIGNS[self.reversed]
        return left_sign * left, right_sign * right

    def fault(self, readings: Columns) -> str:
        """Describe the fault; see `Odometry.fault`."""
        left, right, stamp = (float(readings[name][-1]) for name in ("left", "right", "stamp"))
        if not self.usable(readings)[-1]:
            return (
                f"encoder reading ({left}, {right}) at {stamp:.3f} s is not finite; check the "
                "encoder's wiring"
            )
        travel = np.abs(self._travels(readings)).max()
        return (
            f"a wheel jumps by {travel:.2f} m in {durations(readings)[-1]:.2f} s at {stamp:.3f} s; "
            "its motion is ignored: check the encoder, or raise odometry.max_speed"
        )
