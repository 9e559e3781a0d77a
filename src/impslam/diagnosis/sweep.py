"""Check how long a sweep takes, and in which order its beams are measured.

Two scans of one place, taken while the robot turned at different rates, are distorted differently. They fit
each other only if they are de-skewed in the right order and for the right time; see `sweep_time`. The
middle of a sweep is at the same time in both orders, so neither odometry nor a lag of the stamps has an
influence.

Drivers leave time_increment at 0, or state it in another unit. Those of lidars that spin clockwise reverse
the beams and not their times; then de-skewing doubles the distortion instead of removing it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from impslam.calibration.lidar_path import LidarPath, unmounted
from impslam.columns import Columns
from impslam.diagnosis.evidence import FULL_VIEW, Evidence
from impslam.diagnosis.finding import Finding, is_off, probability_off
from impslam.diagnosis.mount import YAW_TOLERANCE
from impslam.diagnosis.stamps import check_stamps
from impslam.diagnosis.sweep_time import sweep_time
from impslam.health import DISTORTED, LogFault
from impslam.sensors.lidar2d import Lidar2D
from impslam.types import Array, Ints, Mask

WRONG_TIME = "sweep time wrong"
MAX_SWEEP_RATIO = 1.1
"""Largest duration of a sweep, in median times between scans; drivers round."""
TIME_TOLERANCE = YAW_TOLERANCE
"""s: at 1 rad/s, a scan that is de-skewed for so much too long or too short is bent by as many rad as
lasers are mounted off by."""
MAX_PERIOD = 0.25
"""s between scans, beyond which the twist during a sweep is not the mean one from the scan before to that
after it: turns begin and end within half a second."""
MAX_IRREGULARITY = 0.25
"""Share of the period by which the times around a scan may differ from it: twists are by these times."""
MIN_TURN = 0.03
"""rad that the turns of the two scans of a pair differ by per period: 15 cm of a surface 5 m away."""
MAX_DISTANCE, MAX_VIEW_SHARE = 0.5, 0.35
"""m, and share of the field of view, between the scans of a pair: they see mostly the same surfaces."""
NEIGHBOURS = 40
"""Scans before and after one, among which is its partner: over a few seconds, the path hardly drifts."""
MAX_PAIRS, MIN_PAIRS = 40, 12
"""Pairs that are compared, those with most turn first, which determine the duration to some ms in tenths of
a second of computing; and the least number."""


def check_overlap(e: Evidence) -> Iterator[Finding]:
    """Find sweeps that last longer, by their beams' times, than the time between scans."""
    sweep, period = abs(e.sweep_time), e.timing.period
    if not (e.lidar.deskew and period and sweep > MAX_SWEEP_RATIO * period):
        return
    found = _estimate(e)
    fits = found is not None and abs(found[0]) < MAX_SWEEP_RATIO * period
    off = e.sweep_time - found[0] if found and fits else sweep - period
    yield Finding(
        "sweep too long",
        f"a sweep takes {sweep:.3f} s by its beams' times, but scans come every {period:.3f} s",
        _settings(e, found[0]) if found and fits else (f"{e.lidar_key}.deskew=false",),
        advice="time_increment in the log is wrong",
        fault=LogFault(DISTORTED, abs(off)),
        lidar=e.name,
    )


def is_instant(e: Evidence) -> bool:
    """Return whether the beams have no times, and need none.

    A lidar turns at least once per scan, so a sweep takes at most the share of the period that is in view.
    """
    return e.sweep_time == 0.0 and e.timing.period * e.view <= TIME_TOLERANCE * math.tau


def check_times(e: Evidence) -> list[Finding]:
    """Check sweeps and stamps; if sweeps take another time, their stamps seem late by half of the error."""
    found = check_sweep(e)
    if any(one.kind == WRONG_TIME for one in found):
        return found
    return [*found, *check_stamps(e)]


def check_sweep(e: Evidence) -> list[Finding]:
    """Find sweeps of another duration than that of their beams' times, or in the opposite order."""
    found = _estimate(e) if e.lidar.deskew and not e.untimed else None
    if found is None:
        return []
    (seconds, sigma), given = found, e.sweep_time
    off = seconds - given
    if not is_off(off, sigma, TIME_TOLERANCE):
        return []
    is_reversed = seconds * given < 0.0
    long = f"{abs(seconds):.3f} ± {max(sigma, 1e-3):.3f} s"
    told = "time_increment in the log"
    if not math.isnan(e.lidar.sweep_time):
        told = f"{e.lidar_key}.sweep_time"
    what = f"a sweep takes {long}, not {abs(given):.3f} s, as {told} says"
    if is_reversed:
        first = "last" if seconds < 0.0 else "first"
        what = f"the {first} beam of a scan was measured first: a sweep takes {long} in this order"
    return [
        Finding(
            "sweep reversed" if is_reversed else WRONG_TIME,
            f"{what}: so scans of one place fit each other best at different turn rates",
            _settings(e, seconds),
            probability_off(off, sigma, TIME_TOLERANCE),
            fault=LogFault(DISTORTED, abs(off)),
            lidar=e.name,
        )
    ]


def _settings(e: Evidence, seconds: float) -> tuple[str, ...]:
    """Return the settings for a duration of sweeps; negative if the last beam is first."""
    settings, is_last_first = list[str](), seconds < 0.0
    if abs(abs(seconds) - abs(e.sweep_time)) > TIME_TOLERANCE:
        settings.append(f"{e.lidar_key}.sweep_time={abs(seconds):.4f}")
    if is_last_first != e.lidar.last_beam_first:
        settings.append(f"{e.lidar_key}.last_beam_first={str(is_last_first).lower()}")
    return tuple(settings)


def _estimate(e: Evidence) -> tuple[float, float] | None:
    """Return the duration of the sweeps and its standard deviation, s; None if the scans do not show it."""
    period = e.timing.period
    if not 0.0 < period <= MAX_PERIOD:
        return None
    pairs = turning_pairs(e.path, e.recording.scans, period)
    if len(pairs) < MIN_PAIRS:
        return None
    free = {"deskew": True, "last_beam_first": False, "sweep_time": math.nan}
    own = Lidar2D(**{**unmounted(e.lidar).model_dump(), **free})
    return sweep_time(own, e.recording.scans, e.path, pairs, e.sweep_time, period)


def turning_pairs(path: LidarPath, scans: Sequence[Columns], period: float) -> Ints:
    """Return the rows (k, 2) of scans of one place at different turn rates.

    Each scan is in one pair at most, so that errors of pairs are independent.
    """
    turns = path.twists[:, 2] * period
    views = np.concatenate([np.full(len(piece), np.ptp(piece["angles"])) for piece in scans])
    limits = np.where(views > FULL_VIEW, np.inf, MAX_VIEW_SHARE * views)
    free = path.trusted & path.located & _is_regular(path.middles, period)
    pairs = list[tuple[int, int]]()
    lost = np.cumsum(~path.trusted)
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


def _is_regular(times: Array, period: float) -> Mask:
    """Return (n,) whether the times before and after each scan are a period apart from it on average."""
    if len(times) < 2:
        return np.zeros(len(times), np.bool_)
    return np.asarray(np.abs(np.gradient(times) - period) < MAX_IRREGULARITY * period)
