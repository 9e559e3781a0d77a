"""Whether the robot still knows where it is, in words."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from impslam.types import StepResult

LOST = 0.25
"""m, 1 sigma: by then the next landmark of a room may be taken for another; they stand 0.5 m and
more apart."""


@dataclass(frozen=True, slots=True)
class Health:
    """At how many scans the pose was not to be trusted, the first time and why, and why at the end."""

    doubted: int = 0
    stamp: float = float("nan")
    first: str = ""
    at_end: str = ""

    @property
    def words(self) -> str:
        """What to tell whoever reads the run's results, in one line."""
        if not self.doubted:
            return "to be trusted throughout"
        said = (
            f"not to be trusted at {self.doubted} scans, first at {self.stamp:.3f} s: {self.first}"
        )
        return said + (
            f"; at the end: {self.at_end}" if self.at_end else "; trusted again at the end"
        )


TRUSTED = Health()


class Trust:
    """Tells how long nothing in the map has been recognised, once that has made the pose doubtful.

    What counts is how much the position's spread has grown since: far from the start it is large on
    good grounds, and a robot that stands, or matches scans, may see no landmark for long.
    """

    def __init__(self) -> None:
        self.health = TRUSTED
        self._way, self._known = 0.0, 0.0
        self._last: StepResult | None = None

    def step(self, result: StepResult) -> str:
        """Return why the pose should not be trusted after this scan, "" if it should."""
        word, before = self._judge(result), self.health
        if word and not before.doubted:
            before = Health(0, result.stamp, word)
        self.health = replace(before, doubted=before.doubted + bool(word), at_end=word)
        return word

    def _judge(self, result: StepResult) -> str:
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
        if result.contradicted:
            return "the scans show another motion than odometry; the pose follows the scans"
        if result.scan is not None and not result.scan.valid.any():
            return "the lidar sees nothing; the pose is dead-reckoned"
        return ""
