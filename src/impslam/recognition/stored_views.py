"""Views of the scans that are stored in a map: end points of valid beams, in beam order."""

from __future__ import annotations

import numpy as np

from impslam.geometry.angles import wrap
from impslam.map import Keyframes
from impslam.recognition.free_ranges import Floats, free_ranges
from impslam.recognition.submap import FEATURE_SPACING, View
from impslam.surfaces.features import Sampling, find_features
from impslam.types import Array


def stored_views(keyframes: Keyframes) -> list[View]:
    """Return the view of each keyframe of a map."""
    starts = keyframes.starts
    return [
        points_view(keyframes.points[starts[i] : starts[i + 1]], keyframes.origins[i])
        for i in range(len(keyframes))
    ]


def points_view(points: Array | Floats, laser: Array) -> View:
    """Return the view of a scan with end points (n, 2) m; they and laser (2,) m are in base_link.

    The points are those of valid beams, in beam order.
    """
    ends = np.asarray(points, np.float64).reshape(-1, 2)
    n, offsets = len(ends), ends - laser
    ranges, bearings = np.hypot(*offsets.T), np.arctan2(offsets[:, 1], offsets[:, 0])
    steps = np.abs(wrap(np.asarray(np.diff(bearings))))
    spacing = float(np.median(steps)) if n > 1 else 0.0
    rows = np.empty((n, 5), np.float32)
    origins, valid = np.broadcast_to(laser, (n, 2)).copy(), ranges > 0.0
    sampling = Sampling(spacing, FEATURE_SPACING, smooth=False)
    count = find_features(ends, valid, ranges, origins, sampling, rows)
    return View(rows[:count].copy(), np.array(laser, float), free_ranges(ends, laser, spacing))
