"""Whether the robot still knows where it is, in words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from impslam.map import Keyframe, PathRows, Revision, Track
from impslam.observers.base import TRUSTED, Health, Observer
from impslam.types import Array, Mask

LOST = 0.25
"""m, 1 sigma: by then the next landmark of a room may be taken for another; they stand 0.5 m and
more apart."""


class Trust(Observer):
    """Tells how long nothing in the map has been recognised, once that has made the pose doubtful.

    What counts is how much the position's spread has grown since: far from the start it is large on
    good grounds, and a robot that stands, or matches scans, may see no landmark for long.

    Attributes
    ----------
    health : of the run by now; `health.at_end` is why the newest pose should not be trusted, or ""
    """

    def __init__(self) -> None:
        self.health = TRUSTED
        self._way, self._known = 0.0, 0.0
        self._last: Array | None = None

    def follow(self, track: Track, path: PathRows) -> None:
        """Judge the sweeps of a track."""
        scans = track.sweeps.scans
        blind: Mask = np.zeros(len(path.stamps), np.bool_)
        if scans is not None:
            blind = np.logical_not(scans.valid[track.rows].any(axis=1))
        self._judge(path, blind, track.contradicted)

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Judge a keyframe."""
        if revision.matches:
            self._last = None
        blind = keyframe.scan is not None and not keyframe.scan.valid.any()
        self._judge(path, np.array([blind]), np.array([keyframe.contradicted]))

    def _judge(self, path: PathRows, blind: Mask, contradicted: Mask) -> None:
        spread = path.covariances[:, 0, 0] + path.covariances[:, 1, 1]
        if self._last is None:  # the first pose, or one where landmarks were recognised
            self._way, self._known, self._last = 0.0, float(spread[0]), path.poses[0, :2]
        steps = np.diff(np.vstack((self._last, path.poses[:, :2])), axis=0)
        way = self._way + np.cumsum(np.hypot(*steps.T))
        self._way, self._last = float(way[-1]), path.poses[-1, :2]
        grown = np.sqrt(np.maximum(spread - self._known, 0.0))
        doubted = ~np.isfinite(spread) | (grown > LOST) | contradicted | blind
        words = ""
        if doubted.any():
            first = int(np.argmax(doubted))
            told = [
                _words(spread[k], grown[k], way[k], contradicted[k]) if doubted[k] else ""
                for k in (first, -1)
            ]
            if not self.health.doubted:
                self.health = Health(0, float(path.stamps[first]), told[0])
            words = told[1]
        count = self.health.doubted + int(doubted.sum())
        self.health = replace(self.health, doubted=count, at_end=words)


def _words(spread: float, grown: float, way: float, contradicted: bool) -> str:
    """Say why a pose should not be trusted, the gravest reason first."""
    if not np.isfinite(spread):
        return "the estimate is no number; start a new map"
    if grown > LOST:
        return f"no known landmark for {way:.1f} m, position unsure by {grown:.1f} m"
    if contradicted:
        return "the scans show another motion than odometry; the pose follows the scans"
    return "the lidar sees nothing; the pose is dead-reckoned"
