"""Records of every scan whether its pose can be trusted, and why not."""

from __future__ import annotations

import math

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.growing import GrowingArray
from impslam.health import (
    ASSUMED,
    BLIND,
    ELSEWHERE,
    GROWN,
    NONE,
    NOT_FINITE,
    SOUND,
    UNPLACED,
    Health,
    Reasons,
    Standing,
    describe,
)
from impslam.map import Keyframe, PathRows, Revision, Track
from impslam.observers.base import Observer
from impslam.observers.landmark_watch import LandmarkWatch, is_located
from impslam.types import Array, Mask

UNCERTAIN = 0.25
"""m, 1 sigma: beyond this a landmark in a room may be mistaken for another one, because landmarks are
0.5 m or more apart."""


class HealthMonitor(Observer):
    """Joins what the tracker tells of each scan with what the estimate tells.

    The estimate tells that it is not finite, that the position uncertainty has grown by more than
    `UNCERTAIN` since the last match (of a landmark, of a scan with a map, or of a place), or that a scan
    has no valid beam. The growth counts, not the uncertainty itself, which is large far from the start;
    a robot that stands still may see no landmark for long. A robot that is lost stays so until a place
    is recognised, and so does one of which it is not known yet where in the map it is. What
    `LandmarkWatch` tells of a keyframe holds until the next one. `standing` is what was found to be wrong
    with all of the run before it began; it is told where nothing worse is.
    """

    def __init__(self, standing: Standing = SOUND) -> None:
        self._standing = standing
        # x, y of the last pose, way since a match, variance there; reason and amount that last
        self._carried = np.zeros(6)
        self._fresh = True  # no pose yet, or landmarks were recognised
        self._driven = 0.0  # variance in m^2 of the motion since landmarks told the position
        self._landmarks = LandmarkWatch()
        self._stamps, self._amounts = GrowingArray(), GrowingArray()
        self._reasons = GrowingArray(dtype=np.int8)

    @property
    def health(self) -> Health:
        """Health of all scans so far."""
        return Health(self._stamps.array, self._reasons.array, self._amounts.array)

    @property
    def newest(self) -> tuple[int, str]:
        """The reason of the newest scan, and its words."""
        if not len(self._reasons):
            return NONE, ""
        reason = int(self._reasons.array[-1])
        return reason, describe(reason, float(self._amounts.array[-1]))

    def follow(self, track: Track, path: PathRows) -> None:
        """Record the scans of a track."""
        scans = track.sweeps.scans
        valid = np.ones((len(path.stamps), 1), np.bool_)
        if scans is not None:
            valid = scans.valid[track.rows]
        seen = np.asarray(valid.any(axis=1))
        self._record(path, seen, track.reasons.copy(), track.amounts.copy(), track.located.copy())

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Record the scan of a keyframe."""
        lost, placed = self._carried[4:], bool(np.ravel(revision.placed)[-1])
        recognised = len(revision.ids) > 1  # a place is known
        self._driven += keyframe.motion.covariance[0, 0] + keyframe.motion.covariance[1, 1]
        if self._is_sure(keyframe, revision, path):
            self._fresh, self._driven = True, 0.0
        self._fresh |= recognised
        if (revision.matches or recognised) and placed and lost[0] >= ELSEWHERE:
            lost[0] = NONE
        told = self._landmarks.revise(keyframe, revision)
        if lost[0] < ELSEWHERE:
            lost[:] = told
        if revision.assumed and lost[0] < ASSUMED:
            lost[:] = ASSUMED, 0.0
        if not placed and lost[0] < ELSEWHERE:
            lost[:] = UNPLACED, 0.0
        seen = keyframe.scan is None or bool(keyframe.scan.valid.any())
        self._record(
            path,
            np.array([seen]),
            np.array([keyframe.reason], np.int8),
            np.array([keyframe.amount]),
            np.array([keyframe.located]),
        )

    def _is_sure(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> bool:
        """Tell whether the landmarks tell the position, and have made up for what it had grown unsure by.

        Those that are new since say nothing of that.
        """
        variance = path.covariances[0, 0, 0] + path.covariances[0, 1, 1]
        unsure = min(self._driven, variance - self._carried[3]) > UNCERTAIN**2
        seen = (keyframe.observations[match.observation] for match in revision.matches)
        return not unsure and is_located(seen)

    def _record(
        self, path: PathRows, seen: Mask, reasons: Reasons, amounts: Array, fresh: Mask
    ) -> None:
        fresh[:1] |= self._fresh
        self._fresh = False
        _judge(self._carried, fresh, path.poses, path.covariances, seen, reasons, amounts)
        better = reasons < self._standing.reason
        reasons[better], amounts[better] = self._standing
        m = len(reasons)
        self._stamps.append(path.stamps, m)
        self._reasons.append(reasons, m)
        self._amounts.append(amounts, m)


@kernel
def _judge(
    carried: Array,
    fresh: Mask,
    poses: Array,
    covariances: Array,
    seen: Mask,
    reasons: Reasons,
    amounts: Array,
) -> None:
    """Put in place of the tracker's m reasons (m,) and amounts (m,) what is worse.

    carried (6,) is x, y of the last pose, the way since the last match, the variance there, and the reason
    and the amount of what lasts: a robot is lost until it is found. fresh (m,): which poses are those of a
    match; seen (m,): which scans have a valid beam.
    """
    walked, lost = carried[:4], carried[4:]
    for k in range(len(poses)):
        variance = covariances[k, 0, 0] + covariances[k, 1, 1]
        if fresh[k]:
            walked[2], walked[3] = 0.0, variance
        else:
            walked[2] += math.hypot(poses[k, 0] - walked[0], poses[k, 1] - walked[1])
        walked[0], walked[1] = poses[k, 0], poses[k, 1]
        grown = variance - walked[3] > UNCERTAIN**2
        if reasons[k] == ELSEWHERE:
            lost[0], lost[1] = float(ELSEWHERE), amounts[k]
        if not math.isfinite(variance):
            reasons[k], amounts[k] = NOT_FINITE, 0.0
        elif lost[0] > reasons[k]:
            reasons[k], amounts[k] = int(lost[0]), lost[1]
        elif grown and reasons[k] < GROWN:
            reasons[k], amounts[k] = GROWN, walked[2]
        elif not seen[k] and reasons[k] < BLIND:
            reasons[k], amounts[k] = BLIND, 0.0
