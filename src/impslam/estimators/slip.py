"""Detect wheel slip from the observations of landmarks.

Slipping wheels report a motion that did not happen, with the small covariance of rolling wheels. Landmarks
are then outside their gates and not matched; the error remains, and the next slip adds to it. Therefore, if
observations match nothing known, the motion is tried again with the covariance of slipping wheels, and kept
so if that explains most of them and makes all observations more likely.
"""

from __future__ import annotations

import math
from collections.abc import Sequence, Set
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from impslam.association.base import Assignment, Joint, log_normal
from impslam.errors import NumericalError
from impslam.types import Increment, Match, Observation

SLIP_SHARE = 0.3
"""Standard deviation of slip as a share of the measured motion. Wheels on a smooth floor slip by 10 to
30 %, and the gate passes three times as much."""
TRACK = 0.4
"""m, of small robots: a single slipping wheel turns the robot by its slip over the track."""
DENSITY = 0.1
"""Objects that can be mistaken for a landmark: one in 10 m^2 of a room; for walls, one in 10 m rad."""
RECENT = 5
"""Keyframes, over 0.6 m, within which a matched landmark counts as seen just before."""
MIN_KNOWN = 2
"""Observations of landmarks not seen just before that are needed: a single one may be a new neighbour."""


class Attempt(NamedTuple):
    """The association of a scan under one assumption on the motion.

    Attributes
    ----------
    choice : the matches with landmarks
    tentative : matches of other observations with tentative landmarks
    """

    choice: Assignment
    tentative: Sequence[Match]

    def unexplained(self, count: int) -> int:
        """Return how many of `count` observations show nothing known."""
        known = len(self.choice.matches) + len(self.choice.ambiguous) + len(self.tentative)
        return count - known

    def evidence(self, joint: Joint, observations: Sequence[Observation]) -> float:
        """Return the log likelihood ratio of all matches against as many new objects.

        Raises
        ------
        NumericalError
            If the joint covariance of the innovations has no inverse.
        """
        matches, likelihood = self.choice.matches, 0.0
        if matches:
            innovation, S = joint(observations, matches)
            try:
                likelihood = log_normal(float(innovation @ np.linalg.solve(S, innovation)), S)
            except np.linalg.LinAlgError as error:
                raise NumericalError("the covariance of the innovations is singular") from error
        likelihood += sum(log_normal(match.distance2, match.S) for match in self.tentative)
        return likelihood - (len(matches) + len(self.tentative)) * math.log(DENSITY)


def explains(slipped: Attempt, rolled: Attempt, count: int, recent: Set[int]) -> bool:
    """Return whether slip explains most of the unexplained ones of `count` observations.

    A single observation suffices if it shows something seen just before: one of the `recent` landmarks, or
    a tentative one.
    """
    if_slipped, if_rolled = (
        {m.observation for m in attempt.choice.matches} for attempt in (slipped, rolled)
    )
    gained = {m.landmark for m in slipped.choice.matches if m.observation not in if_rolled}
    tentative = len(slipped.tentative) - len(rolled.tentative)
    known = len(gained) + tentative
    if known < max(1.0, rolled.unexplained(count) / 2):
        return False
    if tentative < 0 or not if_rolled <= if_slipped:
        return False
    return known >= MIN_KNOWN or gained <= recent


def slipped(motion: Increment) -> Increment:
    """Return a motion with the covariance of slipping wheels: both alike, or each independently."""
    distance, turn = math.hypot(motion.d_pose[0], motion.d_pose[1]), motion.d_pose[2]
    wheels = SLIP_SHARE * np.array([distance - 0.5 * TRACK * turn, distance + 0.5 * TRACK * turn])
    # A heading error that grows over the distance moves the robot aside by half of it.
    by_wheel = np.array(
        [
            [0.5, 0.5],
            [-0.5 * distance / TRACK, 0.5 * distance / TRACK],
            [-1.0 / TRACK, 1.0 / TRACK],
        ]
    )
    common, single = SLIP_SHARE * motion.d_pose, by_wheel * wheels
    covariance = motion.covariance + np.outer(common, common) + single @ single.T
    return replace(motion, covariance=covariance)
