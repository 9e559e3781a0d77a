"""The unobservable directions: rigid motions of robot and map.

A rigid motion xi = [x, y, theta] of everything about the map origin does not change observations. The
columns of G = d(state)/d(xi), in the perturbations of pose and landmarks, span these directions.
"""

from __future__ import annotations

import numpy as np

from impslam.types import Array


def pose_D_motion(pose: Array) -> Array:
    """Return the Jacobian (3, 3) of a pose by a small rigid motion about the map origin."""
    return np.array([[1.0, 0.0, -pose[1]], [0.0, 1.0, pose[0]], [0.0, 0.0, 1.0]])
