"""A preset that fits the robot better than the config does."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from impslam.config import Config, load, presets
from impslam.diagnosis.agreement import agreement
from impslam.diagnosis.evidence import Evidence, gone_by
from impslam.diagnosis.finding import Finding
from impslam.diagnosis.handedness import handedness

KIND = "wrong preset"
GROSS = math.log(1.5)
"""Logarithm of a scale beyond which wheels are not worn or measured badly, but another robot's."""
FITS = math.log(1.15)
"""The same of a preset that is named instead: wheels slip, and tracks skid in turns."""


def preset(e: Evidence) -> Iterator[Finding]:
    """Find a config that is another robot's: its odometry is off by more than wear and slip can do."""
    if e.agreement is None or handedness(e) or not np.abs(e.gone[:, [0, 2]]).any():
        return
    off = misfit(e.axle, e.gone)
    if off < GROSS:
        return
    rivals = {name: _misfit_of(load(name), e) for name in presets()}
    name = min(rivals, key=rivals.__getitem__)
    if rivals[name] >= FITS:
        return
    way, turn = e.agreement.way.p[0], e.agreement.turn.p[1]
    yield Finding(
        KIND,
        f"by this config the wheels go {way:.3g} times the way and {turn:.3g} times the turns of the laser",
        advice=f"they fit preset {name}: -c {name}",
    )


def misfit(axle: np.ndarray, gone: np.ndarray) -> float:
    """Return the larger logarithm of the scales of ways and turns; inf where they are opposite."""
    agreed = agreement(axle, gone)
    way, turn = float(agreed.way.p[0]), float(agreed.turn.p[1])
    if min(way, turn) <= 0.0:
        return math.inf
    return max(abs(math.log(way)), abs(math.log(turn)))


def _misfit_of(config: Config, e: Evidence) -> float:
    odometry = config.make_robot().odometry
    if odometry.consumes is not e.odometry.consumes or not odometry.measures_motion:
        return math.inf
    return misfit(e.axle, gone_by(odometry, e.recording.odometry, e.times))
