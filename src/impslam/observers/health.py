"""Records for every scan whether its pose can be trusted, and why not."""

from __future__ import annotations

import math

import numpy as np

from impslam.geometry.kernels import kernel, read_only
from impslam.geometry.se2 import compose_uncertain
from impslam.growing_array import GrowingArray
from impslam.health import (
    AMBIGUOUS,
    ASSUMED,
    BLIND,
    CONTRADICTED,
    ELSEWHERE,
    GROWN,
    MAX_GROWTH,
    NO_FAULT,
    NONE,
    NOT_FINITE,
    UNPLACED,
    Health,
    LogFault,
    Reasons,
    describe,
)
from impslam.map import Keyframe, PathRows, Revision, Track
from impslam.observers.base import Observer
from impslam.observers.landmark_watch import LandmarkWatch, is_located
from impslam.types import Array, Mask


class HealthMonitor(Observer):
    """Combines the health that the tracker reports for each scan with that of the estimate.

    The estimate is unhealthy if it is not finite, if the position uncertainty has grown by more than
    `MAX_GROWTH` since the last match (of a landmark, of a scan with a map, or of a place), or if the scan
    has no valid beam. The growth is that of the motion since the match: far from the start, where the
    heading is uncertain, the variance in the map changes with every step. A robot that is lost, or whose
    place in the map is not known yet, stays so until a place is recognised. A reason given by
    `LandmarkWatch` for a keyframe holds until the next keyframe. `fault` is one of the whole
    log, found before the run; it is reported for scans without a worse reason.
    """

    def __init__(self, fault: LogFault = NO_FAULT) -> None:
        self._fault = fault
        # x, y of the last pose, distance since a match, variance there; lasting reason and its amount
        self._carried = np.zeros(6)
        self._fresh = True  # no pose yet, or landmarks were recognised
        # the keyframe at or before the last match, to the newest one; variance from there to the match
        self._T_match_keyframe, self._spread = np.zeros(3), np.zeros((3, 3))
        self._known = np.zeros(1)
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
        fresh = track.located.copy()
        fresh[:1] |= self._fresh
        growths = self._growths(track.T_anchor_base, track.covariance, fresh)
        self._record(path, seen, track.reasons.copy(), track.amounts.copy(), fresh, growths)

    def revise(self, keyframe: Keyframe, revision: Revision, path: PathRows) -> None:
        """Record the scan of a keyframe."""
        lost, placed = self._carried[4:], revision.is_placed
        recognised = len(revision.ids) > 1  # a place is known
        growths = self._advance(keyframe)
        fresh = self._fresh or recognised or keyframe.located
        fresh |= self._is_located(keyframe, revision, path, float(growths[0]))
        if fresh:
            self._restart()
        if (revision.matches or recognised) and placed and lost[0] >= ELSEWHERE:
            lost[0] = NONE
        reason_amount = self._landmarks.revise(keyframe, revision)
        if lost[0] < ELSEWHERE:
            lost[:] = reason_amount
        if revision.fits_elsewhere and lost[0] < AMBIGUOUS:
            lost[:] = AMBIGUOUS, 0.0
        if revision.assumed and lost[0] < ASSUMED:
            lost[:] = ASSUMED, 0.0
        if revision.contradicted and lost[0] < CONTRADICTED:
            lost[:] = CONTRADICTED, 0.0
        if not placed and lost[0] < ELSEWHERE:
            lost[:] = UNPLACED, 0.0
        seen = keyframe.scan is None or bool(keyframe.scan.valid.any())
        self._record(
            path,
            np.array([seen]),
            np.array([keyframe.reason], np.int8),
            np.array([keyframe.amount]),
            np.array([fresh]),
            growths,
        )

    def _growths(self, T: Array, spreads: Array, fresh: Mask) -> Array:
        """Return the growth (m,) of the variance since the last match, m^2.

        T (m, 3) and spreads (m, 3, 3) are the motion since the newest keyframe; fresh (m,) marks matches.
        """
        T, spreads = read_only(T, spreads)
        return _growths(self._T_match_keyframe, self._spread, self._known, T, spreads, fresh)

    def _advance(self, keyframe: Keyframe) -> Array:
        """Make this keyframe the newest one; return the growth (1,) of the variance until there, m^2."""
        if keyframe.lost:  # the motion is unknown
            self._restart()
            return np.zeros(1)
        motion = keyframe.motion.d_pose, keyframe.motion.covariance
        growths = self._growths(motion[0][None], motion[1][None], np.zeros(1, np.bool_))
        base = compose_uncertain(self._T_match_keyframe, self._spread, *motion)
        self._T_match_keyframe[:], self._spread[:] = base
        return growths

    def _restart(self) -> None:
        for part in (self._T_match_keyframe, self._spread, self._known):
            part[:] = 0.0

    def _is_located(
        self, keyframe: Keyframe, revision: Revision, path: PathRows, growth: float
    ) -> bool:
        """Return whether the matched landmarks determine the position and undo its uncertainty's growth.

        Landmarks added since do not undo it.
        """
        variance = path.covariances[0, 0, 0] + path.covariances[0, 1, 1]
        has_grown = min(growth, variance - self._carried[3]) > MAX_GROWTH**2
        seen = (keyframe.observations[match.observation] for match in revision.matches)
        return not has_grown and is_located(seen)

    def _record(
        self,
        path: PathRows,
        seen: Mask,
        reasons: Reasons,
        amounts: Array,
        fresh: Mask,
        growths: Array,
    ) -> None:
        self._fresh = False
        blind = ~seen & (reasons < BLIND)
        reasons[blind], amounts[blind] = BLIND, 0.0
        estimate = path.poses, path.covariances, growths
        _apply_worse(self._carried, fresh, *estimate, reasons, amounts)
        better = reasons < self._fault.reason
        reasons[better], amounts[better] = self._fault
        m = len(reasons)
        self._stamps.append(path.stamps, m)
        self._reasons.append(reasons, m)
        self._amounts.append(amounts, m)


@kernel
def _growths(
    T_match_keyframe: Array, P: Array, known: Array, T: Array, spreads: Array, fresh: Mask
) -> Array:
    """Return the growth (m,) of the variance of the position since the last match, m^2.

    P (3, 3) is the covariance of `T_match_keyframe`, T (m, 3) and spreads (m, 3, 3) the motion since that
    keyframe, `known` (1,) the variance that is not counted. A match, `fresh` (m,), restarts them in place
    at the newest keyframe.
    """
    growths = np.empty(len(T))
    for k in range(len(T)):
        variance = spreads[k, 0, 0] + spreads[k, 1, 1]
        if fresh[k]:
            T_match_keyframe[:], P[:], known[0] = 0.0, 0.0, variance
        c, s = math.cos(T_match_keyframe[2]), math.sin(T_match_keyframe[2])
        x, y = c * T[k, 0] - s * T[k, 1], s * T[k, 0] + c * T[k, 1]
        turned = (x * x + y * y) * P[2, 2] + 2.0 * (x * P[1, 2] - y * P[0, 2])
        growths[k] = P[0, 0] + P[1, 1] + turned + variance - known[0]
    return growths


@kernel
def _apply_worse(
    carried: Array,
    fresh: Mask,
    poses: Array,
    covariances: Array,
    growths: Array,
    reasons: Reasons,
    amounts: Array,
) -> None:
    """Replace the tracker's reasons (m,) and amounts (m,) by worse ones of the estimate, in place.

    carried (6,) is x, y of the last pose, the distance since the last match, the variance there, and the
    lasting reason with its amount. fresh (m,): poses with a match; growths (m,): see
    `_growths`.
    """
    walked, lost = carried[:4], carried[4:]
    for k in range(len(poses)):
        variance = covariances[k, 0, 0] + covariances[k, 1, 1]
        if fresh[k]:
            walked[2], walked[3] = 0.0, variance
        else:
            walked[2] += math.hypot(poses[k, 0] - walked[0], poses[k, 1] - walked[1])
        walked[0], walked[1] = poses[k, 0], poses[k, 1]
        grown = min(growths[k], variance - walked[3]) > MAX_GROWTH**2
        if reasons[k] == ELSEWHERE:
            lost[0], lost[1] = float(ELSEWHERE), amounts[k]
        if not math.isfinite(variance):
            reasons[k], amounts[k] = NOT_FINITE, 0.0
        elif lost[0] > reasons[k]:
            reasons[k], amounts[k] = int(lost[0]), lost[1]
        elif grown and reasons[k] < GROWN:
            reasons[k], amounts[k] = GROWN, walked[2]
