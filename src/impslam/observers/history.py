"""Remembers the numbers of a run that plots need, and nothing else: 160 bytes a scan."""

from __future__ import annotations

from array import array
from collections.abc import Iterator

import numpy as np

from impslam.observers.base import Observer
from impslam.types import Array, StepResult, TruePose

WIDTH = 16
"""stamp, pose 3, odometry 3, covariance 6, matches, NIS, degrees of freedom of the NIS."""


class History(Observer):
    """Keeps the path, its covariance, dead reckoning, matches and innovations, and the truth."""

    def __init__(self) -> None:
        self._rows, self._true = array("d"), array("d")

    def step(self, result: StepResult) -> None:
        """Remember a scan."""
        P = result.covariance
        spread = (P[0, 0], P[0, 1], P[0, 2], P[1, 1], P[1, 2], P[2, 2])
        nis = sum(match.distance2 for match in result.matches)
        dof = sum(len(match.innovation) for match in result.matches)
        self._rows.extend((result.stamp, *result.pose, *result.odometry, *spread))
        self._rows.extend((len(result.matches), nis, dof))

    def truth(self, pose: TruePose) -> None:
        """Remember a true pose."""
        self._true.extend((pose.stamp, *pose.pose))

    @property
    def _table(self) -> Array:
        return np.array(self._rows, np.float64).reshape(-1, WIDTH)

    @property
    def path(self) -> Array:
        """(n, 4) stamp, x, y, theta."""
        return self._table[:, :4]

    @property
    def odometry(self) -> Array:
        """(n, 4) stamp, x, y, theta."""
        return self._table[:, [0, 4, 5, 6]]

    @property
    def true_path(self) -> Array:
        """(m, 4) stamp, x, y, theta (NaN if not told); m = 0 where the log has no truth."""
        return np.array(self._true, np.float64).reshape(-1, 4)

    @property
    def covariances(self) -> Array:
        """(n, 3, 3) of the poses."""
        return self._table[:, [7, 8, 9, 8, 10, 11, 9, 11, 12]].reshape(-1, 3, 3)

    @property
    def sigmas(self) -> Array:
        """(n, 3) m, m, rad: standard deviations of the poses."""
        return np.sqrt(np.maximum(self._table[:, [7, 10, 12]], 0.0))

    def results(self) -> Iterator[StepResult]:
        """Yield the poses again, as results without scans, observations and matches."""
        for row, P in zip(self._table, self.covariances, strict=True):
            pose = row[1:4]
            yield StepResult(row[0], pose, P, row[4:7], pose, None, (), (), (), ())

    @property
    def matches(self) -> Array:
        """(n, 3) matches, NIS and its degrees of freedom of each scan."""
        return self._table[:, 13:]
