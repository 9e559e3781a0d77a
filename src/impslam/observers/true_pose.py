"""The true pose in map during a run."""

from __future__ import annotations

from collections import deque

import numpy as np

from impslam.evaluation.trajectory import interpolate, is_same_pose
from impslam.geometry.se2 import compose, inverse
from impslam.types import Array, TruePose

MAX_POSES = 64
"""Number of true poses kept for the first scan: 6 s at 10 Hz, more than a scan is late."""
TIME_TOLERANCE = 0.1
"""Maximum time between a scan and the true poses, s."""


class TruthInMap:
    """Transforms true poses to map.

    A simulator or tracking system has its own frame, which is aligned so that truth and estimate agree at
    the first scan. If they agree there to 5 cm and 3 degrees without alignment, or if the truth has no
    headings, it is not transformed.
    """

    def __init__(self) -> None:
        self._poses: deque[tuple[float, Array]] = deque(maxlen=MAX_POSES)
        self._T_map_truth: Array | None = None

    def add(self, pose: TruePose) -> None:
        """Add a true pose."""
        self._poses.append((pose.stamp, pose.pose))

    def align(self, stamp: float, estimate: Array) -> None:
        """Align the frame with a pose (3,) in map, unless it is aligned or has no truth at this stamp."""
        if self._T_map_truth is not None or not self._poses:
            return
        rows = np.array([(t, *pose) for t, pose in self._poses])
        if not rows[:, 0].min() - TIME_TOLERANCE <= stamp <= rows[:, 0].max() + TIME_TOLERANCE:
            return
        true = interpolate(rows, np.array([stamp]))[0]
        same = is_same_pose(true, estimate) or not np.isfinite(true).all()
        self._T_map_truth = np.zeros(3) if same else compose(estimate, inverse(true))

    @property
    def pose(self) -> Array | None:
        """The newest true pose (3,) in map; None if there is none or its frame is not aligned yet."""
        if self._T_map_truth is None or not self._poses:
            return None
        newest = self._poses[-1][1]
        return newest if not self._T_map_truth.any() else compose(self._T_map_truth, newest)
