"""The frame of a GPS as a landmark: where east and north lie in map.

State m = [x, y, yaw] in map, perturbed by addition: the pose of the local east-north frame. A fix is the
place of the antenna in that frame,

    z = R(yaw)^T (t + R(theta) a - [x, y])    for the pose [t, theta] and the antenna at a on base_link.

So a fix corrects the pose through what earlier fixes have told of the frame, with all correlations, and
the map's origin stays where the run began. One fix does not tell the yaw: the course over ground does,
by which a vehicle that drives forward is headed.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from pydantic import FiniteFloat

from impslam.component import parameter, register
from impslam.geometry.angles import wrap
from impslam.geometry.se2 import rotation
from impslam.landmarks.base import COURSE, COURSE_SIGMA, Initial, LandmarkModel
from impslam.types import Array, Observation

UNKNOWN = math.pi / math.sqrt(3.0)  # rad: that of a course that may be any
_QUARTER = np.array([[0.0, -1.0], [1.0, 0.0]])


@register("gps")
class GpsFrame(LandmarkModel):
    """The frame in which a GPS gives its fixes."""

    dim: ClassVar[int] = 3
    dim_z: ClassVar[int] = 2
    unique: ClassVar[bool] = True
    values: ClassVar[tuple[str, ...]] = ("yaw",)

    antenna: tuple[FiniteFloat, FiniteFloat] = parameter(
        (0.0, 0.0), "m", "place [x, y] of the antenna on base_link"
    )

    def observe(self, pose: Array, m: Array) -> Array:
        """Return the place of the antenna in the frames; see `LandmarkModel.observe`."""
        antenna = self._antenna(pose)
        dx, dy = (antenna[..., None, i] - m[..., i] for i in range(2))
        c, s = np.cos(m[..., 2]), np.sin(m[..., 2])
        return np.stack([c * dx + s * dy, c * dy - s * dx], axis=-1)

    def invert(self, pose: Array, z: Array) -> Array:
        """Return frames that lie as map does."""
        place = self._antenna(pose)[..., None, :] - z
        return np.concatenate([place, np.zeros((*place.shape[:-1], 1))], axis=-1)

    def outline(self, m: Array, extents: Array) -> Array:
        """Return each origin twice."""
        del extents
        return np.repeat(m[..., None, :2], 2, axis=-2)

    def initialise(self, pose: Array, observation: Observation) -> Initial:
        """Return the frame in which the robot's heading is its course."""
        known = observation.attributes
        yaw = wrap(float(pose[2]) - known.get(COURSE, float(pose[2])))
        R = rotation(yaw)
        turned = -_QUARTER @ R @ observation.z  # of the place, as the yaw changes
        antenna = self._antenna(pose)
        swung = turned + _QUARTER @ (antenna - pose[:2])  # and as the heading does
        m_D_pose = np.column_stack([np.eye(3)[:, :2], [*swung, 1.0]])
        m_D_z = np.vstack([-R, np.zeros(2)])
        open_ = np.array([*turned, 1.0]) * known.get(COURSE_SIGMA, UNKNOWN)
        m = np.array([*(antenna - R @ observation.z), yaw])
        return Initial(m, m_D_pose, m_D_z, np.outer(open_, open_))

    def difference(self, m: Array, other: Array) -> Array:
        """Return the perturbations that take m to others, the yaw wrapped."""
        apart = other - m
        apart[..., 2] = wrap(apart[..., 2])
        return apart

    def m_D_motion(self, m: Array) -> Array:
        """Return [I, (-y, x)] over [0, 0, 1]; see `LandmarkModel.m_D_motion`."""
        out = np.zeros((len(m), 3, 3))
        out[:, [0, 1, 2], [0, 1, 2]] = 1.0
        out[:, 0, 2], out[:, 1, 2] = -m[:, 1], m[:, 0]
        return out

    def _antenna(self, pose: Array) -> Array:
        """Return the places (..., 2) of the antenna in map, for poses (..., 3)."""
        if self.antenna == (0.0, 0.0):
            return pose[..., :2]
        return np.asarray(pose[..., :2] + rotation(pose[..., 2]) @ np.array(self.antenna))
