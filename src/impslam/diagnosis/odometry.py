"""Check for odometry that stands still while the robot moves, or that has no sign."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from impslam.diagnosis.evidence import Evidence
from impslam.diagnosis.finding import Finding

MAX_STILL = 0.02
"""Share of the laser's motion below which odometry stands still."""
MIN_STILL_STRETCHES = 3
"""Stretches without odometry motion that cannot be slip: a metre, or a radian."""
MIN_DIRECTED_STRETCHES = 5
"""Stretches forward, and stretches backward, needed to detect odometry without a sign."""
MAX_CONTRADICTING = 0.2
"""Share of stretches that may contradict: slips."""


def check_odometry(e: Evidence) -> list[Finding]:
    """Find odometry that stands still or has no sign."""
    if e.agreement is None or not e.drives_ahead:
        return []
    if still := _stands_still(e):
        return [still]
    return [*find_unsigned(e), *(() if e.untimed else _stops(e))]


def _stands_still(e: Evidence) -> Finding | None:
    if e.odometry_moves:
        return None
    distance, turn = np.abs(e.axle_motion).sum(axis=0)
    if e.odometry_total > MAX_STILL * (distance + turn):  # it moves, at other times
        return None
    return Finding(
        "odometry stands still",
        f"odometry stands still while the laser moves {distance:.1f} m and turns "
        f"{math.degrees(turn):.0f} deg",
        (
            "odometry.kind=lidar_only",
            *(() if e.matches_scans else ("tracker.kind=scan_to_map",)),
        ),
    )


def _stops(e: Evidence) -> Iterator[Finding]:
    """Find stretches over which odometry does not move at all: lost or repeated readings."""
    by_odometry = np.hypot(e.odometry_motion[:, 0], e.odometry_motion[:, 2])
    still = by_odometry < MAX_STILL * np.abs(e.axle_motion).max(axis=1)
    if still.sum() < MIN_STILL_STRETCHES or still.mean() > 0.5:  # more are a scale error
        return
    distance, turn = np.abs(e.axle_motion[still]).sum(axis=0)
    yield Finding(
        "odometry stops",
        f"odometry stands still for {float(np.ptp(e.times[still], axis=1).sum()):.0f} s, first at "
        f"{e.times[still][0, 0]:.1f} s, while the laser moves {distance:.1f} m and turns "
        f"{math.degrees(turn):.0f} deg",
        () if e.matches_scans else ("tracker.kind=scan_to_map",),
        advice="readings are lost: check the link",
        harmful=not e.matches_scans,
    )


def find_unsigned(e: Evidence) -> Iterator[Finding]:
    """Find odometry that reports backward motion as forward; slips are rare and have either sign."""
    true, measured = e.axle_motion[:, 0], e.odometry_motion[:, 0]
    far = np.abs(true) > 0.5 * np.abs(e.axle_motion).max(initial=0.0)
    far &= np.abs(measured) > 0.5 * np.abs(true)
    back, ahead = far & (true < 0.0), far & (true > 0.0)
    if min(back.sum(), ahead.sum()) < MIN_DIRECTED_STRETCHES:
        return
    wrong, right = (measured[back] > 0.0).mean(), (measured[ahead] > 0.0).mean()
    if min(wrong, right) >= 1.0 - MAX_CONTRADICTING:
        distance = -float(true[back].sum())
        yield Finding(
            "odometry unsigned",
            f"odometry cannot tell backward from forward: {back.sum()} stretches backward, "
            f"{distance:.1f} m, are reported as forward",
            () if e.matches_scans else ("tracker.kind=scan_to_map",),
            advice="a run follows the scans there",
            harmful=not e.matches_scans,
        )
