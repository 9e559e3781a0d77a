"""A GPS: fixes in a local east-north frame, which correct the pose through that frame (`landmarks.gps`)."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from pydantic import PrivateAttr

from impslam.columns import Columns, Sweeps
from impslam.component import parameter, register
from impslam.landmarks.base import COURSE, COURSE_SIGMA
from impslam.sensors.base import Sensor
from impslam.types import Array, Fix, Mask, Message, Observation

FAR = 10.0  # standard deviations: two fixes so far apart tell the course to 0.14 rad


@register("gps")
class Gps(Sensor):
    """A GPS; where its antenna is on the robot, `landmarks.gps.antenna` says."""

    consumes: ClassVar[type[Message]] = Fix
    tells_unique: ClassVar[bool] = True
    row_name: ClassVar[str] = "fix"

    sigma: float = parameter(
        1.5,
        "m",
        "standard deviation of a coordinate, where the fix tells none or a smaller one: satellites, "
        "air and reflections err alike for minutes",
        gt=0,
        noise=True,
    )
    latency: float = parameter(0.0, "s", "delay from a fix to its stamp, on the odometry's clock")
    _track: list[tuple[float, float, float]] = PrivateAttr(default_factory=list)

    def spans(self, columns: Columns) -> tuple[Array, Array]:
        """Return the times of the fixes, (m,) s on the odometry's clock, as start and end."""
        usable = self.usable(columns)
        rows = np.column_stack([columns.stamps, self._places(columns)])
        self._track += map(tuple, rows[usable].tolist())
        moments = columns.stamps - self.latency
        return moments, moments

    def usable(self, columns: Columns) -> Mask:
        """Return (m,) which fixes are finite."""
        return np.asarray(np.isfinite(self._places(columns)).all(axis=1))

    def fault(self, message: Message) -> str:
        """Describe the fault of a fix that is not finite."""
        return f"the fix at {message.stamp:.3f} s is not finite; it is dropped"

    def sweeps(self, columns: Columns, twists: Array) -> None:
        """Return None, because fixes are not scans."""

    def look(self, sweeps: Sweeps, k: int, rng: np.random.Generator) -> tuple[Observation, ...]:
        """Return the fix once the way since an earlier one tells the course; see `Sensor.look`."""
        del rng
        row = sweeps.columns.take(slice(k, k + 1))
        place, told = self._places(row)[0], row["covariance"][0, :2, :2]
        told = np.where(np.isfinite(told), told, 0.0)
        R = np.diag(np.maximum(np.diag(told), self.sigma**2)) + told - np.diag(np.diag(told))
        course = self._course(float(row.stamps[0]), place)
        if course is None:
            return ()
        return (Observation("gps", place, R, attributes=course),)

    def _places(self, columns: Columns) -> Array:
        """Return (m, 2) m east and north, NaN where there is no fix."""
        return np.asarray(columns["position"])

    def _course(self, moment: float, place: Array) -> dict[str, float] | None:
        """Return the direction from the newest fix that is far enough, None where there is none."""
        x, y = place
        for stamp, x0, y0 in reversed(self._track):
            way = math.hypot(x - x0, y - y0)
            if stamp < moment and way >= FAR * self.sigma:
                course = math.atan2(y - y0, x - x0)
                # Of both ends' errors; and that the way between them may be an arc of this angle.
                return {COURSE: course, COURSE_SIGMA: math.hypot(math.sqrt(2.0) / FAR, 0.3)}
        return None
