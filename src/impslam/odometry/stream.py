"""Motions from the readings of an odometry stream that arrives in batches."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.columns import Columns, Motions, join
from impslam.noise import MAX_GAP
from impslam.odometry.base import Odometry
from impslam.odometry.clocks import BY_ORDER, CLOCK_SET, PlacedRows
from impslam.odometry.standstill import Standstill
from impslam.types import Array, Ints, Mask

_NO_TIME: tuple[Array, Ints] = np.empty(0), np.empty(0, np.int64)


class StreamMotions(NamedTuple):
    """Motions of m rows of odometry.

    Attributes
    ----------
    motions : (m,) the motion from the previous row to each row; NaN where it is unknown, with
        duration 0 and the row's own stamp
    faults : (m,) rows that are unusable, or whose motion is impossible
    example : description of the first fault and its remedy; empty if there is none
    """

    motions: Motions
    faults: Mask
    example: str


class OdometryStream:
    """Computes motions from a stream of readings; keeps the last reading between batches."""

    def __init__(self, odometry: Odometry) -> None:
        self._odometry = odometry
        self._last: Columns | None = None
        self._last_time = _NO_TIME
        self._standstill = Standstill(odometry.standstill_band)

    def motions(self, rows: Columns, placed: PlacedRows | None = None) -> StreamMotions:
        """Return the motions of the next rows of the stream, placed at their stamps by default."""
        times = (rows.stamps, np.zeros(len(rows), np.int64)) if placed is None else placed[1:]
        rows = self._odometry.readings(rows)
        usable = self._odometry.usable(rows)
        kept = np.ones(len(rows), np.bool_) if self._odometry.holds else usable
        used = rows if kept.all() else rows.take(kept)
        readings = used if self._last is None else join(self._last, used)
        lead = len(readings) - len(used)  # 1 if there is a reading before the first row, else 0
        at = np.append(self._last_time[0], times[0][kept])
        how = np.append(self._last_time[1], times[1][kept])
        motions = self._compute(readings, at, how)
        known = ~np.isnan(motions.d_pose[:, 0])
        if len(known) < len(rows) or not known.all():
            positions = np.flatnonzero(kept)[1 - lead :]
            motions = _scatter(motions.take(known), rows.stamps, positions[known])
        faults = ~usable | np.isnan(motions.d_pose[:, 0]) & self._has_previous(usable, kept)
        example = ""
        if faults.any():
            first = int(np.argmax(faults))
            position = lead + int(kept[:first].sum())
            example = self._example(rows, readings, first, position, usable)
        self._keep(used, usable)
        self._last_time = (at[-1:], how[-1:]) if self._last is not None else _NO_TIME
        return StreamMotions(self._standstill.suppress(motions), faults, example)

    def _compute(self, readings: Columns, times: Array, how: Ints) -> Motions:
        """Return the motions between readings at these times."""
        if len(readings) < 2:
            return unknown_motions(readings.stamps[:0])
        with np.errstate(over="ignore", invalid="ignore"):  # readings may jump by 1e300
            motions = self._odometry.motions(readings)
            self._retime(motions, readings, times, _touched(how == BY_ORDER))
            fast = np.isnan(motions.d_pose[:, 0])
            fast &= (motions.duration <= 0.0) | _touched((how == BY_ORDER) | (how == CLOCK_SET))
            if fast.any() and not self._odometry.holds:
                self._keep_fast(motions, readings, fast)
        return motions

    def _retime(self, motions: Motions, readings: Columns, times: Array, by_order: Mask) -> None:
        """Replace motions (m,) from or to readings whose stamps are not used, in place."""
        if by_order.any():
            timed = self._odometry.motions(readings.with_stamps(times))
            for column, other in zip(motions[1:], timed[1:], strict=True):
                column[by_order] = other[by_order]

    def _keep_fast(self, motions: Motions, readings: Columns, fast: Mask) -> None:
        """Keep motions (m,) that seem too fast where time stands still or is unknown, in place.

        Only those that are too far for `MAX_GAP` remain unknown.
        """
        stamps = MAX_GAP * np.arange(float(len(readings)))
        slow = self._odometry.motions(readings.with_stamps(stamps))
        motions.d_pose[fast], motions.covariance[fast] = slow.d_pose[fast], slow.covariance[fast]

    def _has_previous(self, usable: Mask, kept: Mask) -> Mask:
        """Return (m,) which rows have a usable reading before them, where their motion starts."""
        before = np.empty(len(usable), np.bool_)
        before[:1] = self._last is not None
        if self._odometry.holds:
            before[1:] = usable[:-1]
        else:
            before[1:] = np.logical_or.accumulate(kept)[:-1] | before[:1]
        return before

    def _example(
        self, rows: Columns, readings: Columns, first: int, position: int, usable: Mask
    ) -> str:
        """Describe the fault of a row; `position` is its index in the readings, if it is among them."""
        if not usable[first]:
            return self._odometry.fault(rows.take(slice(first, first + 1)))
        return self._odometry.fault(readings.take(slice(position - 1, position + 1)))

    def _keep(self, used: Columns, usable: Mask) -> None:
        if self._odometry.holds and len(usable) and not usable[-1]:
            self._last = None
        elif len(used):
            self._last = used.take(slice(-1, None))


def _touched(rows: Mask) -> Mask:
    """Return (m,) which motions between m + 1 rows begin or end at one of these."""
    return np.asarray(rows[1:] | rows[:-1])


def unknown_motions(stamps: Array) -> Motions:
    """Return unknown (NaN) motions with duration 0 that end at these stamps (m,)."""
    m = len(stamps)
    d_pose, covariance = np.full((m, 3), np.nan), np.full((m, 3, 3), np.nan)
    return Motions(stamps.copy(), d_pose, covariance, np.zeros(m))


def _scatter(motions: Motions, stamps: Array, positions: Ints) -> Motions:
    """Return m motions: the given ones at `positions`, unknown ones elsewhere."""
    scattered = unknown_motions(stamps)
    for column, given in zip(scattered, motions, strict=True):
        column[positions] = given
    return scattered
