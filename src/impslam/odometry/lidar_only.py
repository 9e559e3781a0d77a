"""No odometry: each scan counts as a reading without information about the motion.

A tracker that matches scans estimates the motion by itself, predicted at constant velocity.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from impslam.columns import Columns, Motions
from impslam.component import register
from impslam.noise import UNKNOWN
from impslam.odometry.base import Odometry, diagonal, durations
from impslam.types import LaserScan, Mask

UNKNOWN_HEADING = 10.0
"""rad^2: variance of an unknown heading."""


@register("lidar_only")
class LidarOnly(Odometry):
    """A robot whose odometry is missing or unused: the motion comes from the scans."""

    consumes: ClassVar[type] = LaserScan
    measures_motion: ClassVar[bool] = False

    def readings(self, rows: Columns) -> Columns:
        """Return the middles of the sweeps as stamps, so that motions lead from middle to middle.

        A motion that is cut within a sweep would leave parts of which half is unknown.
        """
        middles = rows.stamps + 0.5 * rows["time_offsets"].max(initial=0.0)
        return Columns(rows.stream, rows.kind, rows.order, {"stamp": middles}, {})

    def usable(self, readings: Columns) -> Mask:
        """Return which stamps are finite; see `Odometry.usable`."""
        return np.isfinite(readings.stamps)

    def motions(self, readings: Columns) -> Motions:
        """Return unknown motions; see `Odometry.motions`."""
        seconds = durations(readings)
        variances = np.tile([UNKNOWN, UNKNOWN, UNKNOWN_HEADING], (len(seconds), 1))
        d_pose = np.zeros((len(seconds), 3))
        return Motions(readings.stamps[1:], d_pose, diagonal(variances), seconds)

    def fault(self, readings: Columns) -> str:
        """Describe the fault of a scan without a stamp; see `Odometry.fault`."""
        return f"a scan is stamped {readings.stamps[-1]}; it is ignored: check the log"
