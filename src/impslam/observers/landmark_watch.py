"""Checks whether landmarks are observed where the estimate predicts them.

The squared innovations per degree of freedom are 1 on average if the filter is consistent (Bar-Shalom et
al. 2001, ch. 5.4); continuous slip, late scans or a lidar that has turned on its mount make them larger.
And landmarks recognised at the last keyframe are in view at the next one: if most of them suddenly fit no
landmark, the robot is displaced from the estimate. It remains so until earlier landmarks are recognised
that determine the position along both axes: newer ones may be duplicates, and the two walls of a corridor
look the same everywhere. The robot is also displaced if the tracker reports that it was carried, or if the
landmarks correct odometry to one side (`CorrectionWatch`).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable

from impslam.geometry.algebra import eigenvalues
from impslam.health import CARRIED, DISPLACED, DRIFTING, INCONSISTENT, NONE, SKIPPED
from impslam.map import Keyframe, Revision
from impslam.observers.correction_watch import CorrectionWatch
from impslam.types import Observation

INNOVATION_WINDOW = 20.0
"""Keyframes (2 m of travel) over which innovations are averaged: some 150 degrees of freedom."""
MAX_RATIO = 1.3
"""Squared innovations per degree of freedom that 1 % of so many exceed by chance (chi-square)."""
MATCH_WINDOW = 5.0
"""Keyframes over which the usual number of matches is averaged."""
MIN_MATCHES = 3
"""Minimum of the usual number of matches to detect that matches are missing."""
MIN_MISSING_SHARE = 0.4
"""Share of the usual matches that must be missing while as many observations fit no landmark. Not all are
missing: the two walls along which a robot slips are still matched."""
MIN_KNOWN_SHARE = 0.75
"""Share of matches with earlier landmarks that shows that the robot is located again."""
MEMORY = 10
"""Keyframes whose new landmarks may belong to the new place: a jump is found up to a second later."""
MIN_INFORMATION = 0.5
"""Information that matched landmarks must give along the worse axis, where a point gives 1: a wall gives
none along itself, and one at 45 degrees to the others gives half."""
MIN_KEYFRAMES = 3
"""Keyframes in a row that must agree to change the state; one without any match counts as two."""


class LandmarkWatch:
    """Reports problems with the landmarks that keyframes recognise."""

    def __init__(self) -> None:
        self._corrections = CorrectionWatch()
        # start with the averages of a consistent filter
        self._squares, self._freedoms = INNOVATION_WINDOW, INNOVATION_WINDOW
        self._matches = 0.0
        self._missing = self._located = self._inconsistent = self._biased = 0  # keyframes in a row
        self._newest = -1  # newest landmark
        self._recent = deque([-1], maxlen=MEMORY)  # the same at the last keyframes
        self._before: int | None = None  # newest landmark before the robot was displaced
        self._carried = False  # whether the tracker reports it

    def revise(self, keyframe: Keyframe, revision: Revision) -> tuple[int, float]:
        """Add a keyframe; return the reason for concern, `NONE` if there is none, and its amount."""
        self._average(revision)
        biased = self._corrections.revise(keyframe, revision)
        ratio = self._squares / self._freedoms
        self._biased = self._biased + 1 if biased else 0
        self._update_displaced(keyframe, revision, inconsistent=ratio > MAX_RATIO)
        self._newest = max((self._newest, *revision.added))
        self._recent.append(self._newest)
        if ratio > MAX_RATIO:
            return INCONSISTENT, math.sqrt(ratio)
        if self._before is not None:
            return DISPLACED, 0.0
        return (DRIFTING if biased else NONE), 0.0

    def _average(self, revision: Revision) -> None:
        keep = 1.0 - 1.0 / INNOVATION_WINDOW
        self._squares = keep * self._squares + sum(m.distance2 for m in revision.matches)
        self._freedoms = keep * self._freedoms + sum(len(m.innovation) for m in revision.matches)

    def _update_displaced(
        self, keyframe: Keyframe, revision: Revision, *, inconsistent: bool
    ) -> None:
        """Update whether the robot is displaced; `inconsistent`: the innovations are too large."""
        found, seen = len(revision.matches), len(keyframe.observations)
        self._inconsistent = self._inconsistent + 1 if inconsistent else 0
        first = self._recent[0]
        if keyframe.reason == CARRIED and first >= 0:
            # this may be found a second later, when the place already has new landmarks
            usual = round(MIN_KNOWN_SHARE * max(found, self._matches))
            if not self._is_known(keyframe, revision, first, usual) or inconsistent:
                self._before, self._located, self._carried = first, 0, True
        elif (keyframe.lost or keyframe.reason == SKIPPED) and self._newest >= 0:
            self._before, self._located = self._newest, 0
        elif self._before is None:
            fitting = found + len(revision.ambiguous)
            missing = min(self._matches, seen) - fitting >= MIN_MISSING_SHARE * self._matches
            missing &= self._matches >= MIN_MATCHES
            self._missing = self._missing + (1 if found else 2) if missing else 0
            if max(self._inconsistent, self._missing) >= MIN_KEYFRAMES:
                self._before, self._located = self._newest, 0
            elif self._biased >= MIN_KEYFRAMES:  # newer landmarks are off by as much as the pose
                self._before, self._located = first, 0
        else:
            share = 1.0 if self._carried else MIN_KNOWN_SHARE
            count = max(min(MIN_MATCHES, int(self._matches)), share * found)
            located = not (inconsistent or self._biased)
            located = located and self._is_known(keyframe, revision, self._before, count)
            self._located = self._located + 1 if located else 0
            if self._located >= MIN_KEYFRAMES:
                self._before, self._missing, self._carried = None, 0, False
        if not self._missing:
            self._matches += (found - self._matches) / MATCH_WINDOW

    @staticmethod
    def _is_known(keyframe: Keyframe, revision: Revision, newest: int, count: float) -> bool:
        """Return whether matches with landmarks up to `newest`, at least `count`, locate the robot."""
        known = [match.observation for match in revision.matches if match.landmark <= newest]
        return len(known) >= count and is_located([keyframe.observations[k] for k in known])


def is_located(seen: Iterable[Observation]) -> bool:
    """Return whether observations of known landmarks determine the position along both axes."""
    xx = xy = yy = 0.0  # information about the position
    for one in seen:
        if one.end_points is None:
            xx, yy = xx + 1.0, yy + 1.0
            continue
        (x0, y0), (x1, y1) = one.end_points.tolist()
        x, y = x1 - x0, y1 - y0
        length2 = x * x + y * y
        if length2 > 0.0:
            xx, xy, yy = xx + y * y / length2, xy - x * y / length2, yy + x * x / length2
    return eigenvalues(xx, xy, yy)[0] >= MIN_INFORMATION
