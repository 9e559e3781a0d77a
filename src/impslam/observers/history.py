"""A run's path, dead reckoning, quality and true path, for the report and the summary."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from impslam.evaluation.quality import Quality, quality
from impslam.health import NONE, Health
from impslam.map import Map, PathRows
from impslam.types import Array


def health_of(known: Map, health: Health) -> Health:
    """Return the health of `known.rows()`, given that of the map's newest sweeps.

    Earlier sweeps, of the continued map, have no reason for concern.
    """
    begin = len(known.stamps) - len(health.stamps)
    reasons, amounts = np.full(len(known.stamps), NONE, np.int8), np.zeros(len(known.stamps))
    reasons[begin:], amounts[begin:] = health.reasons, health.amounts
    placed = known.placed()
    return Health(known.stamps[placed], reasons[placed], amounts[placed])


def rows_of_log(known: Map, health: Health) -> slice:
    """Return the rows of `known.rows()` of the newest log, given the health of the newest run's sweeps.

    In a continued map, earlier rows are of other logs. A run of this log that was stopped is in the same
    session, and belongs to it.
    """
    begin = len(known.stamps) - len(health.stamps)
    if begin == len(known.stamps):
        return slice(0, None)
    sessions = known.keyframes.sessions[known.anchors]
    first = int(np.argmax(sessions == sessions[begin]))
    return slice(int(np.count_nonzero(known.placed()[:first])), None)


@dataclass(frozen=True, eq=False)
class History:
    """The path of a map, and the true path.

    Attributes
    ----------
    known : the map
    true_path : (m, 4) stamp, x, y, theta (NaN if unknown); m = 0 if the log has no ground truth
    """

    known: Map
    true_path: Array

    @cached_property
    def rows(self) -> PathRows:
        """The path with its covariances."""
        return self.known.rows()

    @cached_property
    def quality(self) -> Quality:
        """The agreement of the scans with each other."""
        return quality(self.known)

    @property
    def path(self) -> Array:
        """(n, 4) stamp, x, y, theta."""
        return np.column_stack((self.rows.stamps, self.rows.poses))

    @property
    def odometry(self) -> Array:
        """(n, 4) stamp, x, y, theta by dead reckoning."""
        return self.known.odometry()

    @property
    def covariances(self) -> Array:
        """(n, 3, 3) covariances of the poses."""
        return self.rows.covariances

    @property
    def sigmas(self) -> Array:
        """(n, 3) standard deviations of the poses: m, m, rad."""
        return np.sqrt(np.maximum(np.diagonal(self.covariances, axis1=1, axis2=2), 0.0))
