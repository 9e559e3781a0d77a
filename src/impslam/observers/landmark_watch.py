"""Whether landmarks are seen where the estimate has them.

Two tests of what a filter says of itself. The squared innovations, over their degrees of freedom, are 1 on
average if it is consistent (Bar-Shalom et al. 2001, ch. 5.4); odometry that slips on and on, scans that are
late, or a lidar that has turned on its mount make them larger. And what was recognised at the last
keyframe is in view at the next one: where most of it fits no landmark all at once, the robot is
elsewhere than estimated. It is so until landmarks from before are recognised that tell the position along
both axes: those that are new since may be the same things once more, and along a corridor its two walls are
the same everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from impslam.health import DISPLACED, INCONSISTENT, NONE, SKIPPED
from impslam.map import Keyframe, Revision
from impslam.types import Observation

MEMORY = 20.0
"""Keyframes (2 m of way) over which innovations are averaged: some 150 degrees of freedom."""
MOST = 1.3
"""Squared innovations over degrees of freedom that 1 % of so many exceed by chance (chi-square)."""
SHORT = 5.0
"""Keyframes over which the usual number of matches is averaged."""
FEWEST = 3
"""Matches that are usual at least, to say that they are missing."""
MISSING = 0.4
"""Of the usual number of matches, the share that is missing while as many observations fit no landmark. Not
all are missing: the two walls along which a robot slips are still matched."""
KNOWN = 0.75
"""Share of matches that are with landmarks from before, of a robot that is where it is estimated."""
ACROSS = 0.5
"""Of one landmark's worth, what those from before tell at least along the axis that they tell less of: a
wall tells nothing along itself, and one at 45 degrees to the others half."""
PERSISTS = 3
"""Keyframes in a row that have to say so, either way; one without any match counts for two."""


class LandmarkWatch:
    """Tells what is wrong with the landmarks that keyframes recognise."""

    def __init__(self) -> None:
        self._squares, self._freedoms = MEMORY, MEMORY  # as if it had been consistent
        self._matches = 0.0
        self._missing = self._again = 0  # keyframes in a row
        self._newest = -1  # landmark
        self._before: int | None = None  # newest landmark before the robot was displaced

    def revise(self, keyframe: Keyframe, revision: Revision) -> tuple[int, float]:
        """Take in a keyframe; return what is wrong, `NONE` if nothing is, and the amount with it."""
        self._average(revision)
        ratio = self._squares / self._freedoms
        self._displace(keyframe, revision, off=ratio > MOST)
        self._newest = max((self._newest, *revision.born))
        if ratio > MOST:
            return INCONSISTENT, math.sqrt(ratio)
        return (NONE, 0.0) if self._before is None else (DISPLACED, 0.0)

    def _average(self, revision: Revision) -> None:
        keep = 1.0 - 1.0 / MEMORY
        self._squares = keep * self._squares + sum(m.distance2 for m in revision.matches)
        self._freedoms = keep * self._freedoms + sum(len(m.innovation) for m in revision.matches)

    def _displace(self, keyframe: Keyframe, revision: Revision, *, off: bool) -> None:
        """Find out whether the robot is displaced; `off` tells that landmarks are not where they were."""
        found, seen = len(revision.matches), len(keyframe.observations)
        if (keyframe.lost or keyframe.reason == SKIPPED) and self._newest >= 0:
            self._before, self._again = self._newest, 0
        elif self._before is None:
            fitting = found + len(revision.ambiguous)
            missing = min(self._matches, seen) - fitting >= MISSING * self._matches
            missing &= self._matches >= FEWEST
            self._missing = self._missing + (1 if found else 2) if missing else 0
            if off or self._missing >= PERSISTS:
                self._before, self._again = self._newest, 0
        else:
            known = [match for match in revision.matches if match.landmark <= self._before]
            again = len(known) >= max(FEWEST, KNOWN * found) and not off
            again = again and is_located([keyframe.observations[m.observation] for m in known])
            self._again = self._again + 1 if again else 0
            if self._again >= PERSISTS:
                self._before, self._missing = None, 0
        if not self._missing:
            self._matches += (found - self._matches) / SHORT


def is_located(seen: Iterable[Observation]) -> bool:
    """Tell whether observations of known landmarks tell the position along both axes."""
    information = np.zeros((2, 2))
    for one in seen:
        if one.end_points is None:
            information += np.eye(2)
            continue
        along = one.end_points[1] - one.end_points[0]
        length2 = float(along @ along)
        if length2 > 0.0:
            information += np.eye(2) - np.outer(along, along) / length2
    return bool(np.linalg.eigvalsh(information)[0] >= ACROSS)
