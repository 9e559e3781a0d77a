"""GPS fixes that cannot be true."""

from __future__ import annotations

import numpy as np

from impslam.evaluation.trajectory import interpolate
from impslam.types import Array, Mask

JUMP = 5.0
"""m that the way to another fix may exceed that of the wheels: three standard deviations of the difference
of two fixes without corrections, each 1.2 m."""


def plausible(fixes: Array, odometry: Array) -> Mask:
    """Return which fixes (m, 4), in the order of time, are where the robot may have been, (m,).

    One is not if it is farther from the fix before and from the one after than wheels tell, by more than
    `JUMP`. `odometry` (n, 4) is the path by dead reckoning, of which only distances count.
    """
    driven = interpolate(odometry, fixes[:, 0])[:, :2]
    ways = [np.hypot(*np.diff(places, axis=0).T) for places in (fixes[:, 1:3], driven)]
    far = ways[0] - ways[1] > JUMP
    # At either end there is one neighbour to tell.
    return np.asarray(~(np.append(far, far[-1:]) & np.append(far[:1], far)))
