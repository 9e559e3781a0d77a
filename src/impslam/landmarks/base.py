"""The role of a landmark model: local blocks only; the filter alone knows where they go.

Shapes: k landmarks of the kind at once, `dim` the size of one landmark's state, `dim_z` that of an
observation. The pose is `T_map_base` [x, y, theta], perturbed by addition. A landmark's state m is
perturbed by its own `retract`; every `m_D_...` and `..._D_m` is taken in that perturbation.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from impslam.component import Component
from impslam.types import Array, Mask, Observation


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """z (k, dim_z) and its Jacobians z_D_pose (k, dim_z, 3), z_D_m (k, dim_z, dim)."""

    z: Array
    z_D_pose: Array
    z_D_m: Array


@dataclass(frozen=True, slots=True, eq=False)
class Initial:
    """A new landmark: m (dim,), m_D_pose (dim, 3), m_D_z (dim, dim_z) and `slack` (dim, dim).

    `slack` is the covariance of the directions that the observation leaves open (the place of a
    wall's frame along the wall); zero for landmarks that one observation fixes.
    """

    m: Array
    m_D_pose: Array
    m_D_z: Array
    slack: Array


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """A landmark in the form users read, and the Jacobian of `values` by m's perturbation."""

    position: Array
    values: dict[str, float]
    values_D_m: Array


class LandmarkModel(Component):
    """Measurement model, inverse model and reported form of one kind of landmark."""

    role: ClassVar[str] = "landmark"
    dim: ClassVar[int]
    dim_z: ClassVar[int]

    @abstractmethod
    def predict(self, pose: Array, m: Array) -> Prediction:
        """Return how landmarks m (k, dim) would be observed from a pose (3,)."""

    @abstractmethod
    def residual(self, z: Array, predicted: Array) -> Array:
        """Return observed minus predicted, angles wrapped; broadcasts over leading axes."""

    @abstractmethod
    def initialise(self, pose: Array, observation: Observation) -> Initial:
        """Return the landmark that would be observed like this from a pose (3,)."""

    @abstractmethod
    def retract(self, m: Array, delta: Array) -> Array:
        """Return landmarks m (k, dim) moved by perturbations delta (k, dim)."""

    @abstractmethod
    def report(self, m: Array) -> Report:
        """Return one landmark (dim,) in the form users read."""

    def distance(self, pose: Array, m: Array, observation: Observation) -> tuple[Array, Array]:
        """Return (k,) metres and (k,) rad between landmarks and an observation, in map.

        This is what the thesis associates by (4.1.4, 5.2.2): points by their distance, with angle
        0; walls by the distance of the feet of their normals and the angle of intersection.
        """
        raise NotImplementedError

    def extent(self, m: Array, pose: Array, observation: Observation) -> Array:
        """Return (2,) where along landmark m (dim,) the observation begins and ends, m.

        Points have no extent: (0, 0).
        """
        del m, pose, observation
        import numpy as np

        return np.zeros(2)

    def compatible(self, gap: Array) -> Mask:
        """Tell which landmarks (k,) an observation may belong to, by the gap between extents, m."""
        return gap <= 0.0

    def outline(self, m: Array, extent: Array) -> Array:
        """Return (p, 2) points in map along the landmark's visible extent."""
        raise NotImplementedError
