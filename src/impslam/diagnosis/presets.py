"""Check whether another preset fits the robot better than the config."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from impslam.config import Config, load, presets
from impslam.diagnosis.agreement import fit_agreement
from impslam.diagnosis.evidence import Evidence, motion_by
from impslam.diagnosis.finding import Finding
from impslam.diagnosis.handedness import check_handedness

KIND = "wrong preset"
MIN_MISFIT = math.log(1.5)
"""Logarithm of a scale: more than wear and bad measurements explain, so the config is of another robot."""
MAX_MISFIT = math.log(1.15)
"""The same for the preset proposed instead: wheels slip, and tracks skid in turns."""


def check_preset(e: Evidence) -> Iterator[Finding]:
    """Find a config of another robot: its odometry is off by more than wear and slip explain."""
    if e.agreement is None or check_handedness(e) or not np.abs(e.odometry_motion[:, [0, 2]]).any():
        return
    off = misfit(e.axle_motion, e.odometry_motion)
    if off < MIN_MISFIT:
        return
    misfits = {name: _misfit_of(load(name), e) for name in presets()}
    name = min(misfits, key=misfits.__getitem__)
    if misfits[name] >= MAX_MISFIT:
        return
    distance, turn = e.agreement.distance.p[0], e.agreement.turn.p[1]
    yield Finding(
        KIND,
        f"by this config the wheels drive {distance:.3g} times the distance and {turn:.3g} times the "
        "turns of the laser",
        advice=f"they fit preset {name}: -c {name}",
    )


def misfit(axle_motion: np.ndarray, odometry_motion: np.ndarray) -> float:
    """Return the larger absolute logarithm of the distance and turn scales; inf if one is negative."""
    agreed = fit_agreement(axle_motion, odometry_motion)
    distance, turn = float(agreed.distance.p[0]), float(agreed.turn.p[1])
    if min(distance, turn) <= 0.0:
        return math.inf
    return max(abs(math.log(distance)), abs(math.log(turn)))


def _misfit_of(config: Config, e: Evidence) -> float:
    odometry = config.make_robot().odometry
    if odometry.consumes is not e.odometry.consumes or not odometry.measures_motion:
        return math.inf
    return misfit(e.axle_motion, motion_by(odometry, e.recording.odometry, e.times))
