"""Relocalisation from several scans of a short drive.

The scans, joined by the motions between them, are one query. It is searched for again with each scan.
Earlier hypotheses are also moved along and evaluated again, in case the new search misses them. Each
hypothesis has to explain all scans of the drive.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import plain
from impslam.geometry.se2 import compose, compose_uncertain, inverse
from impslam.recognition.relocalisation import Answer, Near, Relocaliser, query
from impslam.recognition.submap import View
from impslam.types import Array

SPACING, TURN_SPACING = 0.4, 0.35  # m, rad between scans; closer ones see the same
MAX_SCANS = 8  # over 3 m
MAX_SIGMA, MAX_TURN_SIGMA = 0.3, 0.05
"""m and rad, of the motion from the oldest scan: alignment pairs points up to 0.3 m apart, and the turn
moves a point 6 m away by as much."""
MIN_PROBABILITY = 1e-4  # of a hypothesis that is followed


class _Step(NamedTuple):
    """A view and the motion (3,) to it from the previous one, with its covariance (3, 3)."""

    view: View
    motion: Array
    covariance: Array


class DriveRelocaliser:
    """Locates a moving robot in a map, from the scans of its last few metres."""

    def __init__(self, relocaliser: Relocaliser) -> None:
        self._relocaliser = relocaliser
        self._steps: list[_Step] = []
        self._hypotheses: list[Array] = []

    def add(self, view: View, motion: Array, covariance: Array, near: Near | None = None) -> Answer:
        """Add a scan, and locate the robot; see `remember` and `find`."""
        self.remember(view, motion, covariance)
        return self.find(near)

    def remember(self, view: View, motion: Array, covariance: Array) -> None:
        """Add a scan without a search, which is much faster.

        Parameters
        ----------
        view : the view of the scan
        motion, covariance : (3,) of base_link since the previous scan, and (3, 3) of its additive error;
            ignored for the first scan
        """
        self._hypotheses = [compose(pose, motion) for pose in self._hypotheses]
        self._append(_Step(view, plain(motion), plain(covariance)))
        self._forget()

    def find(self, near: Near | None = None) -> Answer:
        """Locate the robot at the newest scan; `near` is a hint."""
        scans = query([step.view for step in self._steps], self._poses())
        answer = self._relocaliser.find_query(scans, near, self._hypotheses)
        self._hypotheses = [h.pose for h in answer.hypotheses if h.probability >= MIN_PROBABILITY]
        return answer

    def _append(self, step: _Step) -> None:
        """Append a step; replace the last one if the robot had hardly moved up to it."""
        if len(self._steps) > 1:
            last = self._steps[-1]
            if math.hypot(*last.motion[:2]) < SPACING and abs(last.motion[2]) < TURN_SPACING:
                self._steps.pop()
                motion, covariance = compose_uncertain(
                    last.motion, last.covariance, step.motion, step.covariance
                )
                step = _Step(step.view, motion, covariance)
        self._steps.append(step)

    def _forget(self) -> None:
        """Remove the views whose motion to the newest one is too uncertain, and surplus ones."""
        T, P = np.zeros(3), np.zeros((3, 3))
        for k in range(len(self._steps) - 1, 0, -1):
            T, P = compose_uncertain(self._steps[k].motion, self._steps[k].covariance, T, P)
            is_uncertain = math.sqrt(P[0, 0] + P[1, 1]) > MAX_SIGMA
            is_uncertain |= math.sqrt(P[2, 2]) > MAX_TURN_SIGMA
            if is_uncertain or len(self._steps) - k >= MAX_SCANS:
                del self._steps[:k]
                return

    def _poses(self) -> Array:
        """Return the poses (k, 3) of the views relative to the newest one."""
        poses = np.zeros((len(self._steps), 3))
        for k in range(len(poses) - 1, 0, -1):
            poses[k - 1] = compose(poses[k], inverse(self._steps[k].motion))
        return poses
