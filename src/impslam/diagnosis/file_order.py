"""Times of a log with unusable stamps for a diagnosis, by the order of its rows.

Scans get a steady period. The last row of odometry before a scan gets its time, since both were taken
together as far as is known, and other rows are spread evenly between two scans.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from impslam.calibration.recording import CalibrationRows
from impslam.columns import Columns
from impslam.types import Array, Ints

PERIOD = 0.1
"""s between scans: that of most lidars. Checks of a log without times depend little on it."""


def in_file_order(recording: CalibrationRows) -> CalibrationRows:
    """Return a recording whose odometry and scans have stamps by their order."""
    scans, count = list[Columns](), 0
    for columns in recording.scans:
        scans.append(columns.with_stamps(PERIOD * np.arange(float(count), count + len(columns))))
        count += len(columns)
    ticks = _orders(recording.scans)
    times = _between(_orders(recording.odometry), ticks)
    cuts = np.cumsum([len(columns) for columns in recording.odometry])[:-1]
    parts = zip(
        recording.odometry, np.split(times, cuts), strict=False
    )  # one part if there is none
    odometry = tuple(columns.with_stamps(part) for columns, part in parts)
    return replace(recording, odometry=odometry, scans=tuple(scans))


def without_repeats(recording: CalibrationRows) -> CalibrationRows:
    """Return a recording without scans that equal the one before, whose rows would count as time."""
    return replace(recording, scans=tuple(map(_first_copies, recording.scans)))


def _first_copies(scans: Columns) -> Columns:
    rows = 1 + np.flatnonzero(scans.stamps[1:] == scans.stamps[:-1])  # few, so the rest is fast
    before, after = scans["ranges"][rows - 1], scans["ranges"][rows]
    is_equal = ((before == after) | (np.isnan(before) & np.isnan(after))).all(axis=1)
    return scans.take(np.delete(np.arange(len(scans)), rows[is_equal])) if is_equal.any() else scans


def _between(orders: Ints, ticks: Ints) -> Array:
    """Return times (n,) s of rows at these positions (n,) in the log, with scans at others (m,)."""
    following = np.searchsorted(ticks, orders)
    counts = np.bincount(following, minlength=len(ticks) + 1)
    rank = np.arange(1, len(orders) + 1) - (np.cumsum(counts) - counts)[following]
    return np.asarray(PERIOD * (following - 1 + rank / counts[following]))


def _orders(pieces: tuple[Columns, ...]) -> Ints:
    return np.concatenate([np.empty(0, np.int64), *(columns.order for columns in pieces)])
