"""What a motion is worth if the wheels have slipped.

Wheels that slip tell a way that was not gone, with the small covariance of wheels that roll. Landmarks are
then outside of their gates, and not matched; the error stays, and the next slip adds to it. So where
observations show nothing that is known, the motion is tried once more with the covariance of wheels that
have slipped, and is taken so if that explains most of them and makes all that is seen more likely.
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

SHARE = 0.3
"""Of the way and the turn that wheels tell, what slips: one standard deviation. Wheels on a smooth floor
slip by 10 to 30 %, and the gate lets three times as much pass."""
TRACK = 0.4
"""m: one wheel that slips turns the robot by its slip over the track; that of small robots."""
DENSITY = 0.1
"""Things that a landmark can be mistaken for: one on 10 m^2 of a room; of walls, one in 10 m rad."""
RECENT = 5
"""Keyframes, 0.6 m of way, for which a landmark that is not seen is one that was seen just before."""
LEAST = 2
"""Observations that have to be known then, if not seen just before: one may be new beside a landmark."""


class Attempt(NamedTuple):
    """What a motion makes of a scan.

    Attributes
    ----------
    choice : its observations and landmarks
    tentative : others that show again what is not in the map yet
    """

    choice: Assignment
    tentative: Sequence[Match]

    def left_over(self, count: int) -> int:
        """Return how many of `count` observations show nothing that is known."""
        known = len(self.choice.matches) + len(self.choice.ambiguous) + len(self.tentative)
        return count - known

    def evidence(self, joint: Joint, observations: Sequence[Observation]) -> float:
        """Return the log likelihood of what is seen, over that of as many things not seen before.

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
    """Tell whether most of what is left over of `count` observations is known if the wheels have slipped.

    One observation is enough if it shows what was seen just before: one of the `recent` landmarks, or
    something tentative.
    """
    ours, theirs = (
        {m.observation for m in attempt.choice.matches} for attempt in (slipped, rolled)
    )
    gained = {m.landmark for m in slipped.choice.matches if m.observation not in theirs}
    again = len(slipped.tentative) - len(rolled.tentative)
    known = len(gained) + again
    if known < max(1.0, rolled.left_over(count) / 2) or again < 0 or not theirs <= ours:
        return False
    return known >= LEAST or gained <= recent


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
