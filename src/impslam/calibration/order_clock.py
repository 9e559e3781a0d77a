"""Times of a log with disordered stamps, reconstructed from the order of its rows.

A busy computer stamps several rows at once, then none for a while, and sometimes an earlier row later. The
rows are still in the order of the events, and a device sends at a steady rate, so the number of a row gives
a better time than its stamp: the time of row k of a device is the mean stamp of its rows around k, as many
before as after. The device with the most rows serves as the clock; any other row is placed half-way between
the two rows of the clock that surround it in the log. The remaining error is common to odometry and scans.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from impslam.calibration.recording import CalibrationRows
from impslam.types import Array, Mask

MAX_DISORDER = 0.02
"""s rms up to which stamps that run back are used as they are: the accuracy needed for a latency."""
SPAN = 3.0
"""Length of the averaging window on either side of a row, as a multiple of the time by which stamps run
back: the rate of rows is then known to a sixth even if all rows on one side are that late."""


def disorder(stamps: Array) -> Array:
    """Return (n,) s by which the stamps of one device run back at each row; 0 if they are in order.

    It is the latest stamp so far minus the earliest one still to come: a bound of the error of the stamp of
    the row or its neighbours.
    """
    newest = np.maximum.accumulate(stamps)
    oldest = np.minimum.accumulate(stamps[::-1])[::-1]
    return np.asarray(newest - oldest, np.float64)


def reorder_stamps(recording: CalibrationRows) -> tuple[CalibrationRows, float]:
    """Return a recording with usable stamps, and the amount by which its stamps run back, s rms.

    Above `MAX_DISORDER`, all stamps of odometry and scans are replaced by times from the order of the rows.
    """
    every = [*recording.odometry, *recording.scans]
    order = np.concatenate([np.empty(0, np.int64), *(columns.order for columns in every)])
    stamps = np.concatenate([np.empty(0), *(columns.stamps for columns in every)])
    place, split = np.argsort(order), sum(len(columns) for columns in recording.odometry)
    in_file, of_scans, back = stamps[place], place >= split, np.zeros(len(order))
    carried = of_scans[1:] & (in_file[:-1] == in_file[1:])  # poses recorded with scans
    of_scans[:-1] |= carried
    for device in (of_scans, ~of_scans):
        if device.any():
            rows = device & (in_file != in_file[device][0])  # the first may be of another clock
            back[rows] = disorder(in_file[rows])
    size = float(np.sqrt(np.mean(back**2))) if len(back) else 0.0
    if size <= MAX_DISORDER:
        return recording, size
    ticks = of_scans if 2 * of_scans.sum() > len(of_scans) else ~of_scans
    times = np.empty(len(order))
    times[place] = times_by_order(in_file, ticks, float(back.max()))
    parts = np.split(times, np.cumsum([len(columns) for columns in every])[:-1])
    timed = [columns.with_stamps(part) for columns, part in zip(every, parts, strict=True)]
    count = len(recording.odometry)
    return replace(recording, odometry=tuple(timed[:count]), scans=tuple(timed[count:])), size


def times_by_order(stamps: Array, ticks: Mask, max_disorder: float) -> Array:
    """Return times (n,) s of rows in the order of the log, from their stamps (n,).

    `ticks` (n,) are the rows of the device that serves as the clock; `max_disorder` is the maximum by which
    its stamps run back, s.
    """
    means, last = _means(stamps[ticks], SPAN * max_disorder), int(ticks.sum()) - 1
    before = np.cumsum(ticks)  # ticks up to each row, inclusive
    times = 0.5 * (means[np.clip(before - 1, 0, last)] + means[np.clip(before, 0, last)])
    times[ticks] = means
    return np.asarray(times, np.float64)


def _means(stamps: Array, window: float) -> Array:
    """Return the means (t,) s of the stamps around each row, over a window on either side.

    The window is shortened symmetrically at both ends of the log. Pauses count as one window at most.
    """
    n = len(stamps)
    duration = float(np.minimum(np.abs(np.diff(stamps)), window).sum())
    half = max(int(np.ceil(window * n / duration)), 1) if duration else 1
    k = np.arange(n)
    side = np.minimum(np.minimum(k, n - 1 - k), half)
    total = np.concatenate(([0.0], np.cumsum(stamps - stamps[0])))
    return np.asarray(stamps[0] + (total[k + side + 1] - total[k - side]) / (2 * side + 1))
