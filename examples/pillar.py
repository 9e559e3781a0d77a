"""A kind of landmark in one file: pillars, whose radius the filter estimates with their place.

The state is m = [x, y, radius] in map and the measurement z = [x, y, radius] in base_link: a point,
z = [R(theta)^T (p - t), radius] for the pose [t, theta], with a row more. A kind says how it is seen, the
inverse of that, and its outline; Jacobians are taken by differences. `PillarExtractor` turns what
the shipped circle fit finds into observations of the new kind.
"""

import numpy as np

from impslam.component import register
from impslam.extractors.circle import Circle
from impslam.geometry.se2 import inverse, transform
from impslam.landmarks.base import LandmarkModel
from impslam.types import Array, Observation, Scan

RADIUS_SIGMA = 0.02  # m, of a circle fitted to a third of its outline; taken as independent of x, y


@register("pillar")
class Pillar(LandmarkModel):
    """A pillar by its axis and its radius."""

    dim = dim_z = 3
    values = ("radius",)

    def observe(self, pose: Array, m: Array) -> Array:
        return np.concatenate([transform(inverse(pose), m[..., :2]), m[..., 2:]], axis=-1)

    def invert(self, pose: Array, z: Array) -> Array:
        return np.concatenate([transform(pose, z[..., :2]), z[..., 2:]], axis=-1)

    def outline(self, m: Array, extents: Array) -> Array:
        return np.stack([m[..., :2], m[..., :2]], axis=-2)


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
