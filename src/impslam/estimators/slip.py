"""What a motion is worth if the wheels have slipped.

Wheels that slip tell a way that was not gone, with the small covariance of wheels that roll. Landmarks are
then outside of their gates, and not matched; the error stays, and the next slip adds to it. So where
several observations are left over, the motion is tried once more with the covariance of wheels that have
slipped, and is taken so if most of what was left over is then matched.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from impslam.association.base import Assignment
from impslam.types import Increment

SHARE = 0.3
"""Of the way and the turn that wheels tell, what slips: one standard deviation. Wheels on a smooth floor
slip by 10 to 30 %, and the gate lets three times as much pass."""
TRACK = 0.4
"""m: one wheel that slips turns the robot by its slip over the track; that of small robots."""
LEAST = 2
"""Observations that have to be left over, and to match: one may be a new thing beside a landmark."""


def left_over(choice: Assignment, count: int) -> int:
    """Return how many of `count` observations fit no landmark."""
    return count - len(choice.matches) - len(choice.ambiguous)


def explains(slipped: Assignment, rolled: Assignment, count: int) -> bool:
    """Tell whether most of what is left over of `count` observations matches if the wheels have slipped."""
    gained = len(slipped.matches) - len(rolled.matches)
    return gained >= max(LEAST, left_over(rolled, count) / 2)


def slipped(motion: Increment) -> Increment:
    """Return a motion with the covariance of wheels that have slipped: both alike, or each by itself."""
    way, turn = math.hypot(motion.d_pose[0], motion.d_pose[1]), motion.d_pose[2]
    wheels = SHARE * np.array([way - 0.5 * TRACK * turn, way + 0.5 * TRACK * turn])
    # A turn that is wrong all the way carries the robot aside by half the way.
    by_wheel = np.array(
        [[0.5, 0.5], [-0.5 * way / TRACK, 0.5 * way / TRACK], [-1.0 / TRACK, 1.0 / TRACK]]
    )
    alike, alone = SHARE * motion.d_pose, by_wheel * wheels
    return replace(motion, covariance=motion.covariance + np.outer(alike, alike) + alone @ alone.T)
