"""Detect a robot that was carried: from one scan to the next, static objects vanish or appear.

A point is static if scans a second apart, and one halfway between them, agree on it. If the robot was moved
while odometry stood still, the next scan passes through static points of the scan before, or its own points
that prove static later lie in the free space of the scan before. People who walk past are left out, because
they are not static. On rough ground, a lidar that pitches misses objects in a single scan, so a second scan
has to confirm it. Until it is known whether new points are static, a scan with many of them is in doubt.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.columns import Motions
from impslam.geometry.chain import advance_pose
from impslam.geometry.kernels import kernel
from impslam.tracking.beams import BeamColumns, Geometry
from impslam.tracking.contradictions import (
    CLEARANCE,
    MIN_INCIDENCE,
    TURN_CLEARANCE,
    diagonal,
    empty_box,
    free_ranges,
    widen,
)
from impslam.tracking.per_lidar import PerLidar
from impslam.tracking.reference_scan import laser_motion, ranges_at_once, seen_from
from impslam.types import Array, Ints, Mask

STATIC_TIME = 1.0
"""s between two scans that show a static point: a person who walks moves by a metre. One who turns back is
at the same place again, but was not halfway."""
RANGE_TOLERANCE = 0.1
"""m by which their ranges may differ: noise, and the error of odometry within that time."""
MAX_INTERVAL = 0.5
"""s between the scans that are compared; in a longer time doors and people move."""
MIN_SHARE, MIN_BEAMS = 0.025, 10
"""Share of the beams, and number, that show a change. In drives past people it is below 0.02."""
MIN_DOUBTED = 0.12
"""Share of the beams that end in the free space of the scan before, above which a scan is in doubt. In two
hours of recorded drives it is exceeded four times, where people step in front of the lidar."""
TOGETHER = 1.5
"""s: changes within this time may have one cause; that a point appeared is known `STATIC_TIME` later."""
SIDE_BEAMS, MAX_SIDE = 4, 1.0
"""Beams on either side of a point, and m between their ends, that show the direction of its surface."""
MAX_SCANS = 64
"""Scans that are kept: those of `STATIC_TIME` up to 60 Hz; of a faster lidar, a shorter time."""


class PastScans(NamedTuple):
    """The last scans of one lidar, a ring buffer; kernels change it in place.

    Attributes
    ----------
    ranges : (MAX_SCANS, n) m, 0 where invalid
    free : (MAX_SCANS, n) m, their `free_ranges`
    poses, times : (MAX_SCANS, 3) and (MAX_SCANS,) s by odometry
    added, first : (1,) number of scans so far, and the first of them that is still compared
    judged : (1,) number of scans whose points have been found static or not
    unconfirmed : (1,) the scan before a change that is to be confirmed, else -1
    place : (1,) the number of the place that the lidar is at; see `carried`
    box : (2, 2) m, lowest and highest x and y of the points that show the newest changes
    changed : (1,) s, time of the newest change
    doubt : (3,) s and share of the beams of the newest scan with which a doubt began; and s, time of the
        newest scan with as many new points
    """

    ranges: Array
    free: Array
    poses: Array
    times: Array
    added: Ints
    first: Ints
    judged: Ints
    unconfirmed: Ints
    place: Ints
    box: Array
    changed: Array
    doubt: Array


def no_past(beams: int) -> PastScans:
    """Return the state of a lidar with this number of beams before its first scan."""
    return PastScans(
        np.zeros((MAX_SCANS, beams)),
        np.zeros((MAX_SCANS, beams)),
        np.zeros((MAX_SCANS, 3)),
        np.zeros(MAX_SCANS),
        added=np.zeros(1, np.int64),
        first=np.zeros(1, np.int64),
        judged=np.zeros(1, np.int64),
        unconfirmed=np.full(1, -1),
        place=np.zeros(1, np.int64),
        box=np.zeros((2, 2)),
        changed=np.full(1, -math.inf),
        doubt=np.array([-math.inf, 0.0, -math.inf]),
    )


class JumpCheck:
    """Compares the scans of each lidar with those before."""

    def __init__(self) -> None:
        self._pose, self._time = np.zeros(3), np.zeros(1)
        self._past = PerLidar(no_past)

    def find(self, motions: Motions, beams: BeamColumns, sensor: str) -> tuple[Array, Mask]:
        """Return the share (m,) of the beams that show a jump, else 0, and whether it is confirmed (m,).

        `motions` are those before each of these scans, since the scan of any lidar before.
        """
        m, n = beams.ranges.shape
        past, results = self._past.get(sensor, n), (np.zeros(m), np.zeros(m, np.bool_))
        _find(motions, beams, self._pose, self._time, past, results)
        return results


@kernel
def _find(
    motions: Motions,
    beams: BeamColumns,
    pose: Array,
    time: Array,
    past: PastScans,
    results: tuple[Array, Mask],
) -> None:
    """Fill the shares (m,) and confirmations (m,) of scans; pose (3,) and time (1,) move along."""
    shares, confirmed = results
    for k in range(len(motions.d_pose)):
        advance_pose(pose, motions.d_pose[k])
        time[0] += motions.duration[k]
        ranges = ranges_at_once(beams.ranges[k], beams.directions[k], beams.geometry)
        shares[k], _, confirmed[k] = find_change(ranges, pose, time[0], past, beams.geometry)


@kernel
def find_change(
    ranges: Array, pose: Array, time: float, past: PastScans, geometry: Geometry
) -> tuple[float, float, bool]:
    """Add a scan at a pose (3,) and time; return the change that it shows.

    `ranges` (n,) are as if taken at once, 0 where invalid. Returned are the share of the beams that show
    the change, 0 without one; the extent of these points and those of other changes within `TOGETHER`, m;
    and whether another scan confirms it.
    """
    if time > past.changed[0] + TOGETHER:
        past.box[:] = empty_box()
    judged, new = past.judged, past.added[0]
    past.added[0] += 1
    row = new % MAX_SCANS
    past.ranges[row], past.free[row] = ranges, free_ranges(ranges, geometry)
    past.poses[row], past.times[row] = pose, time
    judged[0] = max(judged[0], new - MAX_SCANS + 3, past.first[0])
    share, confirmed = _vanished(new, past, geometry)
    while judged[0] < new and past.times[judged[0] % MAX_SCANS] <= time - STATIC_TIME:
        scan = judged[0]
        appeared = _changed(new, scan, scan - 1, past, geometry, past.box)
        if appeared > 0.0 and _changed(new, scan, scan - 2, past, geometry, past.box) > 0.0:
            share, confirmed = max(appeared, share), True
        judged[0] += 1
    if share == 0.0:
        return 0.0, 0.0, False
    past.changed[0] = time
    return share, diagonal(past.box), confirmed


@kernel
def doubted_share(past: PastScans, geometry: Geometry) -> float:
    """Return the share of a scan in doubt, from that scan until its points are judged; else 0.

    A doubt begins if much of the newest scan is new, unless it was for each scan, as with bad matches.
    If time stands still, as in a log without stamps, points are never judged, so there is no doubt.
    """
    new = past.added[0] - 1
    if new > 0 and past.times[new % MAX_SCANS] <= past.times[(new - 1) % MAX_SCANS]:
        return 0.0
    share = _changed(new, new, new - 1, past, geometry, empty_box())
    time, doubt = past.times[new % MAX_SCANS], past.doubt
    if share > MIN_DOUBTED:
        if time > doubt[2] + STATIC_TIME:
            doubt[0], doubt[1] = time, share
        doubt[2] = time
    return float(doubt[1]) if time < doubt[0] + STATIC_TIME else 0.0


@kernel
def forget(past: PastScans) -> None:
    """Compare later scans only with each other: the robot is elsewhere."""
    past.judged[0] = past.first[0] = past.added[0]
    past.unconfirmed[0] = -1
    past.changed[0] = past.doubt[0] = past.doubt[2] = -math.inf


@kernel
def _vanished(new: int, past: PastScans, geometry: Geometry) -> tuple[float, bool]:
    """Return the share of the static points that a scan misses, and whether it confirms the last change."""
    before = past.unconfirmed[0]
    if before >= 0:
        past.unconfirmed[0] = -1
        share = _changed(_earlier(before, past), before, new, past, geometry, past.box)
        if share > 0.0:
            return share, True
    share = _changed(_earlier(new - 1, past), new - 1, new, past, geometry, past.box)
    if share > 0.0:
        past.unconfirmed[0] = new - 1
    return share, False


@kernel
def _earlier(scan: int, past: PastScans) -> int:
    """Return the newest scan that is at least `STATIC_TIME` older than this one, -1 without one."""
    oldest = max(past.added[0] - MAX_SCANS, past.first[0])
    for k in range(scan - 1, oldest - 1, -1):
        if past.times[k % MAX_SCANS] <= past.times[scan % MAX_SCANS] - STATIC_TIME:
            return k
    return -1


@kernel
def _changed(
    still: int, scan: int, beside: int, past: PastScans, geometry: Geometry, box: Array
) -> float:
    """Return the share of the points of a scan that are static but not in the one beside it in time.

    Static are points that the scan `still` and one halfway to it show as well. It is 0 if too small, else
    the points widen the box (2, 2).
    """
    interval = past.times[scan % MAX_SCANS] - past.times[beside % MAX_SCANS]
    if min(still, beside) < past.first[0] or abs(interval) > MAX_INTERVAL:
        return 0.0
    halfway = _halfway(still, scan, past)
    still, scan, beside = still % MAX_SCANS, scan % MAX_SCANS, beside % MAX_SCANS
    ranges, opposite, free = past.ranges[scan], past.ranges[beside], past.free[beside]
    to_still = laser_motion(past.poses[still], past.poses[scan], geometry)
    to_halfway = laser_motion(past.poses[halfway], past.poses[scan], geometry)
    to_beside = laser_motion(past.poses[beside], past.poses[scan], geometry)
    view, laser = _view(to_beside, geometry), past.poses[scan].copy()
    advance_pose(laser, geometry.laser)
    heading = _direction(laser[2])
    changed, count, around = 0, 0, empty_box()
    ahead, step = _direction(geometry.first), _direction(geometry.spacing)
    for i in range(len(ranges)):
        beam, ahead = ahead, _turned(ahead, step)
        if ranges[i] <= 0.0:
            continue
        count += 1
        if _is_not_free(i, ranges[i], beam, opposite, view, geometry):  # nearly always; much faster
            continue
        k, reach = seen_from(i, ranges[i], to_beside, len(ranges), geometry)
        if (
            k >= 0
            and reach < free[k] - CLEARANCE
            and _faces(i, ranges, to_beside, geometry)
            and _shows(still, i, ranges[i], to_still, past, geometry)
            and _shows(halfway, i, ranges[i], to_halfway, past, geometry)
        ):
            changed += 1
            end = _turned((ranges[i] * beam[0], ranges[i] * beam[1]), heading)
            widen(around, laser[0] + end[0], laser[1] + end[1])
    if changed < MIN_BEAMS or changed <= MIN_SHARE * count:
        return 0.0
    for corner in around:
        widen(box, corner[0], corner[1])
    return changed / count


@kernel
def _faces(i: int, ranges: Array, T_other_laser: Array, geometry: Geometry) -> bool:
    """Return whether another laser sees the surface at the end of beam i from ahead, not along it.

    The surface is the line through the ends of the beams on either side. An object that is alone has none.
    """
    for step in (SIDE_BEAMS, 1):
        a, b = i - step, i + step
        if a < 0 or b >= len(ranges) or ranges[a] <= 0.0 or ranges[b] <= 0.0:
            continue
        one = _direction(geometry.first + a * geometry.spacing)
        other = _direction(geometry.first + b * geometry.spacing)
        x, y = ranges[b] * other[0] - ranges[a] * one[0], ranges[b] * other[1] - ranges[a] * one[1]
        length = math.hypot(x, y)
        if length > MAX_SIDE or length == 0.0:
            continue
        beam, turn = _direction(geometry.first + i * geometry.spacing), _direction(T_other_laser[2])
        end = ranges[i] * beam[0], ranges[i] * beam[1]
        ahead, along = _turned(end, turn), _turned((x, y), turn)
        u, v = T_other_laser[0] + ahead[0], T_other_laser[1] + ahead[1]
        return bool(abs(u * along[1] - v * along[0]) > MIN_INCIDENCE * math.hypot(u, v) * length)
    return True


@kernel
def _direction(angle: float) -> tuple[float, float]:
    return math.cos(angle), math.sin(angle)


@kernel
def _turned(one: tuple[float, float], by: tuple[float, float]) -> tuple[float, float]:
    """Return a direction turned by the angle of another one."""
    return one[0] * by[0] - one[1] * by[1], one[1] * by[0] + one[0] * by[1]


@kernel
def _view(T_other_laser: Array, geometry: Geometry) -> tuple[float, float, int, float]:
    """Return how a scan is seen from the pose of another one, for `_is_not_free`.

    The values are the position of its laser, m, from the other laser, along its own axes; the difference
    between beams of the same direction; and the tangent of the angle at a point between both lasers up to
    which a beam found with that angle is within `TURN_CLEARANCE` of the one that points there: x differs
    from atan(x) by at most x^3 / 3, and three numbers are rounded to half a beam.
    """
    c, s = _direction(T_other_laser[2])
    x, y = c * T_other_laser[0] + s * T_other_laser[1], c * T_other_laser[1] - s * T_other_laser[0]
    room = TURN_CLEARANCE - 1.5 * abs(geometry.spacing)
    if geometry.spacing == 0.0 or room <= 0.0:
        return x, y, 0, 0.0
    shift = math.floor(T_other_laser[2] / geometry.spacing + 0.5)
    return x, y, shift, (3.0 * room) ** (1.0 / 3.0)


@kernel
def _is_not_free(
    i: int,
    reach: float,
    beam: tuple[float, float],
    other: Array,
    view: tuple[float, float, int, float],
    geometry: Geometry,
) -> bool:
    """Return True if the end of beam i is certainly not in the free space of another scan.

    `beam` is its direction. A beam of the other scan, with ranges (n,), that is within `TURN_CLEARANCE` of
    the one that points there bounds the `free_ranges` of that one.
    """
    x, y, shift, limit = view
    along, across = reach + x * beam[0] + y * beam[1], y * beam[0] - x * beam[1]
    if not abs(across) < limit * along:
        return False
    k = i + shift + math.floor(across / (along * geometry.spacing) + 0.5)
    return 0 <= k < len(other) and along >= other[k] - CLEARANCE


@kernel
def _halfway(one: int, other: int, past: PastScans) -> int:
    """Return the row of the scan in the middle of the time between two scans."""
    first, last = min(one, other), max(one, other)
    middle = 0.5 * (past.times[first % MAX_SCANS] + past.times[last % MAX_SCANS])
    k = first
    while k < last and past.times[k % MAX_SCANS] < middle:
        k += 1
    return k % MAX_SCANS


@kernel
def _shows(
    row: int, i: int, reach: float, T_row_laser: Array, past: PastScans, geometry: Geometry
) -> bool:
    """Return whether the scan in a row shows the end of beam i of another one, at its range in m.

    `T_row_laser` (3,) is the pose of the other scan's laser in that of this one.
    """
    ranges = past.ranges[row]
    beam, there = seen_from(i, reach, T_row_laser, len(ranges), geometry)
    for k in range(max(beam - 1, 0), min(beam + 2, len(ranges))):
        if beam >= 0 and abs(ranges[k] - there) < RANGE_TOLERANCE:
            return True
    return False
