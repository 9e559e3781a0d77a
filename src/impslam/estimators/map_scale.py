"""Uncertainty of the scale of a map.

All ranges of a lidar are too long by a common factor, within the accuracy of its data sheet. Scans that are
matched with each other do not show it: the whole map and the path in it are too large by that factor. It is
not estimated, only considered (Schmidt 1966): an error s of the scale moves a point p by s (p - o), where o
is the first pose of the map. Relative to each other, poses and scans of one map are not affected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from impslam.map import Revision
from impslam.types import Array, Landmark


def with_scale(covariances: Array, poses: Array, origin: Array, sigma: float) -> Array:
    """Return the covariances (k, 3, 3) of poses (k, 3) including that of the scale.

    `origin` (2,) m is the first position of the map, and `sigma` the standard deviation of the scale.
    """
    if sigma == 0.0:
        return covariances
    out, by_scale = covariances.copy(), sigma * (poses[:, :2] - origin)
    out[:, :2, :2] += by_scale[:, :, None] * by_scale[:, None, :]
    return out


def revision_with_scale(revision: Revision, origin: Array, sigma: float) -> Revision:
    """Return a revision whose covariances include that of the scale; see `with_scale`."""
    covariances = with_scale(revision.covariances, revision.poses, origin, sigma)
    return replace(revision, covariances=covariances)


def landmark_with_scale(landmark: Landmark, origin: Array, sigma: float) -> Landmark:
    """Return a landmark with a covariance that includes that of the scale; see `with_scale`."""
    if sigma == 0.0:
        return landmark
    J = _values_D_scale(landmark, origin)
    return replace(landmark, covariance=landmark.covariance + sigma**2 * np.outer(J, J))


def joint_with_scale(
    covariance: Array, landmarks: Sequence[Landmark], origin: Array, sigma: float
) -> Array:
    """Return the joint covariance (2 k, 2 k) of landmarks including that of the scale; (0, 0) if empty."""
    if sigma == 0.0 or not covariance.size:
        return covariance
    J = np.concatenate([_values_D_scale(landmark, origin) for landmark in landmarks])
    return covariance + sigma**2 * np.outer(J, J)


def _values_D_scale(landmark: Landmark, origin: Array) -> Array:
    """Return the derivative (2,) of a landmark: of r of a line, and of both coordinates of a point."""
    if not landmark.is_line:
        return landmark.position - origin
    r, alpha = landmark.parameters["r"], landmark.parameters["alpha"]
    return np.array([r - np.cos(alpha) * origin[0] - np.sin(alpha) * origin[1], 0.0])
