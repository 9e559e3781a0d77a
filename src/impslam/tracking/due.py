"""Which sweeps are matched.

A sweep is matched if odometry has moved since the last match, or if its ranges have changed: odometry may
be frozen while the robot moves.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.tracking.fusion import MIN_MOTION
from impslam.tracking.matching_state import State
from impslam.tracking.reference_scan import RANGE_TOLERANCE
from impslam.types import Array, Mask

MIN_CHANGED_SHARE = 0.1
"""Share of the ranges that must change, since people change some."""


@kernel
def is_due(ranges: Array, valid: Mask, state: State) -> bool:
    """Return whether a sweep with these ranges is to be matched."""
    lidar = state.lidar
    far = math.hypot(state.motion[0], state.motion[1]) >= MIN_MOTION[0]
    if np.isnan(lidar.added[0]) or far or abs(state.motion[2]) >= MIN_MOTION[1]:
        return True
    both = changed = 0
    for i in range(len(ranges)):
        if valid[i] and lidar.ranges[i] > 0.0:
            both += 1
            changed += (
                abs(ranges[i] - lidar.ranges[i])
                > RANGE_TOLERANCE[0] + RANGE_TOLERANCE[1] * ranges[i]
            )
    return changed > MIN_CHANGED_SHARE * both
