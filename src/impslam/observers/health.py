"""Monitors whether the pose estimate is reliable."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from impslam.map import Keyframe, PathRows, Revision, Track
from impslam.observers.base import RELIABLE, Health, Observer
from impslam.types import Array, Mask

LOST = 0.25
"""m, 1 sigma: beyond this a landmark in a room may be mistaken for another one, because landmarks are
0.5 m or more apart."""


class HealthMonitor(Observer):
    """Reports when the pose estimate is unreliable, and why.

    A pose is unreliable if its covariance is not finite, if the position uncertainty has grown by
    more than `LOST` since the last match, if scans contradict odometry, or if a scan has no valid
    beam. The growth counts, not the uncertainty itself, which is large far from the start; a robot
    that stands still or matches scans may see no landmark for a long time.

    Attributes
    ----------
    health : of the run so far; `health.at_end` is why the newest pose is unreliable, or ""
    """

    def __init__(self) -> None:
        self.health = RELIABLE
        self._way, self._known = 0.0, 0.0
        self._last: Array | None = None

    def follow(self, track: Track, path: PathRows) -> None:
        """Check the poses of a track."""
        scans = track.sweeps.scans
        blind: Mask = np.zeros(len(path.stamps), np.bool_)
        if scans is not None:
            blind = np.logical_not(scans.valid[track.rows].any(axis=1))
        self._check(path, blind, track.contradicted)

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Check the pose of a keyframe."""
        if revision.matches:
            self._last = None
        blind = keyframe.scan is not None and not keyframe.scan.valid.any()
        self._check(path, np.array([blind]), np.array([keyframe.contradicted]))

    def _check(self, path: PathRows, blind: Mask, contradicted: Mask) -> None:
        spread = path.covariances[:, 0, 0] + path.covariances[:, 1, 1]
        if self._last is None:  # the first pose, or one where landmarks were recognised
            self._way, self._known, self._last = 0.0, float(spread[0]), path.poses[0, :2]
        steps = np.diff(np.vstack((self._last, path.poses[:, :2])), axis=0)
        way = self._way + np.cumsum(np.hypot(*steps.T))
        self._way, self._last = float(way[-1]), path.poses[-1, :2]
        grown = np.sqrt(np.maximum(spread - self._known, 0.0))
        unreliable = ~np.isfinite(spread) | (grown > LOST) | contradicted | blind
        at_end = ""
        if unreliable.any():
            first = int(np.argmax(unreliable))
            reasons = [
                _reason(spread[k], grown[k], way[k], contradicted[k]) if unreliable[k] else ""
                for k in (first, -1)
            ]
            if not self.health.unreliable:
                self.health = Health(0, float(path.stamps[first]), reasons[0])
            at_end = reasons[1]
        count = self.health.unreliable + int(unreliable.sum())
        self.health = replace(self.health, unreliable=count, at_end=at_end)


def _reason(spread: float, grown: float, way: float, contradicted: bool) -> str:
    """Return why a pose is unreliable, the most severe reason first."""
    if not np.isfinite(spread):
        return "the estimate is not finite; start a new map"
    if grown > LOST:
        return f"no known landmark for {way:.1f} m, position uncertain by {grown:.1f} m"
    if contradicted:
        return "the scans show another motion than odometry; the pose follows the scans"
    return "the scan has no valid range; the pose is dead-reckoned"
