"""The motion that each row of an odometry's stream tells, from batch to batch."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.columns import Columns, Motions, join
from impslam.odometry.base import Odometry
from impslam.types import Array, Ints, Mask


class Followed(NamedTuple):
    """What m rows told.

    Attributes
    ----------
    motions : (m,) the motion from the row before to each; NaN where it is not known, where it takes
        no time and ends at the row's own stamp
    faults : (m,) which rows could not be used, or told a motion that cannot be
    example : what was wrong with the first of them, and what to do; empty if nothing was
    """

    motions: Motions
    faults: Mask
    example: str


class Follower:
    """Follows a stream of readings; it keeps the last one, from which the next motion begins."""

    def __init__(self, odometry: Odometry) -> None:
        self._odometry = odometry
        self._last: Columns | None = None

    def follow(self, rows: Columns) -> Followed:
        """Return the motions of the stream's next rows."""
        usable = self._odometry.usable(rows)
        kept = np.ones(len(rows), np.bool_) if self._odometry.holds else usable
        used = rows if kept.all() else rows.take(kept)
        readings = used if self._last is None else join(self._last, used)
        lead = len(readings) - len(used)  # 1 if the first row has one before it, else 0
        motions = self._motions(readings)
        told = ~np.isnan(motions.d_pose[:, 0])
        if len(told) < len(rows) or not told.all():
            places = np.flatnonzero(kept)[1 - lead :]
            motions = _spread(motions.take(told), rows.stamps, places[told])
        faults = ~usable | np.isnan(motions.d_pose[:, 0]) & self._begun(usable, kept)
        example = ""
        if faults.any():
            first = int(np.argmax(faults))
            place = lead + int(kept[:first].sum())
            example = self._example(rows, readings, first, place, usable)
        self._keep(used, usable)
        return Followed(motions, faults, example)

    def _motions(self, readings: Columns) -> Motions:
        if len(readings) < 2:
            return nothing_told(readings.stamps[:0])
        with np.errstate(over="ignore", invalid="ignore"):  # of readings that jump by 1e300
            return self._odometry.motions(readings)

    def _begun(self, usable: Mask, kept: Mask) -> Mask:
        """Tell for which rows there is a usable reading from which a motion to them begins."""
        before = np.empty(len(usable), np.bool_)
        before[:1] = self._last is not None
        if self._odometry.holds:
            before[1:] = usable[:-1]
        else:
            before[1:] = np.logical_or.accumulate(kept)[:-1] | before[:1]
        return before

    def _example(
        self, rows: Columns, readings: Columns, first: int, place: int, usable: Mask
    ) -> str:
        """Explain a row; `place` is its place among the readings, if it is one of them."""
        if not usable[first]:
            return self._odometry.fault(rows.take(slice(first, first + 1)))
        return self._odometry.fault(readings.take(slice(place - 1, place + 1)))

    def _keep(self, used: Columns, usable: Mask) -> None:
        if self._odometry.holds and len(usable) and not usable[-1]:
            self._last = None
        elif len(used):
            self._last = used.take(slice(-1, None))


def nothing_told(stamps: Array) -> Motions:
    """Return motions that are not known, of rows with these stamps."""
    m = len(stamps)
    d_pose, covariance = np.full((m, 3), np.nan), np.full((m, 3, 3), np.nan)
    return Motions(stamps.copy(), d_pose, covariance, np.zeros(m))


def _spread(motions: Motions, stamps: Array, places: Ints) -> Motions:
    """Return motions as those of the rows at some places; NaN at the others."""
    spread = nothing_told(stamps)
    for column, given in zip(spread, motions, strict=True):
        column[places] = given
    return spread
