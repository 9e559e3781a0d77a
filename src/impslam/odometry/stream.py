"""Motions from the readings of an odometry stream that arrives in batches."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.columns import Columns, Motions, join
from impslam.odometry.base import Odometry
from impslam.odometry.standstill import Standstill
from impslam.types import Array, Ints, Mask


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
        self._standstill = Standstill(odometry.standstill_band)

    def motions(self, rows: Columns) -> StreamMotions:
        """Return the motions of the next rows of the stream."""
        rows = self._odometry.readings(rows)
        usable = self._odometry.usable(rows)
        kept = np.ones(len(rows), np.bool_) if self._odometry.holds else usable
        used = rows if kept.all() else rows.take(kept)
        readings = used if self._last is None else join(self._last, used)
        lead = len(readings) - len(used)  # 1 if there is a reading before the first row, else 0
        motions = self._compute(readings)
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
        return StreamMotions(self._standstill.suppress(motions), faults, example)

    def _compute(self, readings: Columns) -> Motions:
        if len(readings) < 2:
            return unknown_motions(readings.stamps[:0])
        with np.errstate(over="ignore", invalid="ignore"):  # readings may jump by 1e300
            return self._odometry.motions(readings)

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
