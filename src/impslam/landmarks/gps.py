"""The frame of a GPS as a landmark: the east-north frame in map.

State m = [x, y, yaw] in map, perturbed by addition: the pose of the local east-north frame. A fix is the
position of the antenna in that frame,

    z = R(yaw)^T (t + R(theta) a - [x, y])    for the pose [t, theta] and the antenna at a on base_link.

So a fix corrects the pose through the frame estimated from earlier fixes, with all correlations, and
the map's origin stays at the start of the run. One fix does not determine the yaw; the course over ground
does, since it is the heading of a vehicle that drives forward.
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

UNKNOWN_COURSE_SIGMA = math.pi / math.sqrt(3.0)  # rad, of a uniform course
_QUARTER_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])


@register("gps")
class GpsFrame(LandmarkModel):
    """The frame in which a GPS gives its fixes."""

    dim: ClassVar[int] = 3
    dim_z: ClassVar[int] = 2
    unique: ClassVar[bool] = True
    values: ClassVar[tuple[str, ...]] = ("yaw",)

    antenna: tuple[FiniteFloat, FiniteFloat] = parameter(
        (0.0, 0.0), "m", "position [x, y] of the antenna in base_link"
    )

    def observe(self, pose: Array, m: Array) -> Array:
        """Return the position of the antenna in the frames; see `LandmarkModel.observe`."""
        antenna = self._antenna(pose)
        dx, dy = (antenna[..., None, i] - m[..., i] for i in range(2))
        c, s = np.cos(m[..., 2]), np.sin(m[..., 2])
        return np.stack([c * dx + s * dy, c * dy - s * dx], axis=-1)

    def invert(self, pose: Array, z: Array) -> Array:
        """Return frames with the orientation of map."""
        position = self._antenna(pose)[..., None, :] - z
        return np.concatenate([position, np.zeros((*position.shape[:-1], 1))], axis=-1)

    def outline(self, m: Array, extents: Array) -> Array:
        """Return each origin twice."""
        del extents
        return np.repeat(m[..., None, :2], 2, axis=-2)

    def initialise(self, pose: Array, observation: Observation) -> Initial:
        """Return the frame for which the robot's heading equals its course."""
        attributes = observation.attributes
        yaw = wrap(float(pose[2]) - attributes.get(COURSE, float(pose[2])))
        R = rotation(yaw)
        by_yaw = -_QUARTER_TURN @ R @ observation.z  # of the position, by the yaw
        antenna = self._antenna(pose)
        by_heading = by_yaw + _QUARTER_TURN @ (antenna - pose[:2])  # by the heading
        m_D_pose = np.column_stack([np.eye(3)[:, :2], [*by_heading, 1.0]])
        m_D_z = np.vstack([-R, np.zeros(2)])
        unobserved = np.array([*by_yaw, 1.0]) * attributes.get(COURSE_SIGMA, UNKNOWN_COURSE_SIGMA)
        m = np.array([*(antenna - R @ observation.z), yaw])
        return Initial(m, m_D_pose, m_D_z, np.outer(unobserved, unobserved))

    def retract(self, m: Array, delta: Array) -> Array:
        """Return frames moved by perturbations, the yaw wrapped."""
        moved = m + delta
        moved[..., 2] = wrap(moved[..., 2])
        return moved

    def difference(self, m: Array, other: Array) -> Array:
        """Return the perturbations that take m to others, the yaw wrapped."""
        difference = other - m
        difference[..., 2] = wrap(difference[..., 2])
        return difference

    def m_D_motion(self, m: Array) -> Array:
        """Return [I, (-y, x)] over [0, 0, 1]; see `LandmarkModel.m_D_motion`."""
        out = np.zeros((len(m), 3, 3))
        out[:, [0, 1, 2], [0, 1, 2]] = 1.0
        out[:, 0, 2], out[:, 1, 2] = -m[:, 1], m[:, 0]
        return out

    def _antenna(self, pose: Array) -> Array:
        """Return the positions (..., 2) of the antenna in map, for poses (..., 3)."""
        if self.antenna == (0.0, 0.0):
            return pose[..., :2]
        return np.asarray(pose[..., :2] + rotation(pose[..., 2]) @ np.array(self.antenna))
