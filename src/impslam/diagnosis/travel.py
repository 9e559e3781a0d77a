"""Motion of the robot by laser and by odometry, over the same stretches of time.

All motions are twists [forward, left, turn] (m, m, rad) in the body's own frame, summed over a stretch.
Twists of two frames on one body differ by a constant matrix (the adjoint of SE(2); Solà et al. 2018,
Eq. 166), so their sums obey the same linear relation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from impslam.calibration.lidar_path import LidarPath
from impslam.columns import Columns
from impslam.geometry.se2 import between, log
from impslam.odometry.base import Odometry
from impslam.odometry.stream import OdometryStream
from impslam.types import Array, Ints, Mask

STRETCH_DISTANCE, STRETCH_TURN = 0.4, 0.4
"""m, rad of a stretch: a hundred times the error of a match."""
FINEST = 5.0
"""Per cent of the changes of odometry from row to row that are its resolution: nearly all changes of a
coarse one are multiples of it; of a fine one, they are smaller than any other error."""
MAX_GAP = 1.5
"""s between two sweeps of a stretch; the motion between sweeps further apart is uncertain."""


class Odometer(NamedTuple):
    """Accumulated odometry.

    Attributes
    ----------
    stamps : (n,) s, increasing: rows with a stamp earlier than a preceding one are omitted, and their
        motion is added to the next row
    sums : (n, 3) m, m, rad since the first row
    unknown : (n,) number of unknown motions up to each row
    rows : (r, 4) stamp and sums of every row, sorted by stamp
    """

    stamps: Array
    sums: Array
    unknown: Ints
    rows: Array

    def at(self, times: Array) -> Array:
        """Return the sums (k, 3) at times (k,): those of the row with that stamp, else interpolated.

        Rows recorded together with a scan have its stamp, even if stamps jitter or decrease.
        """
        sums = np.column_stack([np.interp(times, self.stamps, column) for column in self.sums.T])
        nearest = np.minimum(np.searchsorted(self.rows[:, 0], times), len(self.rows) - 1)
        exact = self.rows[nearest, 0] == times
        sums[exact] = self.rows[nearest[exact], 1:]
        return sums

    def between(self, times: Array) -> Array:
        """Return the motions (k, 3) between begins and ends, times (k, 2)."""
        return self.at(times[:, 1]) - self.at(times[:, 0])

    @property
    def resolution(self) -> Array:
        """(3,) m, m, rad: the smallest changes from row to row; 0 without any."""
        changes = np.abs(np.diff(self.sums, axis=0)).T
        found = [column[column > 1e-9] for column in changes]
        return np.array([np.percentile(c, FINEST) if len(c) else 0.0 for c in found])

    def is_whole(self, begins: Array, ends: Array) -> Mask:
        """Return (k,) whether odometry is known from each begin to each end."""
        inside = (begins >= self.stamps[0]) & (ends <= self.stamps[-1])
        first = np.searchsorted(self.stamps, begins, side="right") - 1
        last = np.searchsorted(self.stamps, ends, side="left")
        last = np.minimum(last, len(self.stamps) - 1)
        return np.asarray(inside & (self.unknown[np.maximum(first, 0)] == self.unknown[last]))


def make_odometer(odometry: Odometry, pieces: Sequence[Columns]) -> Odometer:
    """Accumulate the motions of odometry readings."""
    stream = OdometryStream(odometry)
    motions = [stream.motions(rows).motions for rows in pieces if len(rows)]
    if not motions:
        return Odometer(np.empty(0), np.empty((0, 3)), np.empty(0, np.int64), np.empty((0, 4)))
    stamps = np.concatenate([some.stamps for some in motions])
    twists = log(np.concatenate([some.d_pose for some in motions]))
    unknown = np.isnan(twists[:, 0])
    unknown[0] = False
    newest = np.maximum.accumulate(stamps)
    kept = np.append(True, stamps[1:] > newest[:-1])
    sums, count = np.cumsum(np.nan_to_num(twists), axis=0), np.cumsum(unknown)
    rows = np.column_stack((stamps, sums))[np.argsort(stamps, kind="stable")]
    return Odometer(stamps[kept], sums[kept], count[kept], rows)


class SweepMotions(NamedTuple):
    """The laser's motions to each of m consecutive sweeps from the sweep before.

    Attributes
    ----------
    stamps : (m,) s, middles of the sweeps
    twists : (m, 3) m, m, rad, in the laser's own frame; the first is zero
    known : (m,) whether the scans determine the motion
    """

    stamps: Array
    twists: Array
    known: Mask


def sweep_motions(path: LidarPath) -> SweepMotions:
    """Return the motions along a path found by the lidar alone."""
    twists = np.zeros((len(path.poses), 3))
    twists[1:] = log(between(path.poses[:-1], path.poses[1:]))
    seconds = np.diff(path.middles, prepend=np.nan)
    # If stamps jitter, omitting those that decrease would keep the longer of the times between them.
    near, located = np.abs(seconds) <= MAX_GAP, path.trusted & path.located
    return SweepMotions(path.middles, twists, near & located & np.append(False, located[:-1]))


def stretches(motion: SweepMotions) -> tuple[Ints, Ints]:
    """Return the rows (k,) of sweeps where stretches of known motion begin and end."""
    begins, ends = list[int](), list[int]()
    distances = np.hypot(motion.twists[:, 0], motion.twists[:, 1]).tolist()
    turns = np.abs(motion.twists[:, 2]).tolist()
    start, distance, turn = 0, 0.0, 0.0
    for k, is_known in enumerate(motion.known.tolist()):
        if not is_known:
            start, distance, turn = k, 0.0, 0.0
            continue
        distance, turn = distance + distances[k], turn + turns[k]
        if distance >= STRETCH_DISTANCE or turn >= STRETCH_TURN:
            begins.append(start)
            ends.append(k)
            start, distance, turn = k, 0.0, 0.0
    return np.array(begins, np.int64), np.array(ends, np.int64)
