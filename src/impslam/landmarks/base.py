"""The role of a landmark model: local blocks only; the filter alone knows where they go.

Shapes: k landmarks of the kind at once, `dim` the size of one landmark's state, `dim_z` that of an
observation, a observations. The pose is `T_map_base` [x, y, theta], perturbed by addition. A
landmark's state m is perturbed by its own `retract`; every `m_D_...` and `..._D_m` is taken in that
perturbation.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from impslam.component import Component
from impslam.types import Array, Observation


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
class Overlap:
    """How far a observations and k landmarks lie apart along the landmarks.

    `gap` (a, k) m is negative where they overlap; `gap_D_pose` (k, 3) and `gap_D_m` (k, dim) are the
    Jacobians of the place along the landmark; `allowed` is the gap that still makes one landmark, m.
    """

    gap: Array
    gap_D_pose: Array
    gap_D_m: Array
    allowed: float


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """A landmark in the form users read, and the Jacobian (2, dim) of its two estimated values."""

    position: Array
    values: dict[str, float]
    values_D_m: Array


class LandmarkModel(Component):
    """Measurement model, inverse model and reported form of one kind of landmark."""

    role: ClassVar[str] = "landmark"
    dim: ClassVar[int]
    dim_z: ClassVar[int]
    is_place: ClassVar[bool] = False
    """m begins with a place [x, y] in map: it swings on an arc as a heading errs."""

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
    def z_D_motion(self, z: Array) -> Array:
        """Return (dim_z, 3): how an observation changes as base_link moves by [dx, dy, dtheta]."""

    @abstractmethod
    def retract(self, m: Array, delta: Array) -> Array:
        """Return landmarks m (k, dim) moved by perturbations delta (k, dim)."""

    @abstractmethod
    def m_D_motion(self, m: Array) -> Array:
        """Return how landmarks m (k, dim) change as the whole map moves rigidly by a little.

        (k, dim, 3), by a motion [x, y, theta] about the map origin. No observation tells anything of
        such a motion of map and robot together; filters that care for consistency need to know it.
        """

    @abstractmethod
    def report(self, m: Array) -> Report:
        """Return one landmark (dim,) in the form users read."""

    @abstractmethod
    def distance(self, pose: Array, m: Array, observation: Observation) -> tuple[Array, Array]:
        """Return (k,) metres and (k,) rad between landmarks and an observation, in map.

        This is what the thesis associates by (4.1.4, 5.2.2): points by their distance, with angle
        0; walls by the distance of the feet of their normals and the angle of intersection.
        """

    def extents(self, pose: Array, m: Array, observations: list[Observation]) -> Array:
        """Return (a, k, 2), where along each landmark each observation begins and ends, m.

        The default is that of a point: no extent.
        """
        del pose
        return np.zeros((len(observations), len(m), 2))

    def overlap(self, pose: Array, m: Array, extents: Array, seen: Array) -> Overlap | None:
        """Return how landmarks of known `extents` (k, 2) overlap what is `seen` (a, k, 2).

        None for kinds without extent.
        """
        del pose, m, extents, seen
        return None

    @abstractmethod
    def outlines(self, m: Array, extents: Array) -> Array:
        """Return (k, 2, 2): the landmarks' visible ends in map; twice the place of a point."""
