"""Check in which order the beams of a sweep were measured, by the scans alone.

A lidar that spins clockwise measures its beams in the opposite order of ROS. Drivers reverse them, and some
leave `time_increment` positive: then the last beam in the message was measured first, and de-skewing
doubles the distortion instead of removing it.

Two scans of one place, taken while the robot turned at different rates, are distorted differently. They fit
each other only if they are de-skewed in the right order. The middle of a sweep is at the same time in both
orders, so neither odometry nor a lag of the stamps has an influence.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from impslam.calibration.lidar_path import LidarPath
from impslam.columns import Columns
from impslam.diagnosis.evidence import Evidence
from impslam.diagnosis.finding import Finding, is_off, probability_off
from impslam.diagnosis.robust import CLEAR
from impslam.types import Array, Ints

MIN_TURN = 0.03
"""rad that the turns during the two sweeps of a pair differ by: 8 cm at the end of a sweep, 5 m away."""
MAX_DISTANCE, MAX_VIEW_SHARE = 0.5, 0.35
"""m, and share of the field of view, between the scans of a pair: they see mostly the same surfaces."""
FULL_VIEW = 6.0
"""rad: a lidar with this field of view sees the same surfaces in any heading."""
NEIGHBOURS = 40
"""Scans before and after one, among which is its partner: over a few seconds, the path hardly drifts."""
MAX_PAIRS, MIN_PAIRS = 120, 12
"""Pairs that are compared, those with most turn first, a second of computing; and the least number."""
BATCH, LIKELY = 20, 2.0
"""Pairs after which the comparison ends if the order is clearly wrong, or right by so many standard
deviations: most lidars need no more, and the check before a run takes tenths of a second."""
MIN_GAIN = 0.1
"""Logarithm of the ratio of misfits, below which a change would hardly matter."""


def check_direction(e: Evidence) -> list[Finding]:
    """Find sweeps that were measured in the opposite order of their beams' times."""
    if not (e.lidar.deskew and e.odometry_moves):  # a run de-skews with odometry
        return []
    pairs = turning_pairs(e.path, e.recording.scans)
    if len(pairs) < MIN_PAIRS:
        return []
    gains = np.empty(0)
    for begin in range(0, len(pairs), BATCH):
        gains = np.append(gains, _gains(e, pairs[begin : begin + BATCH]))
        gain, sigma = _mean(gains)
        if gain > CLEAR * sigma or gain < -LIKELY * sigma:
            break
    if gain < MIN_GAIN or not is_off(gain, sigma, 0.0):
        return []
    return [_reversed(e, len(gains), gain, sigma)]


def _mean(gains: Array) -> tuple[float, float]:
    """Return the mean of k gains and its standard deviation; infinite if there are too few."""
    if len(gains) < MIN_PAIRS:
        return 0.0, math.inf
    return float(gains.mean()), float(gains.std(ddof=1)) / math.sqrt(len(gains))


def turning_pairs(path: LidarPath, scans: Sequence[Columns]) -> Ints:
    """Return the rows (k, 2) of scans of one place with different turns during their sweeps.

    Each scan is in one pair at most, so that errors of pairs are independent.
    """
    turns = path.twists[:, 2] * np.concatenate([_durations(piece) for piece in scans])
    views = np.concatenate([np.full(len(piece), np.ptp(piece["angles"])) for piece in scans])
    limits = np.where(views > FULL_VIEW, np.inf, MAX_VIEW_SHARE * views)
    lost, free, pairs = np.cumsum(~path.trusted), path.trusted.copy(), list[tuple[int, int]]()
    for b in np.argsort(-np.abs(turns), kind="stable").tolist():
        if abs(turns[b]) < 0.5 * MIN_TURN or len(pairs) == MAX_PAIRS:
            break
        near = np.arange(max(b - NEIGHBOURS, 0), min(b + NEIGHBOURS + 1, len(turns)))
        offset = np.abs(path.poses[near] - path.poses[b])
        same = free[b] & free[near] & (lost[near] == lost[b]) & (offset[:, 2] < limits[b])
        same &= np.hypot(offset[:, 0], offset[:, 1]) < MAX_DISTANCE
        differences = np.where(same, np.abs(turns[near] - turns[b]), 0.0)
        a = int(near[np.argmax(differences)])
        if differences.max() >= MIN_TURN:
            pairs.append((a, b))
            free[[a, b]] = False
    return np.array(pairs, np.int64).reshape(-1, 2)


def _durations(scans: Columns) -> Array:
    return np.full(len(scans), scans["time_offsets"].max(initial=0.0))


def _gains(e: Evidence, pairs: Ints) -> Array:
    """Return (k,) the logarithm of how much less the scans of a pair misfit in the other order."""
    from impslam.diagnosis.misfit import pair_misfits  # noqa: PLC0415  0.2 s, only for sweeps in turns

    opposite = e.lidar.model_copy(update={"last_beam_first": not e.lidar.last_beam_first})
    given, other = (
        pair_misfits(lidar, e.recording.scans, e.path, pairs) for lidar in (e.lidar, opposite)
    )
    known = (given > 0.0) & (other > 0.0)
    gains: Array = np.log(given[known] / other[known])
    return gains


def _reversed(e: Evidence, pairs: int, gain: float, sigma: float) -> Finding:
    first = "first" if e.lidar.last_beam_first else "last"
    return Finding(
        "sweep reversed",
        f"the {first} beam of a scan was measured first: in this order, {pairs} pairs of scans at "
        f"different turn rates fit each other {math.exp(gain):.1f} times as well",
        (f"{e.lidar_key}.last_beam_first={str(not e.lidar.last_beam_first).lower()}",),
        probability_off(gain, sigma, 0.0),
        lidar=e.name,
    )
