"""Monitors whether the pose estimate is reliable."""

from __future__ import annotations

import math

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.map import Keyframe, PathRows, Revision, Track
from impslam.observers.base import RELIABLE, Health, Observer
from impslam.types import Array, Mask

LOST = 0.25
"""m, 1 sigma: beyond this a landmark in a room may be mistaken for another one, because landmarks are
0.5 m or more apart."""
NOT_FINITE, GROWN, CONTRADICTED, BLIND = 1, 2, 3, 4
"""Why a pose is unreliable, the most severe reason first; 0 is reliable."""


class HealthMonitor(Observer):
    """Reports when the pose estimate is unreliable, and why.

    A pose is unreliable if its covariance is not finite, if the position uncertainty has grown by
    more than `LOST` since the last match (of a landmark, of a scan with a map, or of a place), if scans
    contradict odometry, or if a scan has no valid beam. The growth counts, not the uncertainty
    itself, which is large far from the start; a robot that stands still may see no landmark for long.
    """

    def __init__(self) -> None:
        self._walked = np.zeros(4)  # x, y of the last pose, way since a match, variance there
        self._fresh = True  # no pose yet, or landmarks were recognised
        self._count = 0
        self._first = RELIABLE
        self._at_end = 0, 0.0, 0.0

    @property
    def health(self) -> Health:
        """Health of the run so far; `at_end` is why the newest pose is unreliable, or ""."""
        first = self._first
        return Health(self._count, first.stamp, first.first, _reason(*self._at_end))

    def follow(self, track: Track, path: PathRows) -> None:
        """Check the poses of a track."""
        scans = track.sweeps.scans
        valid = (
            np.ones((len(path.stamps), 1), np.bool_) if scans is None else scans.valid[track.rows]
        )
        self._check(path, valid, track.contradicted.copy(), track.located.copy())

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Check the pose of a keyframe."""
        if revision.matches or len(revision.ids) > 1:  # landmarks, or a place known
            self._fresh = True
        valid = np.ones(1, np.bool_) if keyframe.scan is None else keyframe.scan.valid
        self._check(
            path, valid[None], np.array([keyframe.contradicted]), np.array([keyframe.located])
        )

    def _check(self, path: PathRows, valid: Mask, contradicted: Mask, fresh: Mask) -> None:
        fresh[:1] |= self._fresh
        reasons, facts = _judge(
            self._walked, fresh, path.poses, path.covariances, valid, contradicted
        )
        self._fresh = False
        if not self._count and reasons.any():
            k = int(np.argmax(reasons != 0))
            reason = _reason(int(reasons[k]), *facts[k].tolist())
            self._first = Health(1, float(path.stamps[k]), reason)
        self._count += int(np.count_nonzero(reasons))
        self._at_end = int(reasons[-1]), *facts[-1].tolist()


@kernel
def _judge(
    walked: Array, fresh: Mask, poses: Array, covariances: Array, valid: Mask, contradicted: Mask
) -> tuple[np.ndarray, Array]:
    """Return why each of m poses is unreliable, and (m, 2) m: way and growth of sigma since a match.

    walked (4,) is x, y of the last pose, the way since the last match and the variance there; it is
    carried on. fresh (m,): which poses are those of a match.
    """
    reasons, facts = np.zeros(len(poses), np.int8), np.empty((len(poses), 2))
    for k in range(len(poses)):
        variance = covariances[k, 0, 0] + covariances[k, 1, 1]
        if fresh[k]:
            walked[2], walked[3] = 0.0, variance
        else:
            walked[2] += math.hypot(poses[k, 0] - walked[0], poses[k, 1] - walked[1])
        walked[0], walked[1] = poses[k, 0], poses[k, 1]
        facts[k] = walked[2], math.sqrt(max(variance - walked[3], 0.0))
        if not math.isfinite(variance):
            reasons[k] = NOT_FINITE
        elif facts[k, 1] > LOST:
            reasons[k] = GROWN
        elif contradicted[k]:
            reasons[k] = CONTRADICTED
        elif not valid[k].any():
            reasons[k] = BLIND
    return reasons, facts


def _reason(reason: int, way: float, grown: float) -> str:
    """Return why a pose is unreliable, or ""."""
    return {
        NOT_FINITE: "the estimate is not finite; start a new map",
        GROWN: f"nothing known was seen for {way:.1f} m, position uncertain by {grown:.1f} m",
        CONTRADICTED: "the scans show another motion than odometry; the pose follows the scans",
        BLIND: "the scan has no valid range; the pose is dead-reckoned",
    }.get(reason, "")
