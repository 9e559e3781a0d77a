"""Points: cylinders by their centre, corners by their vertex (thesis 4.1).

State m = [x, y] in map, perturbed by addition. Measured as z = [x, y] in base_link,

    z = R(theta)^T (m - t)    for the pose [t, theta].

This is thesis Eq. 4.2 in Cartesian instead of polar form: it contains the same information (an
extractor rotates its polar covariance into R), has no singularity at range 0 and no angle to wrap,
and is linear in everything but the heading. The Jacobians correct Eq. 4.4-4.8.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from impslam.component import register
from impslam.geometry.kernels import kernel
from impslam.geometry.se2 import inverse, rotation, transform
from impslam.landmarks.base import Initial, LandmarkModel, Prediction
from impslam.landmarks.batch import batched
from impslam.types import Array, Observation


@kernel
def _predict(poses: Array, m: Array) -> tuple[Array, Array, Array]:
    """Return z (b, k, 2), z_D_pose (b, k, 2, 3) and z_D_m (b, k, 2, 2)."""
    b, n, _ = m.shape
    z, z_D_pose, z_D_m = np.empty((b, n, 2)), np.empty((b, n, 2, 3)), np.empty((b, n, 2, 2))
    for i in range(b):
        c, s = math.cos(poses[i, 2]), math.sin(poses[i, 2])
        for k in range(n):
            dx, dy = m[i, k, 0] - poses[i, 0], m[i, k, 1] - poses[i, 1]
            x, y = c * dx + s * dy, c * dy - s * dx
            z[i, k, 0], z[i, k, 1] = x, y
            by_m, by_pose = z_D_m[i, k], z_D_pose[i, k]
            by_m[0, 0], by_m[0, 1], by_m[1, 0], by_m[1, 1] = c, s, -s, c
            by_pose[0, 0], by_pose[0, 1], by_pose[0, 2] = -c, -s, y
            by_pose[1, 0], by_pose[1, 1], by_pose[1, 2] = s, -c, -x
    return z, z_D_pose, z_D_m


@register("point")
class Point(LandmarkModel):
    """A point in the plane of the lidar."""

    dim: ClassVar[int] = 2
    dim_z: ClassVar[int] = 2

    def observe(self, pose: Array, m: Array) -> Array:
        """Return the points in base_link; see `LandmarkModel.observe`."""
        return transform(inverse(pose), m)

    def invert(self, pose: Array, z: Array) -> Array:
        """Return the points in map (thesis Eq. 4.1)."""
        return transform(pose, z)

    def outline(self, m: Array, extents: Array) -> Array:
        """Return each point twice."""
        del extents
        return np.repeat(m[..., None, :], 2, axis=-2)

    def predict(self, pose: Array, m: Array) -> Prediction:
        """Return `observe` with its Jacobians in closed form."""
        return batched(_predict, pose, m)

    def initialise(self, pose: Array, observation: Observation) -> Initial:
        """Return the point in map and its Jacobians in closed form."""
        m = transform(pose, observation.z)
        m_D_pose = np.array([[1.0, 0.0, pose[1] - m[1]], [0.0, 1.0, m[0] - pose[0]]])
        return Initial(m, m_D_pose, rotation(float(pose[2])), np.zeros((2, 2)))

    def m_D_motion(self, m: Array) -> Array:
        """Return [I, (-y, x)]; see `LandmarkModel.m_D_motion`."""
        out = np.zeros((len(m), 2, 3))
        out[:, 0, 0] = out[:, 1, 1] = 1.0
        out[:, 0, 2], out[:, 1, 2] = -m[:, 1], m[:, 0]
        return out

    def carry(self, m: Array, delta: Array) -> tuple[Array, Array]:
        """Return the points moved, and the change of (-y, x); see `LandmarkModel.carry`."""
        change = np.zeros((len(m), 2, 3))
        change[:, 0, 2], change[:, 1, 2] = -delta[:, 1], delta[:, 0]
        return m + delta, change


@register("cylinder")
class Cylinder(Point):
    """An upright cylinder, by its axis."""


@register("corner")
class Corner(Point):
    """A corner of two walls."""
