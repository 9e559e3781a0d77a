"""What the report and the summary need of a run: its path, dead reckoning, quality and truth."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from impslam.evaluation.quality import Quality, quality
from impslam.health import NONE, Health
from impslam.map import Map, PathRows
from impslam.types import Array


def health_of(known: Map, health: Health) -> Health:
    """Return the health of `known.rows()`: of sweeps before those of the run nothing bad is known.

    `health` is that of the newest sweeps of the map.
    """
    begin = len(known.stamps) - len(health.stamps)
    reasons, amounts = np.full(len(known.stamps), NONE, np.int8), np.zeros(len(known.stamps))
    reasons[begin:], amounts[begin:] = health.reasons, health.amounts
    placed = known.placed()
    return Health(known.stamps[placed], reasons[placed], amounts[placed])


@dataclass(frozen=True, eq=False)
class History:
    """A map's path beside the truth.

    Attributes
    ----------
    known : the map
    true_path : (m, 4) stamp, x, y, theta (NaN if not told); m = 0 where the log has no truth
    """

    known: Map
    true_path: Array

    @cached_property
    def rows(self) -> PathRows:
        """The path with its covariances."""
        return self.known.rows()

    @cached_property
    def quality(self) -> Quality:
        """How well the scans agree with each other."""
        return quality(self.known)

    @property
    def path(self) -> Array:
        """(n, 4) stamp, x, y, theta."""
        return np.column_stack((self.rows.stamps, self.rows.poses))

    @property
    def odometry(self) -> Array:
        """(n, 4) stamp, x, y, theta."""
        return self.known.odometry()

    @property
    def covariances(self) -> Array:
        """(n, 3, 3) of the poses."""
        return self.rows.covariances

    @property
    def sigmas(self) -> Array:
        """(n, 3) m, m, rad: standard deviations of the poses."""
        return np.sqrt(np.maximum(np.diagonal(self.covariances, axis1=1, axis2=2), 0.0))
