"""Scans and increments as the columns that trackers take."""

import numpy as np

from impslam.columns import Columns, Motions, Scans, Sweeps
from impslam.tracking.surfels import prepare
from impslam.types import Increment, LaserScan


def motions_of(increments):
    """Return increments as columns."""
    fields = zip(*((i.stamp, i.d_pose, i.covariance, i.duration) for i in increments), strict=True)
    return Motions(*(np.array(column, float) for column in fields))


def scans_of(scans):
    """Return scans of one sensor as columns."""
    names = ("stamp", "ranges", "valid", "points", "directions", "origins", "sigmas")
    stamps, ranges, valid, points, directions, origins, sigmas = (
        np.array([getattr(scan, name) for scan in scans]) for name in names
    )
    one = scans[0]
    return Scans(
        stamps, one.angles, ranges, valid, points, directions, origins, sigmas, one.bias,
        one.range_max, one.laser,
    )  # fmt: skip


def sweeps_of(scans, stamps):
    """Return scans taken at their own stamps, (m,) s, as columns."""
    stamps, nothing = np.asarray(stamps, float), np.zeros((len(stamps), 3))
    columns = Columns("scan", LaserScan, np.arange(len(stamps)), {"stamp": stamps}, {})
    spread = np.zeros((len(stamps), 3, 3))
    return Sweeps("lidar", columns, stamps, nothing, nothing, spread, scans_of(scans))


def match(tracker, increment, scan):
    """Return the increment as a tracker refines it by one scan."""
    sweeps = sweeps_of([scan], [increment.stamp])
    surfels = prepare(sweeps.scans, tracker.thinning)
    return tracker.refine(motions_of([increment]), sweeps, surfels).row(0)


def same(one, other):
    """Tell whether two increments are the same to the byte."""
    return isinstance(other, Increment) and all(
        np.asarray(getattr(one, name)).tobytes() == np.asarray(getattr(other, name)).tobytes()
        for name in ("stamp", "d_pose", "covariance", "duration")
    )
