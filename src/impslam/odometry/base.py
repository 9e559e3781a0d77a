"""The role of odometry: rows of proprioceptive data in, motions out (thesis 3.5)."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

import numpy as np

from impslam.columns import Columns, Motions
from impslam.component import Component, parameter
from impslam.types import Array, Mask

DIAGONAL = (slice(None), [0, 1, 2], [0, 1, 2])
"""Of (m, 3, 3)."""


class Odometry(Component):
    """Turns readings into motions that compose. It keeps nothing: what a batch leaves is the caller's."""

    role: ClassVar[str] = "odometry"
    consumes: ClassVar[type]
    """The type of message it understands."""
    holds: ClassVar[bool] = False
    """Whether a reading holds until the next one, as a velocity does. Then no motion is known on
    either side of one that cannot be used; otherwise it is passed over, and the motion across it is
    that between its neighbours."""

    stream: str = parameter(
        "", "", "the stream it reads; empty: the first one of its kind in the log"
    )

    @abstractmethod
    def usable(self, readings: Columns) -> Mask:
        """Return (m,) which readings tell something by themselves; those that are not finite do not."""

    @abstractmethod
    def motions(self, readings: Columns) -> Motions:
        """Return the m motions between m + 1 readings.

        A motion that is not known is NaN: an impossible jump, a velocity that held for too long, and
        where `holds`, one beside a reading that is not usable. Otherwise all readings must be usable.
        """

    @abstractmethod
    def fault(self, readings: Columns) -> str:
        """Say in one line why a reading, or the motion to it, cannot be used, and what to do.

        `readings` is that row, and before it the one from which the motion began, if any.
        """


def durations(readings: Columns) -> Array:
    """Return (m,) s between m + 1 readings; where stamps run backwards, 0."""
    stamps = readings.stamps
    return np.maximum(stamps[1:] - stamps[:-1], 0.0)


def known(motions: Motions, which: Mask) -> Motions:
    """Return motions with NaN in place of those that are not known."""
    if which.all():
        return motions
    nothing = np.where(which, 0.0, np.nan)
    return motions._replace(
        d_pose=motions.d_pose + nothing[:, None],
        covariance=motions.covariance + nothing[:, None, None],
    )


def silence(readings: Columns, what: str) -> str:
    """Say that a reading was followed by too long a silence to have held until the next one."""
    last, stamp = map(float, readings.stamps[-2:])
    return (
        f"no {what} for {stamp - last:.3g} s before {stamp:.3f} s; the motion in between is left "
        "out: check the log, or raise odometry.max_hold"
    )


def diagonal(variances: Array) -> Array:
    """Return (m, 3, 3) with variances (m, 3) on the diagonals."""
    covariance = np.zeros((len(variances), 3, 3))
    covariance[DIAGONAL] = variances
    return covariance
