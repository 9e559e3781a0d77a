"""Detect a robot that was carried: from one scan to the next, static objects vanish or appear.

A point is static if scans a second apart agree on it. If the robot was moved while odometry stood still,
the next scan passes through static points of the scan before, or its own points that prove static later lie
in the free space of the scan before. People who walk past are left out, because they are not static. On
rough ground, a lidar that pitches misses objects in a single scan, so a second scan has to confirm it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.columns import Motions, Scans
from impslam.geometry.chain import advance_pose
from impslam.geometry.kernels import kernel, plain
from impslam.tracking.contradictions import CLEARANCE, free_ranges
from impslam.tracking.reference_scan import Geometry, geometry_of, laser_motion, seen_from
from impslam.types import Array, Ints, Mask

STATIC_TIME = 1.0
"""s between two scans that show a static point: a person who walks moves by a metre."""
RANGE_TOLERANCE = 0.1
"""m by which their ranges may differ: noise, and the error of odometry within that time."""
MAX_INTERVAL = 0.5
"""s between the scans that are compared; in a longer time doors and people move."""
MIN_SHARE, MIN_BEAMS = 0.025, 10
"""Share of the beams, and number, that show a change. In drives past people it is below 0.02."""
MAX_SCANS = 64
"""Scans that are kept: those of `STATIC_TIME` up to 60 Hz; of a faster lidar, a shorter time."""


class PastScans(NamedTuple):
    """The last scans of one lidar, a ring buffer; kernels change it in place.

    Attributes
    ----------
    ranges : (MAX_SCANS, n) m, 0 where invalid
    free : (MAX_SCANS, n) m, their `free_ranges`
    poses, times : (MAX_SCANS, 3) and (MAX_SCANS,) s by odometry
    counts : (3,) scans added so far; scans whose points have been found static or not; and the scan
        before a change that is to be confirmed, else -1
    """

    ranges: Array
    free: Array
    poses: Array
    times: Array
    counts: Ints


class JumpCheck:
    """Compares the scans of each lidar with those before."""

    def __init__(self) -> None:
        self._pose, self._time = np.zeros(3), np.zeros(1)
        self._past: dict[str, PastScans] = {}

    def find(self, motions: Motions, scans: Scans, sensor: str) -> tuple[Array, Mask]:
        """Return the share (m,) of the beams that show a jump, else 0, and whether it is confirmed (m,).

        `motions` are those before each of these scans, since the scan of any lidar before.
        """
        m, beams = scans.ranges.shape
        shares, confirmed, past = np.zeros(m), np.zeros(m, np.bool_), self._past.get(sensor)
        if past is None or past.ranges.shape[1] != beams:
            past = PastScans(
                np.zeros((MAX_SCANS, beams)),
                np.zeros((MAX_SCANS, beams)),
                np.zeros((MAX_SCANS, 3)),
                np.zeros(MAX_SCANS),
                np.array([0, 0, -1]),
            )
            self._past[sensor] = past
        ranges = plain(np.where(scans.valid, scans.ranges, 0.0))
        motion = plain(motions.d_pose), plain(motions.duration)
        now, results = (self._pose, self._time), (shares, confirmed)
        _find(motion, ranges, now, past, geometry_of(scans), results)
        return results


@kernel
def _find(
    motions: tuple[Array, Array],
    ranges: Array,
    now: tuple[Array, Array],
    past: PastScans,
    geometry: Geometry,
    results: tuple[Array, Mask],
) -> None:
    (d_pose, duration), (pose, time), counts = motions, now, past.counts
    shares, confirmed = results
    for k in range(len(d_pose)):
        advance_pose(pose, d_pose[k])
        time[0] += duration[k]
        new = counts[0]
        counts[0] += 1
        row = new % MAX_SCANS
        past.ranges[row], past.free[row] = ranges[k], free_ranges(ranges[k], geometry)
        past.poses[row], past.times[row] = pose, time[0]
        counts[1] = max(counts[1], new - MAX_SCANS + 3)
        shares[k], confirmed[k] = _vanished(new, past, geometry)
        while counts[1] < new and past.times[counts[1] % MAX_SCANS] <= time[0] - STATIC_TIME:
            scan = counts[1]
            share = _changed(new, scan, scan - 1, past, geometry)
            if share > 0.0 and _changed(new, scan, scan - 2, past, geometry) > 0.0:
                shares[k], confirmed[k] = max(share, shares[k]), True
            counts[1] += 1


@kernel
def _vanished(new: int, past: PastScans, geometry: Geometry) -> tuple[float, bool]:
    """Return the share of static points that this scan misses, and whether it confirms the last scan."""
    before = past.counts[2]
    if before >= 0:
        past.counts[2] = -1
        share = _changed(_earlier(before, past), before, new, past, geometry)
        if share > 0.0:
            return share, True
    share = _changed(_earlier(new - 1, past), new - 1, new, past, geometry)
    if share > 0.0:
        past.counts[2] = new - 1
    return share, False


@kernel
def _earlier(scan: int, past: PastScans) -> int:
    """Return the newest scan that is at least `STATIC_TIME` older than this one, -1 without one."""
    oldest = max(past.counts[0] - MAX_SCANS, 0)
    for k in range(scan - 1, oldest - 1, -1):
        if past.times[k % MAX_SCANS] <= past.times[scan % MAX_SCANS] - STATIC_TIME:
            return k
    return -1


@kernel
def _changed(still: int, scan: int, beside: int, past: PastScans, geometry: Geometry) -> float:
    """Return the share of the points of a scan that are static but not in the scan beside it in time.

    Static are points that the scan `still` shows as well. The share is 0 if it is too small.
    """
    if still < 0 or beside < 0:
        return 0.0
    still, scan, beside = still % MAX_SCANS, scan % MAX_SCANS, beside % MAX_SCANS
    if abs(past.times[scan] - past.times[beside]) > MAX_INTERVAL:
        return 0.0
    ranges, free = past.ranges[scan], past.free[beside]
    to_still = laser_motion(past.poses[still], past.poses[scan], geometry)
    to_beside = laser_motion(past.poses[beside], past.poses[scan], geometry)
    changed = count = 0
    for i in range(len(ranges)):
        if ranges[i] <= 0.0:
            continue
        count += 1
        k, reach = seen_from(i, ranges[i], to_beside, len(ranges), geometry)
        if k >= 0 and reach < free[k] - CLEARANCE:
            k, reach = seen_from(i, ranges[i], to_still, len(ranges), geometry)
            changed += k >= 0 and _measured(past.ranges[still], k, reach)
    share = changed / max(count, 1)
    return share if changed >= MIN_BEAMS and share > MIN_SHARE else 0.0


@kernel
def _measured(ranges: Array, k: int, reach: float) -> bool:
    """Return whether beam k or one beside it has about this range."""
    for i in range(max(k - 1, 0), min(k + 2, len(ranges))):
        if abs(ranges[i] - reach) < RANGE_TOLERANCE:
            return True
    return False
