"""The true pose beside the estimate while a run goes on."""

from __future__ import annotations

from collections import deque

import numpy as np

from impslam.evaluation.trajectory import interpolate, is_same_pose
from impslam.geometry.se2 import compose, inverse
from impslam.types import Array, TruePose

KEPT = 64
"""True poses that are kept for the first scan: 6 s at 10 Hz, more than a scan is late."""
SLACK = 0.1
"""s that a scan may lie before or after the true poses."""


class TruthInMap:
    """Moves true poses into map.

    A simulator or a tracking system has a frame of its own. It is laid so that truth and estimate agree
    at the first scan; if they agree there to 5 cm and 3 degrees as they are, it is taken to be map. A
    truth without headings is not moved.
    """

    def __init__(self) -> None:
        self._poses: deque[tuple[float, Array]] = deque(maxlen=KEPT)
        self._T_map_truth: Array | None = None

    def add(self, pose: TruePose) -> None:
        """Take the next true pose."""
        self._poses.append((pose.stamp, pose.pose))

    def align(self, stamp: float, estimate: Array) -> None:
        """Fix the frame by a pose (3,) in map, unless it is fixed or no truth is known at its stamp."""
        if self._T_map_truth is not None or not self._poses:
            return
        rows = np.array([(t, *pose) for t, pose in self._poses])
        if not rows[:, 0].min() - SLACK <= stamp <= rows[:, 0].max() + SLACK:
            return
        true = interpolate(rows, np.array([stamp]))[0]
        same = is_same_pose(true, estimate) or not np.isfinite(true).all()
        self._T_map_truth = np.zeros(3) if same else compose(estimate, inverse(true))

    @property
    def pose(self) -> Array | None:
        """(3,) the newest true pose in map, None while there is none or its frame is not fixed."""
        if self._T_map_truth is None or not self._poses:
            return None
        newest = self._poses[-1][1]
        return newest if not self._T_map_truth.any() else compose(self._T_map_truth, newest)
