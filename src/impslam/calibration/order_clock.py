"""Times of a log whose stamps run back and forth: its order is the clock.

A computer that stamps rows when it gets to them stamps several at once, then none for a while, and
sometimes an earlier row later. Their order is still that of the events, and a device sends at a steady
rate, so that the number of a row tells its time better than its stamp does: the time of row k of a device
is the mean stamp of its rows around k, as many before as after. The device with the most rows is the clock,
and what else is in the log happened half-way between the two of its rows that it is written between.
What these times are wrong by is common to odometry and scans.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from impslam.calibration.recording import Recording
from impslam.columns import Columns
from impslam.types import Array, Mask

MOST = 0.02
"""s rms by which stamps run back at most where they are believed: what a latency has to be known to."""
SPAN = 3.0
"""s of stamps on either side of a row that its time is the mean of, per s by which stamps run back: the
rate of rows is then known to a sixth, if all on one side were late by as much."""


def disorder(stamps: Array) -> Array:
    """Return (n,) s by which the stamps of one device run back at each row; 0 where they are in order.

    It is the newest stamp so far minus the oldest one still to come: what a row is stamped wrong by, or
    its neighbours, up to that much.
    """
    newest = np.maximum.accumulate(stamps)
    oldest = np.minimum.accumulate(stamps[::-1])[::-1]
    return np.asarray(newest - oldest, np.float64)


def in_order(recording: Recording) -> tuple[Recording, float]:
    """Return a recording, and by how much its stamps run back, s rms.

    If that is more than `MOST`, all stamps of odometry and scans are replaced by times by the order.
    """
    every = [*recording.odometry, *recording.scans]
    order = np.concatenate([np.empty(0, np.int64), *(columns.order for columns in every)])
    stamps = np.concatenate([np.empty(0), *(columns.stamps for columns in every)])
    place, split = np.argsort(order), sum(len(columns) for columns in recording.odometry)
    in_file, of_scans, back = stamps[place], place >= split, np.zeros(len(order))
    carried = of_scans[1:] & (in_file[:-1] == in_file[1:])  # poses that scans have with them
    of_scans[:-1] |= carried
    for rows in (of_scans, ~of_scans):
        if rows.any():
            back[rows] = disorder(in_file[rows])
    size = float(np.sqrt(np.mean(back**2))) if len(back) else 0.0
    if size <= MOST:
        return recording, size
    ticks = of_scans if 2 * of_scans.sum() > len(of_scans) else ~of_scans
    times = np.empty(len(order))
    times[place] = by_order(in_file, ticks, float(back.max()))
    parts = np.split(times, np.cumsum([len(columns) for columns in every])[:-1])
    timed = [_at(columns, part) for columns, part in zip(every, parts, strict=True)]
    count = len(recording.odometry)
    return replace(recording, odometry=tuple(timed[:count]), scans=tuple(timed[count:])), size


def by_order(stamps: Array, ticks: Mask, longest: float) -> Array:
    """Return times (n,) s of rows in the order of the log, from their stamps (n,).

    `ticks` (n,) are the rows of the device that is the clock; `longest` is the most, s, by which its
    stamps run back.
    """
    means, last = _means(stamps[ticks], SPAN * longest), int(ticks.sum()) - 1
    before = np.cumsum(ticks)  # of each row, itself included
    times = 0.5 * (means[np.clip(before - 1, 0, last)] + means[np.clip(before, 0, last)])
    times[ticks] = means
    return np.asarray(times, np.float64)


def _means(stamps: Array, window: float) -> Array:
    """Return the means (t,) s of the stamps around each row, over a window on either side.

    Fewer at both ends of the log, as many before as after. A pause counts as long as the window.
    """
    n = len(stamps)
    lasts = float(np.minimum(np.abs(np.diff(stamps)), window).sum())
    half = max(int(np.ceil(window * n / lasts)), 1) if lasts else 1
    k = np.arange(n)
    reach = np.minimum(np.minimum(k, n - 1 - k), half)
    total = np.concatenate(([0.0], np.cumsum(stamps - stamps[0])))
    return np.asarray(stamps[0] + (total[k + reach + 1] - total[k - reach]) / (2 * reach + 1))


def _at(columns: Columns, times: Array) -> Columns:
    return replace(columns, values={**columns.values, "stamp": times})
