"""Compare the motion by scans with that by odometry over some seconds, and allow for either being wrong.

A slip shows in one match, but the scans may also deviate from odometry by a little in each: people who
walk along with the robot drag the matched pose with them, and an encoder may miss a part of the motion. The
difference is summed up over `MEMORY`. If it exceeds what the noise of odometry explains, one of the two is
wrong, and no scan shows which: the pose follows the scans, and half of the difference becomes its standard
deviation.
"""

from __future__ import annotations

import math

from impslam.geometry.kernels import kernel
from impslam.tracking.match_information import add_along
from impslam.types import Array

MEMORY = 5.0
"""s over which the difference is summed up: people walk along for some seconds at least."""
GATE = 16.0
"""Squared sum over its variance that is significant: 4 sigma, by chance once in 3000 windows."""
MIN_DIFFERENCE = 0.2
"""m; smaller differences may be errors of matching, of up to 2 cm in each of some tens of matches."""
WRONG_SHARE = 0.5
"""Standard deviation of the pose as a share of the difference: scans and odometry are equally credible."""


@kernel
def add_difference(
    difference: Array, off: Array, variance: float, seconds: float, covariance: Array
) -> bool:
    """Update with a match; return whether scans and odometry disagree, and widen `covariance` if so.

    difference (4,) is the sum x, y, its variance, and whether it was significant (1 or 0). off (2,) m is
    the matched position minus that by odometry, both since the last match; that by odometry has the
    variance `variance` m^2 along each axis. `covariance` (3, 3) is that of the matched motion, in the same
    frame.
    """
    keep = math.exp(-seconds / MEMORY)
    known = keep**2 * (difference[0] ** 2 + difference[1] ** 2) if difference[3] > 0.0 else 0.0
    difference[0] = keep * difference[0] + off[0]
    difference[1] = keep * difference[1] + off[1]
    difference[2] = keep**2 * difference[2] + variance
    square = difference[0] ** 2 + difference[1] ** 2
    significant = square > max(GATE * difference[2], MIN_DIFFERENCE**2)
    difference[3] = 1.0 if significant else 0.0
    if significant and square > known:
        axis = math.atan2(difference[1], difference[0])
        add_along(covariance, axis, WRONG_SHARE**2 * (square - known))
    return bool(significant)
