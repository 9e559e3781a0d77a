"""A satellite receiver: latitude and longitude, converted to metres east and north of its first fix.

Fixes correct the pose like those of `sensors.gps`.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import PrivateAttr

from impslam.columns import Columns
from impslam.component import register
from impslam.geometry.geodesy import LocalPlane
from impslam.sensors.gps import Gps
from impslam.types import NO_FIX, Array, Mask, Message, SatelliteFix


@register("navsat")
class NavSat(Gps):
    """A GNSS receiver on the robot, or `sensor_msgs/NavSatFix` in a log."""

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
