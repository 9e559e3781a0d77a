"""Which points of a scan show what was not seen before, so that they say nothing about its pose."""

from __future__ import annotations

import math

from impslam.geometry.chain import advance_pose
from impslam.geometry.kernels import kernel
from impslam.surfaces.features import Features
from impslam.surfaces.surface_map import SurfaceMap, surfel_at
from impslam.tracking.contradictions import CLEARANCE
from impslam.tracking.reference_scan import LastScan, beam_towards
from impslam.types import Array


@kernel
def unseen_points(submap: SurfaceMap, features: Features, pose: Array, last: LastScan) -> int:
    """Return how many features of a scan at pose (3,) show what the submap cannot contain yet.

    No surface of it is near them, or only the other side of one, and the last scan did not see through
    them: it did not look there, or ended there or before. Without ranges of the last scan, there are none.
    """
    if len(last.ranges) == 0:
        return 0
    laser, count = last.pose.copy(), 0
    advance_pose(laser, last.geometry.laser)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for i in range(len(features)):
        fx, fy, fnx, fny = features[i, 0], features[i, 1], features[i, 2], features[i, 3]
        x, y = pose[0] + c * fx - s * fy, pose[1] + s * fx + c * fy
        near = surfel_at(submap, x, y)
        if near >= 0:
            nx, ny = submap.surfels[near, 2], submap.surfels[near, 3]
            if (c * fnx - s * fny) * nx + (s * fnx + c * fny) * ny >= 0.0:
                continue
        dx, dy = x - laser[0], y - laser[1]
        k = beam_towards(math.atan2(dy, dx) - laser[2], len(last.ranges), last.geometry)
        if k < 0 or 0.0 < last.ranges[k] < math.hypot(dx, dy) + CLEARANCE:
            count += 1
    return count
