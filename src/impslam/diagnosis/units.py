"""Find ranges and poses in mm, headings in degrees, and stamps in ms, by what no robot sees or does."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from impslam.columns import Columns
from impslam.diagnosis.evidence import Evidence
from impslam.diagnosis.finding import Finding
from impslam.odometry.odometry_pose import OdometryPoses
from impslam.types import Array

MIN_MEDIAN = 100.0
"""m, twice the range of a usual 2D lidar outdoors; in mm, closer than most surfaces that a robot sees."""
MIN_SHARE = 0.9
"""Share of the ranges beyond the limit: in mm, all but those of its own body; in m, those in the open."""
MILLIMETRES = 1000.0
MIN_JUMPS = 0.5
"""Share of the steps that are jumps: single ones are resets or lost readings."""
MIN_STEP = 1e-3
"""s: odometry comes at 1000 Hz at most."""
MAX_TURN_RATE = 10.0
"""rad/s, more than a turn and a half per second."""
MIN_PERIOD = 20.0
"""s from scan to scan: in ms, 50 scans per second, the most of usual lidars."""

MIN_PACE = 3e-3
"""m/s + rad/s, mean motion by odometry: in ms, 3 m/s, more than robots average. Robots that stop for a scan
every half a minute have ten times as much."""


def check_range_unit(e: Evidence) -> list[Finding]:
    """Find ranges in mm."""
    sample = e.samples
    if sample is None:
        return []
    ranges = sample.ranges[np.isfinite(sample.ranges) & (sample.ranges > 0.0)]
    share = float((ranges > sample.limit).mean()) if len(ranges) else 0.0
    if share < MIN_SHARE or (median := float(np.median(ranges))) < MIN_MEDIAN:
        return []
    what = (
        f"{100.0 * share:.1f} % of the ranges are beyond range_max, {sample.limit:.4g} m, with a median of "
        f"{median:.0f} m: they are in mm"
    )
    if sample.limit != e.lidar.range_max:  # no setting raises the limit in the messages
        advice = "write ranges in m like range_max, as ROS demands, or both in mm"
        return [Finding("ranges in mm", what, advice=advice, lidar=e.name)]
    scale = f"{e.lidar_key}.range_scale={1.0 / MILLIMETRES:g}"
    limit = f"{e.lidar_key}.range_max={MILLIMETRES * sample.limit:g}"
    return [Finding("ranges in mm", what, (scale, limit), lidar=e.name)]


def check_pose_units(e: Evidence) -> Iterator[Finding]:
    """Find poses in mm or degrees, and stamps in ms."""
    period = e.timing.period
    if period >= MIN_PERIOD:
        yield _milliseconds(e, period)
    elif isinstance(e.odometry, OdometryPoses) and e.recording.odometry and not e.untimed:
        yield from _poses(e.odometry, e.recording.odometry)


def _milliseconds(e: Evidence, period: float) -> Finding:
    """Return the finding on stamps in ms, a problem if odometry moves more slowly than any robot."""
    pace = e.odometry_total / (period * sum(map(len, e.recording.scans)))
    is_slow = 0.0 < pace < MIN_PACE
    moves = f", and odometry moves by {1000.0 * pace:.2g} mm or mrad per second" if is_slow else ""
    what = f"scans are stamped {period:.4g} s apart{moves}: their stamps {'are' if is_slow else 'may be'}"
    return Finding(
        "stamps in ms",
        f"{what} in ms",
        advice="of a CSV log, give --columns stamp=NAME*0.001",
        certainty=0.99 if is_slow else 0.5,
        harmful=is_slow,
    )


def _poses(odometry: OdometryPoses, readings: Sequence[Columns]) -> Iterator[Finding]:
    times, poses = _steps(readings, "stamp"), _steps(readings, "pose")
    usual = _usual_time(times)
    seconds = np.fmax(times, usual)
    yield from _lengths(odometry, np.hypot(*poses[:, :2].T), seconds)
    headings = np.concatenate([np.asarray(c["pose"])[:, 2] for c in readings])
    is_unwrapped = np.abs(headings).max() > math.tau  # wrapped ones look fast at each turn
    if usual and is_unwrapped:
        yield from _turns(np.abs(poses[:, 2]), seconds)


def _usual_time(times: Array) -> float:
    """Return the usual time from row to row, s, of times (m,); 0 if they show none.

    It is the median, or the mean if most rows share their stamp with others, as stamps in whole seconds do.
    """
    for usual in (np.median(times), np.fmax(times, 0.0).mean()) if len(times) else ():
        if usual >= MIN_STEP:
            return float(usual)
    return 0.0


def _lengths(odometry: OdometryPoses, lengths: Array, seconds: Array) -> Iterator[Finding]:
    """Find steps (m,) that are jumps by `max_speed`, but not if they are in mm."""
    speeds = odometry.distance_scale * (lengths / np.fmax(seconds, 0.2))[lengths > 0.0]
    if not len(speeds) or (speeds > odometry.max_speed).mean() < MIN_JUMPS:
        return
    typical = float(np.median(speeds))
    if 0.001 * typical < odometry.max_speed:
        scale = f"odometry.distance_scale={0.001 * odometry.distance_scale:g}"
        what = f"odometry drives at {typical:.3g} m/s and more: its poses are in mm"
        yield Finding("poses in mm", what, (scale,))


def _turns(turns: Array, seconds: Array) -> Iterator[Finding]:
    """Find turns (m,) faster than those of any robot."""
    rates = turns / seconds
    order = np.argsort(rates)
    passed = np.cumsum(turns[order])
    typical = float(rates[order[np.searchsorted(passed, 0.5 * passed[-1])]]) if len(turns) else 0.0
    if typical > MAX_TURN_RATE:
        what = f"half of odometry's turns are faster than {typical:.3g} rad/s: its headings are in degrees"
        advice = "of a CSV log, give --columns theta=NAME*0.0174533"
        yield Finding("poses in degrees", what, advice=advice)


def _steps(pieces: Sequence[Columns], name: str) -> Array:
    """Return the finite differences of a column from row to row."""
    values = np.concatenate([np.asarray(c.stamps if name == "stamp" else c[name]) for c in pieces])
    return np.diff(values, axis=0)
