"""Rejection of implausible GPS fixes."""

from __future__ import annotations

import numpy as np

from impslam.evaluation.trajectory import interpolate
from impslam.types import Array, Mask

MAX_EXCESS = 5.0
"""m by which the distance between two fixes may exceed that by odometry: three standard deviations of the
difference of two uncorrected fixes of 1.2 m each."""


def plausible(fixes: Array, odometry: Array) -> Mask:
    """Return (m,) which fixes (m, 4), sorted by time, are plausible.

    A fix is implausible if its distances to the fix before and to the fix after both exceed those by
    odometry by more than `MAX_EXCESS`. `odometry` (n, 4) is the path by dead reckoning; only its distances
    matter.
    """
    driven = interpolate(odometry, fixes[:, 0])[:, :2]
    steps = [np.hypot(*np.diff(points, axis=0).T) for points in (fixes[:, 1:3], driven)]
    far = steps[0] - steps[1] > MAX_EXCESS
    # The first and the last fix have one neighbour only, a single one has none.
    after, before = np.append(far, far[-1:]), np.append(far[:1], far)
    return np.asarray(~(after & before)) if len(far) else np.ones(len(fixes), np.bool_)
