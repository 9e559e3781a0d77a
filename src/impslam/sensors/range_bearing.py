"""A sensor that detects landmarks itself: barcodes in a camera, beacons, trees found by a lidar driver.

Range and bearing are converted to Cartesian observations in base_link (`landmarks.point`); R is
converted accordingly.

A camera that estimates the distance of an object of known size from its height in the picture measures
the depth along the optical axis (the sensor's x): the height is proportional to 1 / depth, not to
1 / range. Some logs call this depth a range. At a bearing beta the range is depth / cos(beta), 14 % more
at 0.5 rad.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from impslam.columns import Columns, Sweeps
from impslam.component import parameter, register
from impslam.geometry.polar import to_cartesian
from impslam.geometry.se2 import rotation, transform
from impslam.sensors.base import Mount, Sensor
from impslam.types import Array, Detections, Mask, Message, Observation


@register("range_bearing")
class RangeBearing(Sensor):
    """A sensor that measures range and bearing of landmarks, with or without their identity."""

    consumes: ClassVar[type[Message]] = Detections

    mount: Mount = parameter(
        (0.0, 0.0, 0.0), "m, m, rad", "pose [x, y, yaw] of the sensor in base_link"
    )
    landmark: str = parameter("point", "", "kind of landmark that it detects")
    range_min: float = parameter(0.0, "m", "nearer detections are ignored", ge=0)
    range_max: float = parameter(math.inf, "m", "farther detections are ignored; inf: none", gt=0)
    depth: bool = parameter(
        False,
        "",
        "the range in the log is the depth along the sensor's x axis, as cameras measure it",
    )
    range_scale: float = parameter(
        1.0, "1", "true range over measured range, from a calibration", gt=0
    )
    sigma_range: float = parameter(
        0.05, "m", "standard deviation of the range at range 0", gt=0, noise=True
    )
    sigma_range_per_m: float = parameter(
        0.0, "1", "increase of that standard deviation per metre of range", ge=0, noise=True
    )
    sigma_bearing: float = parameter(
        0.01, "rad", "standard deviation of the bearing", gt=0, noise=True
    )
    latency: float = parameter(
        0.0,
        "s",
        "delay from a detection to its stamp, on the odometry's clock",
    )

    def spans(self, columns: Columns) -> tuple[Array, Array]:
        """Return the times of the detections, (m,) s on the odometry's clock, as start and end."""
        moments = columns.stamps - self.latency
        return moments, moments

    def usable(self, columns: Columns) -> Mask:
        """Return (m,) which rows have a finite detection, or no detection."""
        finite = np.isfinite(columns["ranges"]) & np.isfinite(columns["bearings"])
        return np.asarray(finite.any(axis=1) | (finite.shape[1] == 0))

    def fault(self, message: Message) -> str:
        """Describe the fault of a row whose detections are not finite."""
        return f"no detection at {message.stamp:.3f} s is finite; it is dropped"

    def sweeps(self, columns: Columns, twists: Array) -> None:
        """Return None, because detections are not scans."""

    def observe(self, sweeps: Sweeps, k: int, rng: np.random.Generator) -> tuple[Observation, ...]:
        """Return an observation for each usable detection; see `Sensor.observe`."""
        del rng
        message = sweeps.columns.row(k)
        assert isinstance(message, Detections)
        with np.errstate(invalid="ignore"):
            usable = np.isfinite(message.ranges) & np.isfinite(message.bearings)
            usable &= (message.ranges > self.range_min) & (message.ranges <= self.range_max)
            usable &= (not self.depth) | (np.cos(message.bearings) > 0.0)
        return tuple(self._observation(message, int(i)) for i in np.flatnonzero(usable))

    def _observation(self, message: Detections, i: int) -> Observation:
        label, diameter = int(message.labels[i]), float(message.diameters[i])
        z, R = self._cartesian(float(message.ranges[i]), float(message.bearings[i]))
        mount = np.array(self.mount)
        turn = rotation(mount[2])
        return Observation(
            self.landmark,
            transform(mount, z),
            turn @ R @ turn.T,
            attributes={} if math.isnan(diameter) else {"radius": 0.5 * diameter},
            label=label if label >= 0 else None,
        )

    def _cartesian(self, measured: float, bearing: float) -> tuple[Array, Array]:
        """Return z (2,) and R (2, 2) of a detection, Cartesian in the sensor's frame."""
        distance = self.range_scale * measured
        sigma = self.sigma_range + self.sigma_range_per_m * distance
        noise = np.diag([sigma**2, self.sigma_bearing**2])
        if self.depth:
            c = math.cos(bearing)
            distance /= c
            polar_D_measured = np.array([[1.0 / c, distance * math.tan(bearing)], [0.0, 1.0]])
            noise = polar_D_measured @ noise @ polar_D_measured.T
        return to_cartesian(distance, bearing, noise)
