"""A 2D lidar: from what it sent to points in base_link at one instant.

The beams of a sweep start while the robot moves. With a constant body twist xi the robot is at
exp(t xi) when a beam is fired t seconds after the middle of the sweep; the beam's origin and end are
carried through that motion (de-skewed) before they are used.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from pydantic import Field, PrivateAttr, field_validator

from impslam.component import build, parameter, register
from impslam.errors import MessageError
from impslam.extractors.base import Extractor
from impslam.geometry.kernels import kernel
from impslam.sensors.base import Reading, Sensor
from impslam.sensors.clock import SweepClock
from impslam.types import Array, LaserScan, Mask, Message, Scan


@kernel
def _place(
    angles: Array,
    ranges: Array,
    offsets: Array,
    laser: Array,
    sign: float,
    twist: Array,
) -> tuple[Array, Array, Array]:
    """Return the beams' end points (n, 2), directions (n,) and origins (n, 2) in base_link."""
    n = len(ranges)
    points, directions, origins = np.empty((n, 2)), np.empty(n), np.empty((n, 2))
    vx, vy, omega = twist
    for i in range(n):
        t = offsets[i]
        theta = omega * t
        if abs(theta) < 1e-4:
            a, b = 1.0 - theta * theta / 6.0, theta / 2.0
        else:
            a, b = math.sin(theta) / theta, (1.0 - math.cos(theta)) / theta
        c, s = math.cos(theta), math.sin(theta)
        x = t * (a * vx - b * vy) + c * laser[0] - s * laser[1]
        y = t * (b * vx + a * vy) + s * laser[0] + c * laser[1]
        direction = theta + laser[2] + sign * angles[i]
        directions[i] = direction
        origins[i, 0], origins[i, 1] = x, y
        points[i, 0] = x + ranges[i] * math.cos(direction)
        points[i, 1] = y + ranges[i] * math.sin(direction)
    return points, directions, origins


@register("lidar2d")
class Lidar2D(Sensor):
    """A planar laser scanner with the extractors that hang on it."""

    consumes: ClassVar[type] = LaserScan

    mount: tuple[float, float, float] = parameter(
        (0.0, 0.0, 0.0), "m, m, rad", "pose [x, y, yaw] of the laser on base_link"
    )
    upside_down: bool = parameter(False, "", "the laser is mounted with its z axis pointing down")
    range_min: float = parameter(
        math.nan, "m", "shorter ranges are invalid; nan: as the messages say"
    )
    range_max: float = parameter(
        math.nan, "m", "longer ranges are invalid; nan: as the messages say"
    )
    angle_min: float = parameter(
        -math.pi, "rad", "beams to the right of this (laser frame) are invalid: the robot's body"
    )
    angle_max: float = parameter(math.pi, "rad", "beams to the left of this are invalid")
    sigma: float = parameter(
        0.01, "m", "standard deviation of the range noise at range 0", gt=0, le=100
    )
    sigma_per_m: float = parameter(0.0, "1", "how much it grows with range", ge=0, le=1)
    bias: float = parameter(
        0.0, "m", "standard deviation of the range error that all beams share", ge=0, le=100
    )
    range_scale: float = parameter(
        1.0, "1", "true range over measured range, from a calibration", gt=0
    )
    range_offset: float = parameter(
        0.0, "m", "added to the scaled ranges, from a calibration: true = scale * measured + offset"
    )
    period: float = parameter(
        0.0,
        "s",
        "time of a revolution, to smooth stamps that jitter; 0: the stamps are true",
        ge=0,
        le=60,
    )
    deskew: bool = parameter(True, "", "undo the robot's motion during the sweep")
    latency: float = parameter(
        0.0, "s", "how much later than its first beam a scan is stamped, on the odometry's clock"
    )
    extractors: dict[str, Any] = Field(
        default_factory=dict, description="what looks for landmarks in the scans, by name"
    )

    _clock: SweepClock = PrivateAttr()

    def model_post_init(self, context: Any) -> None:
        """Start the clock."""
        self._clock = SweepClock(self.period)

    @field_validator("extractors")
    @classmethod
    def _build_extractors(cls, tables: dict[str, Any]) -> dict[str, Extractor]:
        return {
            name: table
            if isinstance(table, Extractor)
            else build("extractor", table, f"sensors.*.extractors.{name}")
            for name, table in tables.items()
        }

    def span(self, message: Message) -> tuple[float, float]:
        """Return when the first and the last beam were fired, s on the odometry's clock."""
        assert isinstance(message, LaserScan)
        smoothed = self._clock.smooth(message.stamp) if self.period else message.stamp
        begin = smoothed - self.latency
        return begin, begin + self._sweep(message)

    def _sweep(self, message: LaserScan) -> float:
        return float(message.time_offsets.max(initial=0.0)) if self.deskew else 0.0

    def observe(
        self, message: Message, twist: Array, rng: np.random.Generator, look: bool = True
    ) -> Reading:
        """Return the de-skewed scan and what the extractors find in it."""
        assert isinstance(message, LaserScan)
        if len(message.ranges) == 0:
            raise MessageError(f"the scan at {message.stamp:.3f} s has no beams; it is dropped")
        scan = self.scan(message, twist)
        middle = 0.5 * self._sweep(message)
        found = [
            replace(o, delay=float(message.time_offsets[o.beams].mean()) - middle)
            if middle and len(o.beams)
            else o
            for extractor in self.extractors.values()
            if look
            for o in extractor.extract(scan, rng)
        ]
        return Reading(scan, tuple(found), look)

    def scan(self, message: LaserScan, twist: Array) -> Scan:
        """Return the message as a `Scan`: validated, mounted, de-skewed."""
        low, high = self._limits(message)
        valid = self._valid(message, low, high)
        with np.errstate(invalid="ignore"):
            calibrated = self.range_scale * message.ranges + self.range_offset
        ranges = np.where(valid, calibrated, 0.0)
        laser = np.array(self.mount)
        points, directions, origins = _place(
            message.angles,
            ranges,
            message.time_offsets - 0.5 * self._sweep(message),
            laser,
            -1.0 if self.upside_down else 1.0,
            twist if self.deskew else np.zeros(3),
        )
        return Scan(
            message.stamp,
            message.angles,
            ranges,
            valid,
            points,
            directions,
            origins,
            self.sigma + self.sigma_per_m * ranges,
            self.bias,
            high,
            laser,
            message.intensities,
        )

    def _limits(self, message: LaserScan) -> tuple[float, float]:
        low = float(np.fmax(self.range_min, message.range_min))
        high = float(np.fmin(self.range_max, message.range_max))
        return (0.0 if math.isnan(low) else low), (math.inf if math.isnan(high) else high)

    def _valid(self, message: LaserScan, low: float, high: float) -> Mask:
        """REP 117, drivers' 0 for no return, and the lidar's error codes below its range_min."""
        r, angles = message.ranges, message.angles
        with np.errstate(invalid="ignore"):
            inside = (r >= low) & (r <= high) & (r > 0.0) & np.isfinite(r)
        # Beams of a full turn may be given as 0 to 2 pi: compare directions, not numbers.
        turned = np.mod(angles - self.angle_min, 2.0 * np.pi)
        field = self.angle_max - self.angle_min
        if field < 2.0 * np.pi:
            inside &= turned <= field
        return np.asarray(inside, dtype=np.bool_)
