"""Whether a scan contradicts what was seen before, or only shows what was not.

A robot that passes a door sees mostly surfaces that its map does not contain: the scan fits poorly, but
nothing speaks against its pose. A beam contradicts the map if it passes through a known surface, or ends
where a beam of the last scan passed.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.geometry.chain import advance_pose
from impslam.geometry.kernels import kernel
from impslam.surfaces.features import Features
from impslam.surfaces.surface_map import CELL
from impslam.tracking.beams import Geometry
from impslam.tracking.reference_scan import LastScan, beam_towards, laser_motion, seen_from
from impslam.types import Array, Mask

MIN_CONTRADICTED = 0.12
"""Share of the beams that contradict the map if the robot is elsewhere: nearly always over a third. In a
door it is below a tenth."""
MIN_LENGTH = 0.3
"""m of contradicted surfaces, across the beams: in a door, the ends of the wall on both sides are near, so
that an error of 10 cm covers many beams."""
MIN_SURFACES = 0.1
"""Share of a scan's points that are on surfaces, see `Features`; one with fewer does not show another room,
but noise, of which 2 % are in line by chance. In five recorded buildings, 99 % of the scans have more than
0.36; where beams 1 deg apart see a corridor to its end, some have 0.2."""
MAX_DOOR = 2.5
"""m: surfaces that vanish within this extent are a double door that opened, or people who moved on."""
CLEARANCE = 0.2
"""m between a surface and the free part of a beam: more than the error of a match and of a range."""
MIN_INCIDENCE = 0.35
"""Least cosine between a beam and the normal of a surface that it must have hit, 20 degrees: at 0.4 m, as
in a door, a surface that is off by 5 cm may be missed below 0.13; the rest is for its normal."""
TURN_CLEARANCE = 0.05
"""rad on either side of a beam within which all ranges must agree: more than the error of a heading."""


@kernel
def contradicted_share(
    ranges: Array, valid: Mask, pose: Array, surfels: Array, last: LastScan
) -> float:
    """Return the share of the valid beams of a scan at pose (3,) that contradict map or last scan.

    Surfaces that they miss do not count if all of them may be one door; the share is 0 if those that they
    show or miss are shorter than `MIN_LENGTH` in all. `surfels` (n, 8) are those of the map, see
    `SurfaceMap`. `ranges` (n,) are in m, and the pose in the frame of the map; the last scan has the same
    beams.
    """
    n, geometry = len(ranges), last.geometry
    laser, to_last = pose.copy(), laser_motion(last.pose, pose, geometry)
    advance_pose(laser, geometry.laser)
    scan = np.where(valid, ranges, 0.0)
    free, free_before = free_ranges(scan, geometry), free_ranges(last.ranges, geometry)
    behind = _behind_surfaces(laser, surfels, n, geometry)
    appeared, vanished, count, length, box = 0, 0, 0, 0.0, empty_box()
    for i in range(n):
        if not valid[i]:
            continue
        count += 1
        k, reach = seen_from(i, ranges[i], to_last, n, geometry)
        is_new, is_open = k >= 0 and reach < free_before[k] - CLEARANCE, behind[i] < free[i]
        if is_new or is_open:
            length += abs(geometry.spacing) * min(ranges[i], behind[i])
        if is_new:
            appeared += 1
        elif is_open:
            vanished += 1
            angle = geometry.first + i * geometry.spacing
            widen(box, behind[i] * math.cos(angle), behind[i] * math.sin(angle))
    if diagonal(box) < MAX_DOOR:
        vanished = 0
    return (appeared + vanished) / max(count, 1) if length > MIN_LENGTH else 0.0


@kernel
def shows_surfaces(features: Features) -> bool:
    """Return whether enough of a scan's features are on surfaces for it to show a room."""
    return bool((features[:, 4] > 0.0).sum() > MIN_SURFACES * len(features))


@kernel
def empty_box() -> Array:
    """Return the box (2, 2) around no point: lowest and highest x and y, m."""
    box = np.empty((2, 2))
    box[0], box[1] = math.inf, -math.inf
    return box


@kernel
def widen(box: Array, x: float, y: float) -> None:
    """Widen a box to contain a point."""
    box[0, 0], box[0, 1] = min(box[0, 0], x), min(box[0, 1], y)
    box[1, 0], box[1, 1] = max(box[1, 0], x), max(box[1, 1], y)


@kernel
def diagonal(box: Array) -> float:
    """Return the diagonal of a box, m; 0 if it is empty."""
    return math.hypot(max(box[1, 0] - box[0, 0], 0.0), max(box[1, 1] - box[0, 1], 0.0))


@kernel
def free_ranges(ranges: Array, geometry: Geometry) -> Array:
    """Return the shortest range (n,) within `TURN_CLEARANCE` of each beam; 0 if one of them is invalid."""
    n, free = len(ranges), np.zeros(len(ranges))
    width = math.ceil(TURN_CLEARANCE / abs(geometry.spacing)) if geometry.spacing != 0.0 else 0
    for i in range(n):
        free[i] = ranges[i]
        for k in range(max(i - width, 0), min(i + width + 1, n)):
            free[i] = min(free[i], ranges[k])
    return free


@kernel
def _behind_surfaces(laser: Array, surfels: Array, beams: int, geometry: Geometry) -> Array:
    """Return the range (n,) in m at which each beam would be `CLEARANCE` behind a surfel; inf without one.

    Surfaces seen nearly edge-on are left out: in a door, beams pass beside the wall that it is in.
    """
    nearest = np.full(beams, math.inf)
    c, s = math.cos(laser[2]), math.sin(laser[2])
    for k in range(len(surfels)):
        x, y = surfels[k, 0] - laser[0], surfels[k, 1] - laser[1]
        distance = math.hypot(x, y)
        middle = beam_towards(math.atan2(c * y - s * x, c * x + s * y), beams, geometry)
        nx, ny = surfels[k, 2], surfels[k, 3]
        across = abs(x * nx + y * ny) if nx != 0.0 or ny != 0.0 else distance  # a lone point
        if middle < 0 or distance < CELL or across < MIN_INCIDENCE * distance:
            continue
        passed = distance + CLEARANCE * distance / across
        width = int(0.5 * CELL / distance / abs(geometry.spacing))
        for i in range(max(middle - width, 0), min(middle + width + 1, beams)):
            nearest[i] = min(nearest[i], passed)
    return nearest
