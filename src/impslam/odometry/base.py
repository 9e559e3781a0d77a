"""The interface of odometry, which turns proprioceptive readings into motions (thesis 3.5)."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar, Self

import numpy as np

from impslam.columns import Columns, Motions
from impslam.component import Component, parameter
from impslam.noise import MotionNoise, SystematicErrors
from impslam.odometry.gyro import Gyro
from impslam.odometry.standstill import Band
from impslam.types import Array, Mask

DIAGONAL = (slice(None), [0, 1, 2], [0, 1, 2])
"""Index of the diagonals of an array (m, 3, 3)."""


class Odometry(Component):
    """Turns readings into motions. It has no state; `odometry.stream` joins the batches of a log."""

    role: ClassVar[str] = "odometry"
    consumes: ClassVar[type]
    """The type of message that it reads."""
    holds: ClassVar[bool] = False
    """Whether a reading is valid until the next one, like a velocity. The motions on both sides of an
    unusable reading are then unknown. Otherwise an unusable reading is skipped, and the motion is that
    between its neighbours."""

    measures_motion: ClassVar[bool] = True
    """Whether its readings contain motion."""

    stream: str = parameter(
        "", "", "the stream that it reads; empty: the first one of its kind in the log"
    )
    gyro: Gyro = parameter(Gyro(), "", "the gyro that corrects its turns")

    def split(self) -> tuple[Self, SystematicErrors | None]:
        """Return this odometry without systematic errors in its covariances, and these if it has any."""
        for name, noise in self:
            if isinstance(noise, MotionNoise) and noise.systematic > 0.0:
                rest, systematic = noise.split()
                return self.model_copy(update={name: rest}), systematic
        return self, None

    def readings(self, rows: Columns) -> Columns:
        """Return the columns that odometry needs of the rows of its stream."""
        return rows

    @property
    def standstill_band(self) -> Band:
        """The noise of the readings of a stationary robot; see `odometry.standstill`."""
        return Band()

    @property
    def lever(self) -> float:
        """Distance that the robot moves when a slipping wheel turns it by 1 rad, m."""
        return 0.0

    @abstractmethod
    def usable(self, readings: Columns) -> Mask:
        """Return (m,) which readings are usable by themselves, e.g. finite."""

    @abstractmethod
    def motions(self, readings: Columns) -> Motions:
        """Return the m motions between m + 1 readings.

        A motion is NaN if it is unknown: an impossible jump, a velocity that lasts too long, or, if
        `holds`, a motion next to an unusable reading. Without `holds` all readings must be usable.
        """

    @abstractmethod
    def fault(self, readings: Columns) -> str:
        """Return one line that describes why a reading, or the motion to it, is unusable, and the remedy.

        `readings` is the row, preceded by the reading where the motion starts, if there is one.
        """


def durations(readings: Columns) -> Array:
    """Return the durations (m,) in s between m + 1 readings; 0 where stamps run backwards."""
    stamps = readings.stamps
    return np.maximum(stamps[1:] - stamps[:-1], 0.0)


def add_path_uncertainty(covariance: Array, travel: Array, unknown: Array | Mask) -> None:
    """Add the uncertainty of travels (m,) m whose paths are not measured to `covariance` (m, 3, 3).

    `unknown` (m,) is 0 for known paths and 1 for unknown ones. The end of an unknown path is anywhere
    within its length from the start: half of it is one standard deviation.
    """
    variance = (0.5 * travel * unknown) ** 2
    covariance[:, 0, 0] += variance
    covariance[:, 1, 1] += variance


def mask_unknown(motions: Motions, known: Mask) -> Motions:
    """Return the motions with NaN where `known` (m,) is false."""
    if known.all():
        return motions
    nothing = np.where(known, 0.0, np.nan)
    return motions._replace(
        d_pose=motions.d_pose + nothing[:, None],
        covariance=motions.covariance + nothing[:, None, None],
    )


def gap_message(readings: Columns, what: str) -> str:
    """Return the message for a gap that is too long for a reading to be valid until the next one."""
    last, stamp = map(float, readings.stamps[-2:])
    return (
        f"no {what} for {stamp - last:.1f} s before {stamp:.3f} s; the motion in between is "
        "ignored: check the log, or raise odometry.max_hold"
    )


def diagonal(variances: Array) -> Array:
    """Return (m, 3, 3) with variances (m, 3) on the diagonals."""
    covariance = np.zeros((len(variances), 3, 3))
    covariance[DIAGONAL] = variances
    return covariance
