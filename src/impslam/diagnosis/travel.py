"""How far laser and odometry say that a robot went, over the same stretches of time.

All motions are twists [forward, left, turn] (m, m, rad) in the body's own frame, summed over a stretch.
Twists of two frames on one body differ by a constant matrix, so that sums obey the same linear law as each
(the adjoint of SE(2); Solà et al. 2018, Eq. 166).
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

WAY, TURN = 0.4, 0.4
"""m, rad of a stretch: a hundred times the error of a match."""
GAP = 1.5
"""s between two sweeps of a stretch at most; the motion between sweeps further apart is a guess."""


class Odometer(NamedTuple):
    """Odometry added up.

    Attributes
    ----------
    stamps : (n,) s, increasing: rows that are stamped before one that precedes them are left out, and
        what moved up to them counts for the next row
    sums : (n, 3) m, m, rad gone since the first row
    unknown : (n,) how many motions up to each row are unknown
    rows : (r, 4) stamp and sums of every row, by stamp
    """

    stamps: Array
    sums: Array
    unknown: Ints
    rows: Array

    def until(self, times: Array) -> Array:
        """Return the sums (k, 3) at times (k,): of the row with that stamp, else between two rows.

        Rows that are recorded together with a scan bear its stamp, also where stamps jitter or run back.
        """
        sums = np.column_stack([np.interp(times, self.stamps, column) for column in self.sums.T])
        at = np.minimum(np.searchsorted(self.rows[:, 0], times), len(self.rows) - 1)
        together = self.rows[at, 0] == times
        sums[together] = self.rows[at[together], 1:]
        return sums

    def is_whole(self, begins: Array, ends: Array) -> Mask:
        """Return (k,) whether odometry is known from each begin to each end."""
        inside = (begins >= self.stamps[0]) & (ends <= self.stamps[-1])
        first = np.searchsorted(self.stamps, begins, side="right") - 1
        last = np.searchsorted(self.stamps, ends, side="left")
        last = np.minimum(last, len(self.stamps) - 1)
        return np.asarray(inside & (self.unknown[np.maximum(first, 0)] == self.unknown[last]))


def odometer(odometry: Odometry, pieces: Sequence[Columns]) -> Odometer:
    """Add up the motions of odometry's readings."""
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


class Laser(NamedTuple):
    """The laser's motions between m consecutive sweeps, from that before to each.

    Attributes
    ----------
    stamps : (m,) s, middles of the sweeps
    twists : (m, 3) m, m, rad, in the laser's own frame; the first is nought
    sure : (m,) whether the scans tell it
    """

    stamps: Array
    twists: Array
    sure: Mask


def laser(path: LidarPath) -> Laser:
    """Return the motions along a path by the lidar alone."""
    twists = np.zeros((len(path.poses), 3))
    twists[1:] = log(between(path.poses[:-1], path.poses[1:]))
    seconds = np.diff(path.middles, prepend=np.nan)
    # Where stamps jitter, leaving out those that run back would keep the longer of the times between them.
    near, told = np.abs(seconds) <= GAP, path.trusted & path.located
    return Laser(path.middles, twists, near & told & np.append(False, told[:-1]))


def stretches(motion: Laser) -> tuple[Ints, Ints]:
    """Return the rows (k,) of sweeps where stretches begin and end, whose motion is sure throughout."""
    begins, ends = list[int](), list[int]()
    ways = np.hypot(motion.twists[:, 0], motion.twists[:, 1]).tolist()
    turns = np.abs(motion.twists[:, 2]).tolist()
    start, way, turn = 0, 0.0, 0.0
    for k, is_sure in enumerate(motion.sure.tolist()):
        if not is_sure:
            start, way, turn = k, 0.0, 0.0
            continue
        way, turn = way + ways[k], turn + turns[k]
        if way >= WAY or turn >= TURN:
            begins.append(start)
            ends.append(k)
            start, way, turn = k, 0.0, 0.0
    return np.array(begins, np.int64), np.array(ends, np.int64)
