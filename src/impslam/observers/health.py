"""Records for every scan whether its pose can be trusted, and why not."""

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

MAX_GROWTH = 0.25
"""Growth of the position's standard deviation, m, beyond which landmarks in a room may be confused:
they are 0.5 m or more apart."""


class HealthMonitor(Observer):
    """Combines the health that the tracker reports for each scan with that of the estimate.

    The estimate is unhealthy if it is not finite, if the position uncertainty has grown by more than
    `MAX_GROWTH` since the last match (of a landmark, of a scan with a map, or of a place), or if the scan
    has no valid beam. The growth counts, not the uncertainty itself, which is large far from the start;
    a stationary robot may see no landmark for long. A robot that is lost, or whose place in the map is
    not known yet, stays so until a place is recognised. A reason given by `LandmarkWatch` for a keyframe
    holds until the next keyframe. `standing` is a problem with the whole run, found before it began; it
    is reported for scans without a worse reason.
    """

    def __init__(self, standing: Standing = SOUND) -> None:
        self._standing = standing
        # x, y of the last pose, distance since a match, variance there; lasting reason and its amount
        self._carried = np.zeros(6)
        self._fresh = True  # no pose yet, or landmarks were recognised
        self._drift = 0.0  # variance of the motion since landmarks determined the position, m^2
        self._landmarks = LandmarkWatch()
        self._stamps, self._amounts = GrowingArray(), GrowingArray()
        self._reasons = GrowingArray(dtype=np.int8)

    @property
    def health(self) -> Health:
        """Health of all scans so far."""
        return Health(self._stamps.array, self._reasons.array, self._amounts.array)

    @property
    def newest(self) -> tuple[int, str]:
        """The reason of the newest scan, as a code and in words."""
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
        self._drift += keyframe.motion.covariance[0, 0] + keyframe.motion.covariance[1, 1]
        if self._is_located(keyframe, revision, path):
            self._fresh, self._drift = True, 0.0
        self._fresh |= recognised
        if (revision.matches or recognised) and placed and lost[0] >= ELSEWHERE:
            lost[0] = NONE
        reason_amount = self._landmarks.revise(keyframe, revision)
        if lost[0] < ELSEWHERE:
            lost[:] = reason_amount
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

    def _is_located(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> bool:
        """Return whether the matched landmarks determine the position and undo its uncertainty's growth.

        Landmarks added since do not undo it.
        """
        variance = path.covariances[0, 0, 0] + path.covariances[0, 1, 1]
        has_grown = min(self._drift, variance - self._carried[3]) > MAX_GROWTH**2
        seen = (keyframe.observations[match.observation] for match in revision.matches)
        return not has_grown and is_located(seen)

    def _record(
        self, path: PathRows, seen: Mask, reasons: Reasons, amounts: Array, fresh: Mask
    ) -> None:
        fresh[:1] |= self._fresh
        self._fresh = False
        _apply_worse(self._carried, fresh, path.poses, path.covariances, seen, reasons, amounts)
        better = reasons < self._standing.reason
        reasons[better], amounts[better] = self._standing
        m = len(reasons)
        self._stamps.append(path.stamps, m)
        self._reasons.append(reasons, m)
        self._amounts.append(amounts, m)


@kernel
def _apply_worse(
    carried: Array,
    fresh: Mask,
    poses: Array,
    covariances: Array,
    seen: Mask,
    reasons: Reasons,
    amounts: Array,
) -> None:
    """Replace the tracker's reasons (m,) and amounts (m,) by worse ones of the estimate, in place.

    carried (6,) is x, y of the last pose, the distance since the last match, the variance there, and the
    lasting reason with its amount. fresh (m,): poses with a match; seen (m,): scans with a valid beam.
    """
    walked, lost = carried[:4], carried[4:]
    for k in range(len(poses)):
        variance = covariances[k, 0, 0] + covariances[k, 1, 1]
        if fresh[k]:
            walked[2], walked[3] = 0.0, variance
        else:
            walked[2] += math.hypot(poses[k, 0] - walked[0], poses[k, 1] - walked[1])
        walked[0], walked[1] = poses[k, 0], poses[k, 1]
        grown = variance - walked[3] > MAX_GROWTH**2
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
