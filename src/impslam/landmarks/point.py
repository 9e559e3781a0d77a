"""Points: cylinders by their centre, corners by their vertex (thesis 4.1).

State m = [x, y] in map, perturbed by addition. Measured as z = [x, y] in base_link,

    z = R(theta)^T (m - t)    for the pose [t, theta].

This is thesis Eq. 4.2 in Cartesian instead of polar form: it holds the same information (an
extractor rotates its polar covariance into R), has no singularity at range 0 and no angle to wrap,
and is linear in everything but the heading. The Jacobians correct Eq. 4.4-4.8.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from impslam.component import register
from impslam.geometry.kernels import kernel
from impslam.geometry.se2 import rotation, transform
from impslam.landmarks.base import Initial, LandmarkModel, Prediction, Report
from impslam.types import Array, Observation


@kernel
def _predict(pose: Array, m: Array) -> tuple[Array, Array, Array]:
    """Return z (k, 2), z_D_pose (k, 2, 3) and z_D_m (k, 2, 2)."""
    n = len(m)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    z, z_D_pose, z_D_m = np.empty((n, 2)), np.empty((n, 2, 3)), np.empty((n, 2, 2))
    for k in range(n):
        dx, dy = m[k, 0] - pose[0], m[k, 1] - pose[1]
        x, y = c * dx + s * dy, c * dy - s * dx
        z[k, 0], z[k, 1] = x, y
        z_D_m[k, 0, 0], z_D_m[k, 0, 1], z_D_m[k, 1, 0], z_D_m[k, 1, 1] = c, s, -s, c
        z_D_pose[k, 0, 0], z_D_pose[k, 0, 1], z_D_pose[k, 0, 2] = -c, -s, y
        z_D_pose[k, 1, 0], z_D_pose[k, 1, 1], z_D_pose[k, 1, 2] = s, -c, -x
    return z, z_D_pose, z_D_m


@register("point")
class Point(LandmarkModel):
    """A point in the plane of the lidar."""

    dim: ClassVar[int] = 2
    dim_z: ClassVar[int] = 2
    is_place: ClassVar[bool] = True

    def predict(self, pose: Array, m: Array) -> Prediction:
        """Return the points in base_link; see `LandmarkModel.predict`."""
        return Prediction(*_predict(pose, m))

    def residual(self, z: Array, predicted: Array) -> Array:
        """Return observed minus predicted."""
        return z - predicted

    def initialise(self, pose: Array, observation: Observation) -> Initial:
        """Return the point in map (thesis Eq. 4.1)."""
        m = transform(pose, observation.z)
        m_D_pose = np.array([[1.0, 0.0, pose[1] - m[1]], [0.0, 1.0, m[0] - pose[0]]])
        return Initial(m, m_D_pose, rotation(pose[2]), np.zeros((2, 2)))

    def z_D_motion(self, z: Array) -> Array:
        """Return how a point seen at z moves as base_link does."""
        return np.array([[-1.0, 0.0, z[1]], [0.0, -1.0, -z[0]]])

    def retract(self, m: Array, delta: Array) -> Array:
        """Return m + delta."""
        return m + delta

    def m_D_motion(self, m: Array) -> Array:
        """Return [I, (-y, x)]; see `LandmarkModel.m_D_motion`."""
        out = np.zeros((len(m), self.dim, 3))  # whatever a kind adds to the place stays as it is
        out[:, 0, 0] = out[:, 1, 1] = 1.0
        out[:, 0, 2], out[:, 1, 2] = -m[:, 1], m[:, 0]
        return out

    def report(self, m: Array) -> Report:
        """Return the point itself."""
        return Report(m.copy(), {}, np.eye(2))

    def distance(self, pose: Array, m: Array, observation: Observation) -> tuple[Array, Array]:
        """Return the Euclidean distances in map (thesis 4.1.4)."""
        apart = m - transform(pose, observation.z)
        return np.hypot(apart[:, 0], apart[:, 1]), np.zeros(len(m))

    def outlines(self, m: Array, extents: Array) -> Array:
        """Return each point twice."""
        del extents
        return np.stack([m, m], axis=1)


@register("cylinder")
class Cylinder(Point):
    """An upright cylinder, by its axis."""


@register("corner")
class Corner(Point):
    """Where two walls meet."""
