"""Satellite receivers: fixes in an east-north frame correct the pose through that frame (`landmarks.gps`).

`gps` takes fixes in metres; `navsat` takes latitude and longitude, as receivers and `NavSatFix` give them.
"""

from __future__ import annotations

import math
from collections import deque
from typing import ClassVar

import numpy as np
from pydantic import PrivateAttr

from impslam.columns import Columns, Sweeps
from impslam.component import parameter, register
from impslam.geometry.geodesy import LocalPlane
from impslam.landmarks.base import COURSE, COURSE_SIGMA
from impslam.sensors.base import Sensor
from impslam.types import NO_FIX, Array, Fix, Mask, Message, Observation, SatelliteFix

MAX_FIXES = 5000  # fixes kept, 8 minutes at 10 Hz; all are searched while the robot stands still
MIN_COURSE_SIGMAS = 10.0  # distance of two fixes that determine the course to 0.14 rad


@register("gps")
class Gps(Sensor):
    """Fixes in metres; `landmarks.gps.antenna` is the position of its antenna on the robot."""

    consumes: ClassVar[type[Message]] = Fix
    observes_unique: ClassVar[bool] = True
    row_name: ClassVar[str] = "fix"

    sigma: float = parameter(
        1.5,
        "m",
        "smallest standard deviation of a coordinate, also for fixes without one: errors of satellites, "
        "air and reflections persist for minutes",
        gt=0,
        noise=True,
    )
    latency: float = parameter(0.0, "s", "delay from a fix to its stamp, on the odometry's clock")
    _track: deque[tuple[float, float, float]] = PrivateAttr(
        default_factory=lambda: deque(maxlen=MAX_FIXES)
    )
    """Position in the log, and m east and north, of the newest fixes: stamps may run back."""

    def spans(self, columns: Columns) -> tuple[Array, Array]:
        """Return the times of the fixes, (m,) s on the odometry's clock, as start and end."""
        usable = self.usable(columns)
        rows = np.column_stack([columns.order, self._positions(columns)])
        self._track += map(tuple, rows[usable].tolist())
        stamps = columns.stamps - self.latency
        return stamps, stamps

    def usable(self, columns: Columns) -> Mask:
        """Return (m,) which fixes are finite."""
        return np.asarray(np.isfinite(self._positions(columns)).all(axis=1))

    def fault(self, message: Message) -> str:
        """Describe the fault of a fix that is not finite."""
        return f"the fix at {message.stamp:.3f} s is not finite; it is dropped"

    def sweeps(self, columns: Columns, twists: Array) -> None:
        """Return None, because fixes are not scans."""

    def observe(self, sweeps: Sweeps, k: int, rng: np.random.Generator) -> tuple[Observation, ...]:
        """Return the fix if the path since an earlier one determines the course; see `Sensor.observe`."""
        del rng
        row = sweeps.columns.take(slice(k, k + 1))
        position, covariance = self._positions(row)[0], row["covariance"][0, :2, :2]
        covariance = np.where(np.isfinite(covariance), covariance, 0.0)
        R = covariance.copy()
        np.fill_diagonal(R, np.maximum(np.diag(R), self.sigma**2))
        course = self._course(int(row.order[0]), position)
        if course is None:
            return ()
        return (Observation("gps", position, R, attributes=course),)

    def _positions(self, columns: Columns) -> Array:
        """Return (m, 2) m east and north, NaN without a fix."""
        return np.asarray(columns["position"])

    def _course(self, order: int, position: Array) -> dict[str, float] | None:
        """Return the direction from the newest earlier fix that is far enough away, None without one."""
        x, y = position
        for earlier, x0, y0 in reversed(self._track):
            distance = math.hypot(x - x0, y - y0)
            if earlier < order and distance >= MIN_COURSE_SIGMAS * self.sigma:
                course = math.atan2(y - y0, x - x0)
                # Errors of both fixes; and the path between them may be an arc of this angle.
                return {
                    COURSE: course,
                    COURSE_SIGMA: math.hypot(math.sqrt(2.0) / MIN_COURSE_SIGMAS, 0.3),
                }
        return None


@register("navsat")
class NavSat(Gps):
    """A GNSS receiver on the robot, or `sensor_msgs/NavSatFix` in a log: metres from its first fix."""

    consumes: ClassVar[type[Message]] = SatelliteFix

    _plane: LocalPlane | None = PrivateAttr(default=None)

    def spans(self, columns: Columns) -> tuple[Array, Array]:
        """Return the times of the fixes; the first usable one becomes the origin."""
        usable = self.usable(columns)
        if self._plane is None and usable.any():
            first = columns.row(int(usable.argmax()))
            assert isinstance(first, SatelliteFix)
            altitude = first.altitude if np.isfinite(first.altitude) else 0.0
            self._plane = LocalPlane(first.latitude, first.longitude, altitude)
        return super().spans(columns)

    def usable(self, columns: Columns) -> Mask:
        """Return (m,) which rows are fixes with a finite position on the earth."""
        north, east = np.abs(columns["latitude"]), np.abs(columns["longitude"])
        return np.asarray((columns["status"] > NO_FIX) & (north <= 90.0) & (east <= 360.0))

    def fault(self, message: Message) -> str:
        """Describe the fault of a row without a fix, or with an invalid one."""
        assert isinstance(message, SatelliteFix)
        if message.status <= NO_FIX:
            return f"the receiver has no fix at {message.stamp:.3f} s; it is ignored"
        position = f"{message.latitude} deg, {message.longitude} deg"
        return (
            f"the fix at {message.stamp:.3f} s is not a valid position ({position}); it is dropped"
        )

    def _positions(self, columns: Columns) -> Array:
        positions = np.full((len(columns), 2), np.nan)
        usable = self.usable(columns)
        if self._plane is not None:
            rows = columns.take(usable)
            height = np.full(len(rows), self._plane.altitude)  # robots do not fly
            points = self._plane.points(rows["latitude"], rows["longitude"], height)
            positions[usable] = points[:, :2]
        return positions
