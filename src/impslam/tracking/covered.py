"""Finds beams that end on something that moves with the robot: a cable, a cover, an arm, its own body.

Such points look like a wall that never moves, and they hold the estimated pose back. Two tests find them:

- A reference scan is kept. Once odometry reports enough motion since, each of its points should appear
  elsewhere in the scan. A beam that should measure another range by now, and does not, three times in a
  row, is hidden. So are its neighbours on the same surface: motion does not change every range of a
  round cover. This is tested only while the other beams measure what odometry's motion predicts: a slip
  also leaves ranges as they are.
- A large part of the beams becomes short from one scan to the next, while the others measure what they
  did. Nothing in a room does this, so these beams are hidden at once.

A hidden beam whose range changes is used again. If nearly all beams keep their ranges,
the robot itself is stationary; see `stall`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.columns import Scans
from impslam.geometry.chain import advance_pose
from impslam.geometry.kernels import kernel, plain
from impslam.tracking.beams import BeamColumns, Geometry, beam_columns
from impslam.tracking.reference_scan import MIN_CHANGE, MIN_MOTION, changed_beam
from impslam.types import Array, Ints, Mask

RANGE_TOLERANCE = (0.04, 0.005)
"""m, and share of the range: a smaller difference is none. 3 sigma of the noise of both ranges."""
MAX_RANGE = 1.0
"""m: a small robot carries nothing farther than this from its lidar."""
MIN_COMPARISONS = 3
"""Comparisons in a row, 0.6 m of travel, in which a beam must measure the same."""
MIN_SHARE = 0.02
"""Share of the beams, on one surface, that must do so; fewer may be a table leg or a person."""
MAX_DEVIATION = 0.5
"""A range confirms the motion if it is off by less than this share of the predicted change: more than
the error of a slipping wheel."""
MIN_CONFIRMING = 0.5
"""Share of the other ranges due to change that must confirm the motion; people and table legs do not."""
MAX_STEP_ON_SURFACE = 0.1
"""m: largest difference in range between neighbours on one surface."""
SUDDEN_COVER = (0.3, 1.2)
"""m by which beams become short between two scans, and the angle in rad that they cover together, to be a
cover. A person 0.4 m wide covers as much at 0.3 m, and takes several scans to come into view."""
MAX_SCAN_MOTION = (0.3, 0.15)
"""m, rad: after more motion between two scans they are not compared beam by beam."""
MIN_UNCHANGED = 0.5
"""Share of the other beams that must measure the same; otherwise the robot was moved elsewhere."""


class Cover(NamedTuple):
    """State of one lidar; the kernels change it in place.

    Attributes
    ----------
    ranges, points : (n,) m and (n, 2) m in base_link, of the reference scan; 0 where invalid
    last : (n,) m, ranges of the last scan; 0 where invalid
    odometry : (3,) motion since the reference scan, by odometry
    same : (n,) comparisons in a row in which the range was the same
    against : (n,) comparisons in a row in which the range was the same and should have changed
    hidden : (n,) beams to leave out
    initialised : (1,) whether there is a reference scan
    """

    ranges: Array
    points: Array
    last: Array
    odometry: Array
    same: Ints
    against: Ints
    hidden: Mask
    initialised: Mask


def initial_cover(beams: int) -> Cover:
    """Return the state before the first scan of a lidar with this number of beams."""
    counts = np.zeros((2, beams), np.int64)
    return Cover(
        np.zeros(beams), np.zeros((beams, 2)), np.zeros(beams), np.zeros(3), counts[0], counts[1],
        np.zeros(beams, np.bool_), np.zeros(1, np.bool_),
    )  # fmt: skip


def hidden_beams(d_pose: Array, scans: Scans, cover: Cover) -> Mask:
    """Return which beams (m, n) of scans to leave out; `d_pose` (m, 3) is by odometry, before each."""
    out = np.zeros(scans.valid.shape, np.bool_)
    _hide(plain(d_pose), beam_columns(scans, len(out)), cover, out)
    return out


@kernel
def _hide(d_pose: Array, beams: BeamColumns, cover: Cover, out: Mask) -> None:
    """Fill `out` (m, n) with the beams to leave out of m scans after motions (m, 3)."""
    for k in range(len(d_pose)):
        advance_pose(cover.odometry, d_pose[k])
        far = (
            math.hypot(cover.odometry[0], cover.odometry[1]) >= MIN_MOTION[0]
            or abs(cover.odometry[2]) >= MIN_MOTION[1]
        )
        sudden = _hide_sudden(d_pose[k], beams.ranges[k], abs(beams.geometry.spacing), cover)
        cover.last[:] = beams.ranges[k]
        if far or sudden or not cover.initialised[0]:
            if cover.initialised[0] and not sudden:
                _compare(beams.ranges[k], beams.geometry, cover)
            cover.initialised[0], cover.odometry[:], cover.points[:] = True, 0.0, beams.points[k]
            cover.ranges[:] = cover.last
        if cover.hidden.any():
            for i in range(len(cover.last)):
                cover.hidden[i] &= abs(cover.last[i] - cover.ranges[i]) < MIN_CHANGE
            out[k] = cover.hidden & beams.valid[k]


@kernel
def _hide_sudden(step: Array, ranges: Array, spacing: float, cover: Cover) -> bool:
    """Hide beams that have become short since the last scan, if they are many and the others have not."""
    n, moved = len(ranges), math.hypot(step[0], step[1])
    if (
        moved > MAX_SCAN_MOTION[0]
        or abs(step[2]) > MAX_SCAN_MOTION[1]
        or not cover.initialised[0]
        or spacing == 0.0
    ):
        return False
    drop = SUDDEN_COVER[0] + moved
    width = 1 + int(abs(step[2]) / spacing + 0.5)
    many = SUDDEN_COVER[1] / spacing
    if _count_short(ranges, drop, cover) < many:  # nearly always; what follows is slower
        return False
    short, compared, kept = np.zeros(n, np.bool_), 0, 0
    for i in range(n):
        if ranges[i] <= 0.0 or cover.last[i] <= 0.0:
            continue
        compared += 1
        shortest = longest = cover.last[i]
        for j in range(max(i - width, 0), min(i + width + 1, n)):
            if cover.last[j] > 0.0:
                shortest, longest = min(shortest, cover.last[j]), max(longest, cover.last[j])
        short[i] = ranges[i] < MAX_RANGE and ranges[i] < shortest - drop
        kept += shortest - MIN_CHANGE - moved < ranges[i] < longest + MIN_CHANGE + moved
    found = short.sum()
    if found < many or kept < MIN_UNCHANGED * (compared - found):
        return False
    for i in range(n):
        if short[i]:
            cover.same[i] = cover.against[i] = MIN_COMPARISONS
            cover.hidden[i] = True
            _spread_sudden(i, 1, ranges, cover)
            _spread_sudden(i, -1, ranges, cover)
    return True


@kernel
def _count_short(ranges: Array, drop: float, cover: Cover) -> int:
    """Return how many beams are shorter than in the last scan by `drop`."""
    count = 0
    for i in range(len(ranges)):
        count += 0.0 < ranges[i] < MAX_RANGE and ranges[i] < cover.last[i] - drop
    return count


@kernel
def _spread_sudden(first: int, step: int, ranges: Array, cover: Cover) -> None:
    """Hide the neighbours on one side that are on the same surface."""
    i = first + step
    while (
        0 <= i < len(ranges)
        and ranges[i] > 0.0
        and abs(ranges[i] - ranges[i - step]) < MAX_STEP_ON_SURFACE
    ):
        if cover.hidden[i] or ranges[i] >= MAX_RANGE:
            break
        cover.same[i], cover.hidden[i] = MIN_COMPARISONS, True
        i += step


@kernel
def _compare(ranges: Array, geometry: Geometry, cover: Cover) -> None:
    """Compare a scan with the reference scan, and find the hidden beams."""
    n, near, same = len(ranges), 0, np.zeros(len(ranges), np.bool_)
    for i in range(n):
        r = cover.ranges[i]
        same[i] = (
            min(ranges[i], r) > 0.0
            and abs(ranges[i] - r) < RANGE_TOLERANCE[0] + RANGE_TOLERANCE[1] * r
        )
        if same[i] and r < MAX_RANGE:
            near += 1
            cover.same[i] += 1
        else:
            cover.same[i] = cover.against[i] = 0
    cover.hidden[:] &= cover.same > 0
    if near < MIN_SHARE * n:  # they would be too few, whatever the motion
        return
    predicted = _predicted_ranges(geometry, cover, 0.0)
    confirmed = _is_confirmed(_predicted_ranges(geometry, cover, MAX_RANGE), ranges, cover.ranges)
    for i in range(n):
        if not confirmed and not cover.hidden[i]:
            cover.against[i] = 0
        elif predicted[i] > 0.0 and cover.same[i] > 0:
            cover.against[i] += 1
    _hide_surfaces(ranges, cover)


@kernel
def _predicted_ranges(geometry: Geometry, cover: Cover, nearest: float) -> Array:
    """Return the ranges (n,), m, that the motion since the reference scan should lead to; 0: no change.

    Points closer than `nearest` m are left out: they may be on a cover, which does not move.
    """
    predicted = np.zeros(len(cover.ranges))
    for j in range(len(predicted)):
        if not cover.hidden[j] and cover.ranges[j] >= nearest:  # hidden beams are no evidence
            k, expected = changed_beam(j, cover.odometry, cover.points, cover.ranges, geometry)
            if k >= 0 and (predicted[k] == 0.0 or expected < predicted[k]):
                predicted[k] = expected
    return predicted


@kernel
def _is_confirmed(predicted: Array, ranges: Array, reference: Array) -> bool:
    """Return whether the ranges beyond `MAX_RANGE` changed as predicted."""
    due = confirming = 0
    for i in range(len(ranges)):
        if min(predicted[i], ranges[i]) > 0.0 and reference[i] >= MAX_RANGE:
            due += 1
            change = abs(predicted[i] - reference[i])
            confirming += abs(ranges[i] - predicted[i]) < MAX_DEVIATION * change
    return confirming >= MIN_CONFIRMING * due


@kernel
def _hide_surfaces(ranges: Array, cover: Cover) -> None:
    """Hide each surface on which enough beams have measured the same although they should have changed."""
    n, first, seeds = len(ranges), 0, 0
    for i in range(n + 1):
        if i == n or not _continues(i, first, ranges, cover):
            if seeds >= MIN_SHARE * n:
                cover.hidden[first:i] = True
            first, seeds = i, 0
        if i < n:
            seeds += cover.against[i] >= MIN_COMPARISONS


@kernel
def _continues(i: int, first: int, ranges: Array, cover: Cover) -> bool:
    """Return whether beam i measured the same and is on the surface of the beams from `first` on."""
    if cover.same[i] < MIN_COMPARISONS:
        return False
    if i == first:
        return True
    return bool(
        cover.same[i - 1] >= MIN_COMPARISONS
        and abs(ranges[i] - ranges[i - 1]) < MAX_STEP_ON_SURFACE
    )
