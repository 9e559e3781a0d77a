"""What is wrong with beams: a value that stands for no return, and the robot's own body in view."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.calibration.lidar_path import bare
from impslam.diagnosis.evidence import Evidence
from impslam.diagnosis.finding import SUREST, Finding
from impslam.types import Array, Ints, Mask

MOST = 400
"""Scans that are looked at, evenly over the log."""
SHARE, REPEATED = 0.005, 0.2
"""Shares of valid beams, and of scans, that have the value: rarer, it does no harm."""
PEAK = 5.0
"""Times as often as the most frequent value beside it: on surfaces, frequencies change gradually."""
BESIDE = 20
"""Values on either side that it is compared with."""
DEAD = 0.02
"""Share of all beams, side by side, without a return in any scan."""
BODY = 1.0
"""m: a robot's own body is nearer."""
STEADY = (0.02, 0.01)
"""m, and share of the range: what a range to the body strays by."""
ALWAYS = 0.8
"""Share of the scans in which a beam that meets the body has its usual range."""
MOVED = (2.0, 1.5)
"""m, rad that the laser has gone and turned before a range that stays is one to the robot itself."""


class Beams(NamedTuple):
    """Some scans of a log: `ranges` (m, n) as received, `valid` (m, n) by the config, `angles` (n,) rad."""

    ranges: Array
    valid: Mask
    angles: Array


def beams(e: Evidence) -> list[Finding]:
    """Find a value for no return among the ranges, and beams that meet the robot itself."""
    some = _some(e)
    if some is None:
        return []
    return [*_no_return(e, some), *_body(e, some), *_dead(e, some)]


def _some(e: Evidence) -> Beams | None:
    """Return scans of the longest piece of one layout, evenly over it."""
    piece = max(e.recording.scans, key=len, default=None)
    if piece is None or len(piece) < 10:
        return None
    rows = np.unique(np.linspace(0, len(piece) - 1, min(MOST, len(piece))).astype(np.int64))
    piece = piece.take(rows)
    scans = bare(e.lidar).sweeps(piece, np.zeros((len(rows), 3)))
    return Beams(piece["ranges"], scans.valid, piece["angles"])


def _no_return(e: Evidence, some: Beams) -> list[Finding]:
    values, counts = np.unique(some.ranges[some.valid], return_counts=True)
    if len(values) < 2:
        return []
    k = int(np.argmax(counts))
    beside = np.delete(counts[max(k - BESIDE, 0) : k + BESIDE + 1], min(k, BESIDE))
    value, share = float(values[k]), counts[k] / counts.sum()
    in_scans = float((some.valid & (some.ranges == value)).any(axis=1).mean())
    if share < SHARE or in_scans < REPEATED or counts[k] <= PEAK * beside.max():
        return []
    what = f"{100 * share:.1f} % of the valid ranges are exactly {value:.6g} m: it stands for no return"
    return [Finding("value for no return", what, (_limit(e, values, value),))]


def _limit(e: Evidence, values: Array, value: float) -> str:
    """Return the limit that leaves out a value, and as few others as it can."""
    if np.mean(values < value) >= 0.5:
        return f"{e.place}.range_max={math.floor(value * 1000.0 - 1.0) / 1000.0:.3f}"
    return f"{e.place}.range_min={math.ceil(value * 1000.0 + 1.0) / 1000.0:.3f}"


def _body(e: Evidence, some: Beams) -> list[Finding]:
    gone = np.hypot(*e.laser.twists[:, :2].T).sum(), np.abs(e.laser.twists[:, 2]).sum()
    if gone[0] < MOVED[0] or gone[1] < MOVED[1]:
        return []
    near = np.flatnonzero(some.valid.mean(axis=0) >= ALWAYS)
    ranges = np.where(some.valid[:, near], some.ranges[:, near], np.nan)
    usual = np.nanmedian(ranges, axis=0) if len(near) else np.empty(0)
    steady = np.abs(ranges - usual) <= STEADY[0] + STEADY[1] * usual
    body = (usual < BODY) & (steady.mean(axis=0) >= ALWAYS)
    if not body.any():
        return []
    meets, farthest = near[body], float(usual[body].max())
    return [_own_body(e, some, meets, farthest)]


def _dead(e: Evidence, some: Beams) -> list[Finding]:
    """Find sectors within the field of view in which no beam ever returns."""
    seen = np.flatnonzero(some.valid.any(axis=0))
    gaps = np.diff(seen) - 1
    if not len(gaps) or gaps.max() < max(DEAD * len(some.angles), 2.0):
        return []
    k = int(np.argmax(gaps))
    if not e.lidar.in_field(some.angles[seen[k] + 1 : seen[k + 1]]).any():
        return []
    first, last = np.degrees(some.angles[[seen[k] + 1, seen[k + 1] - 1]])
    what = f"no beam between {first:.0f} and {last:.0f} deg ever returns: something covers the lidar there"
    return [Finding("dead sector", what, harmful=False)]


def _own_body(e: Evidence, some: Beams, meets: Ints, farthest: float) -> Finding:
    angles = np.degrees(some.angles[meets])
    what = (
        f"{len(meets)} beams between {angles.min():.0f} and {angles.max():.0f} deg keep a range of up to "
        f"{farthest:.2f} m while the robot moves: they meet the robot itself"
    )
    limit = math.ceil(100.0 * (farthest + STEADY[0] + STEADY[1] * farthest)) / 100.0
    return Finding("own body in view", what, (f"{e.place}.range_min={limit:.2f}",), SUREST)
