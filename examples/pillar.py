"""A kind of landmark in one file: pillars, whose radius the filter estimates with their place.

The state is m = [x, y, radius] in map and the measurement z = [x, y, radius] in base_link: a point,
z = [R(theta)^T (p - t), radius] for the pose [t, theta], with a row more. `PillarExtractor` turns what
the shipped circle fit finds into observations of the new kind.
"""

import numpy as np

from impslam.component import register
from impslam.extractors.circle import Circle
from impslam.geometry.se2 import rotation, transform
from impslam.landmarks.base import Initial, Prediction, Report
from impslam.landmarks.point import Point
from impslam.types import Array, Observation, Scan

RADIUS_SIGMA = 0.02  # m, of a circle fitted to a third of its outline; taken as independent of x, y
A_ROW = ((0, 0), (0, 1), (0, 0))  # of zeros: the radius depends on no motion


@register("pillar")
class Pillar(Point):
    """A pillar by its axis and its radius."""

    dim = dim_z = 3

    def predict(self, pose: Array, m: Array) -> Prediction:
        axis = super().predict(pose, m[:, :2])
        z_D_m = np.pad(axis.z_D_m, ((0, 0), (0, 1), (0, 1)))
        z_D_m[:, 2, 2] = 1.0
        return Prediction(np.column_stack([axis.z, m[:, 2]]), np.pad(axis.z_D_pose, A_ROW), z_D_m)

    def initialise(self, pose: Array, observation: Observation) -> Initial:
        m = np.append(transform(pose, observation.z[:2]), observation.z[2])
        m_D_z = np.eye(3)
        m_D_z[:2, :2] = rotation(pose[2])
        return Initial(m, self.m_D_motion((m - [*pose[:2], 0.0])[None])[0], m_D_z, np.zeros((3, 3)))

    def z_D_motion(self, z: Array) -> Array:
        return np.pad(super().z_D_motion(z), A_ROW[1:])

    def report(self, m: Array) -> Report:
        return Report(m[:2].copy(), {"radius": float(m[2])}, np.eye(2, 3))

    def distance(self, pose: Array, m: Array, observation: Observation) -> tuple[Array, Array]:
        apart = m[:, :2] - transform(pose, observation.z[:2])
        return np.hypot(apart[:, 0], apart[:, 1]), np.zeros(len(m))

    def outlines(self, m: Array, extents: Array) -> Array:
        return super().outlines(m[:, :2], extents)


@register("pillar")
class PillarExtractor(Circle):
    """Circles of unknown radius, seen as pillars."""

    landmark = "pillar"

    def extract(self, scan: Scan, rng: np.random.Generator) -> list[Observation]:
        found = []
        for circle in super().extract(scan, rng):
            z, R = np.append(circle.z, circle.attributes["radius"]), np.zeros((3, 3))
            R[:2, :2], R[2, 2] = circle.R, RADIUS_SIGMA**2
            found.append(Observation("pillar", z, R, circle.beams))
        return found
