"""Odometry that stands still while the robot moves, or cannot tell backward from forward."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from impslam.diagnosis.evidence import Evidence
from impslam.diagnosis.finding import Finding

STILL = 0.02
"""Share of the laser's motion below which odometry stands still."""
FEWEST_STILL = 3
"""Stretches of that kind from which on it is no slip: a metre, or a radian."""
FEWEST_BACK = 5
"""Stretches backward from which on odometry without a sign shows."""
MOST_OTHER = 0.2
"""Share of stretches that may contradict: slips."""


def odometry(e: Evidence) -> list[Finding]:
    """Find odometry that stands still or has no sign."""
    if e.agreement is None:
        return []
    if still := _stands_still(e):
        return [still]
    return [*unsigned(e), *_stops(e)]


def _stands_still(e: Evidence) -> Finding | None:
    if e.goes:
        return None
    way, turn = np.abs(e.axle).sum(axis=0)
    return Finding(
        "odometry stands still",
        f"odometry stands still while the laser goes {way:.1f} m and turns {math.degrees(turn):.0f} deg",
        (
            "odometry.kind=lidar_only",
            *(() if e.matches_scans else ("tracker.kind=scan_to_map",)),
        ),
    )


def _stops(e: Evidence) -> Iterator[Finding]:
    """Find stretches over which odometry does not move at all: readings that are lost or held."""
    still = np.hypot(e.gone[:, 0], e.gone[:, 2]) < STILL * np.abs(e.axle).max(axis=1)
    if still.sum() < FEWEST_STILL or still.mean() > 0.5:  # more are an error of scale
        return
    way, turn = np.abs(e.axle[still]).sum(axis=0)
    yield Finding(
        "odometry stops",
        f"odometry stands still for {float(np.ptp(e.times[still], axis=1).sum()):.0f} s, first at "
        f"{e.times[still][0, 0]:.1f} s, while the laser goes {way:.1f} m and turns "
        f"{math.degrees(turn):.0f} deg",
        () if e.matches_scans else ("tracker.kind=scan_to_map",),
        advice="readings are lost: check the link",
        harmful=not e.matches_scans,
    )


def unsigned(e: Evidence) -> Iterator[Finding]:
    """Find odometry that logs ways backward as forward; slips are rare, and go either way."""
    far = np.abs(e.axle[:, 0]) > 0.5 * np.abs(e.axle).max(initial=0.0)
    far &= np.abs(e.gone[:, 0]) > 0.5 * np.abs(e.axle[:, 0])
    back, ahead = far & (e.axle[:, 0] < 0.0), far & (e.axle[:, 0] > 0.0)
    if min(back.sum(), ahead.sum()) < FEWEST_BACK:
        return
    wrong, right = (e.gone[back, 0] > 0.0).mean(), (e.gone[ahead, 0] > 0.0).mean()
    if min(wrong, right) >= 1.0 - MOST_OTHER:
        way = -float(e.axle[back, 0].sum())
        yield Finding(
            "odometry unsigned",
            f"odometry cannot tell backward from forward: {back.sum()} stretches backward, {way:.1f} m, "
            "are logged as forward",
            () if e.matches_scans else ("tracker.kind=scan_to_map",),
            advice="a run follows the scans there",
            harmful=not e.matches_scans,
        )
