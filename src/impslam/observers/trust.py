"""Whether the robot still knows where it is, in words."""

from __future__ import annotations

import math

from impslam.types import StepResult

LOST = 0.25
"""m, 1 sigma: by then the next landmark of a room may be taken for another; they stand 0.5 m and
more apart."""


class Trust:
    """Tells how long nothing in the map has been recognised, once that has made the pose doubtful.

    What counts is how much the position's spread has grown since: far from the start it is large on
    good grounds, and a robot that stands, or matches scans, may see no landmark for long.
    """

    def __init__(self) -> None:
        self._way, self._known = 0.0, 0.0
        self._last: StepResult | None = None

    def step(self, result: StepResult) -> str:
        """Return why the pose should not be trusted after this scan, "" if it should."""
        spread = float(result.covariance[0, 0] + result.covariance[1, 1])
        last, self._last = self._last, result
        if result.matches or last is None:
            self._way, self._known = 0.0, spread
        else:
            self._way += math.dist(result.pose[:2], last.pose[:2])
        grown = math.sqrt(max(spread - self._known, 0.0))
        if not math.isfinite(spread):
            return "the estimate is no number; start a new map"
        if grown > LOST:
            return f"no known landmark for {self._way:.1f} m, position unsure by {grown:.1f} m"
        if result.scan is not None and not result.scan.valid.any():
            return "the lidar sees nothing; the pose is dead-reckoned"
        return ""
