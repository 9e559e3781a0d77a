"""Scans and increments as the columns that trackers take."""

from dataclasses import replace

import numpy as np

from impslam.columns import Columns, Motions, Scans, Sweeps
from impslam.tracking.base import Gate
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


def steps(tracker, increments, scans, sensor="lidar", limits=(np.inf, np.inf, np.inf)):
    """Return the `Steps` of a tracker for scans and the increments to them, as one batch."""
    sweeps = replace(sweeps_of(scans, [i.stamp for i in increments]), sensor=sensor)
    gate = Gate(np.array(limits, float), np.zeros(3))
    return tracker.steps(motions_of(increments), sweeps, gate)


def same(one, other):
    """Tell whether two increments are the same to the byte."""
    return isinstance(other, Increment) and all(
        np.asarray(getattr(one, name)).tobytes() == np.asarray(getattr(other, name)).tobytes()
        for name in ("stamp", "d_pose", "covariance", "duration")
    )
