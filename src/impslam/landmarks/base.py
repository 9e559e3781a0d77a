"""The interface of landmark models: the measurement model of one kind of landmark, and its inverse.

A kind needs three methods: `observe`, its inverse `invert`, and `outline`. All other methods have defaults
based on them; a kind may override these (Jacobians in closed form, for example).
Models return local blocks; the filter manages their position in the state.

Shapes: poses are `T_map_base` (..., 3), perturbed by addition. k landmarks of the kind at once,
m (..., k, dim), are perturbed by `retract`; every `m_D_...` and `..._D_m` is taken in that
perturbation. Observations are z (..., k, dim_z) in base_link. Leading axes broadcast.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Self

import numpy as np

from impslam.component import Component
from impslam.geometry.angles import wrap
from impslam.types import Array, Observation

COURSE, COURSE_SIGMA = "course", "course sigma"
"""Attributes of a GPS fix: direction of travel in its frame and its standard deviation, rad."""

OF_THE_ROBOT = frozenset({"heading", COURSE, COURSE_SIGMA})
"""Attributes of an observation that its landmark does not have: they change as the robot turns."""

STEP = 1e-5  # m, rad: of central differences; their error is then some 1e-10 of the values


class Prediction(NamedTuple):
    """z (..., k, dim_z) and its Jacobians z_D_pose (..., k, dim_z, 3), z_D_m (..., k, dim_z, dim)."""

    z: Array
    z_D_pose: Array
    z_D_m: Array


def average(means: dict[str, float], attributes: Mapping[str, float], share: float) -> None:
    """Move the mean attributes of a landmark a share of the way to others, and add those it lacks.

    Attributes that depend on the robot's heading, such as a corner's "heading" in base_link, are left out.
    """
    for name, value in attributes.items():
        if name not in OF_THE_ROBOT:
            old = means.get(name, value)
            means[name] = old + share * (value - old)


@dataclass(frozen=True, slots=True, eq=False)
class Initial:
    """A new landmark: m (dim,), m_D_pose (dim, 3), m_D_z (dim, dim_z) and `slack` (dim, dim).

    `slack` is the covariance of the directions that the observation does not determine (the position of
    a wall's frame along the wall); zero for landmarks that one observation determines.
    """

    m: Array
    m_D_pose: Array
    m_D_z: Array
    slack: Array


@dataclass(frozen=True, slots=True, eq=False)
class Overlap:
    """Gaps between p landmarks and their observed pieces, along the landmarks.

    `gap` (p,) m is negative for an overlap; `gap_D_pose` (p, 3) and `gap_D_m` (p, dim) are the
    Jacobians of the position along the landmark; `allowed` is the largest gap within one landmark, m.
    """

    gap: Array
    gap_D_pose: Array
    gap_D_m: Array
    allowed: float


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """A landmark in the form shown to users, and the Jacobian (2, dim) of its two estimated values."""

    position: Array
    values: dict[str, float]
    values_D_m: Array


class LandmarkModel(Component):
    """Measurement model, inverse model and outline of one kind of landmark."""

    role: ClassVar[str] = "landmark"
    dim: ClassVar[int]
    dim_z: ClassVar[int]
    z_angles: ClassVar[tuple[int, ...]] = ()
    """Which components of z are angles."""
    is_place: ClassVar[bool] = True
    """Whether m begins with a position [x, y] in map, perturbed by addition."""
    unique: ClassVar[bool] = False
    """Whether only one exists: it is added at once, and observations that do not fit it are outliers."""
    has_extent: ClassVar[bool] = False
    """Whether it is observed in pieces that must overlap to match; see `extents` and `overlap`."""
    values: ClassVar[tuple[str, ...]] = ()
    """Names of the entries of m after the position, for reports."""

    def __deepcopy__(self, memo: dict[int, object] | None = None) -> Self:
        """Return itself: a model holds only parameters, which do not change."""
        del memo
        return self

    @abstractmethod
    def observe(self, pose: Array, m: Array) -> Array:
        """Return the observations z (..., k, dim_z) of landmarks m (..., k, dim) from poses (..., 3)."""

    @abstractmethod
    def invert(self, pose: Array, z: Array) -> Array:
        """Return the landmarks (..., k, dim) that are observed as z (..., k, dim_z) from poses (..., 3)."""

    @abstractmethod
    def outline(self, m: Array, extents: Array) -> Array:
        """Return the landmarks' visible ends in map, (..., k, 2, 2); for a point twice its position.

        `extents` (..., k, 2), m, are the observed extents along each landmark.
        """

    def predict(self, pose: Array, m: Array) -> Prediction:
        """Return `observe` with its Jacobians; by default central differences, all in one call."""
        n = 3 + self.dim
        steps = np.concatenate([np.zeros((1, n)), STEP * np.eye(n), -STEP * np.eye(n)])
        lead = np.broadcast_shapes(pose.shape[:-1], m.shape[:-2])
        ones = (1,) * len(lead)
        poses = np.broadcast_to(pose, (*lead, 3)) + steps[:, :3].reshape(-1, *ones, 3)
        moved = np.broadcast_to(m, (len(steps), *lead, *m.shape[-2:]))
        deltas = np.broadcast_to(steps[:, 3:].reshape(-1, *ones, 1, self.dim), moved.shape)
        z = self.observe(poses, self.retract(moved, deltas))
        slopes = self.residual(z[1 : n + 1], z[n + 1 :]) / (2.0 * STEP)
        D = np.moveaxis(slopes, 0, -1)
        return Prediction(z[0], D[..., :3], D[..., 3:])

    def residual(self, z: Array, predicted: Array) -> Array:
        """Return observed minus predicted, angles wrapped; broadcasts over leading axes."""
        difference = z - predicted
        for i in self.z_angles:
            difference[..., i] = wrap(difference[..., i])
        return difference

    def initialise(self, pose: Array, observation: Observation) -> Initial:
        """Return the landmark that gives this observation from a pose (3,).

        With z = h(pose, m) and h's Jacobian by m square, dm = z_D_m^-1 (dz - z_D_pose dpose). A kind
        that one observation does not determine (dim > dim_z) overrides this with its `slack`.
        """
        m = self.invert(pose, observation.z[None])
        prediction = self.predict(pose, m)
        m_D_z = np.linalg.inv(prediction.z_D_m[0])
        m_D_pose = -m_D_z @ prediction.z_D_pose[0]
        return Initial(m[0], m_D_pose, m_D_z, np.zeros((self.dim, self.dim)))

    def z_D_motion(self, z: Array) -> Array:
        """Return the Jacobians (k, dim_z, 3) of observations z (k, dim_z) by a motion of base_link.

        The motion is [dx, dy, dtheta] in base_link: `z_D_pose` at the origin.
        """
        origin = np.zeros(3)
        return self.predict(origin, self.invert(origin, z)).z_D_pose

    def retract(self, m: Array, delta: Array) -> Array:
        """Return landmarks m (..., k, dim) moved by perturbations delta (..., k, dim)."""
        return m + delta

    def difference(self, m: Array, other: Array) -> Array:
        """Return the perturbations (..., k, dim) by which `retract` takes m to others (..., k, dim)."""
        return other - m

    def m_D_motion(self, m: Array) -> Array:
        """Return the Jacobians (k, dim, 3) of landmarks m (k, dim) by a rigid motion of the whole map.

        The motion is [x, y, theta] about the map origin. Such a motion of map and robot together is not
        observable; consistent filters need it. For a robot at the origin the motion is that of its pose,
        and z stays.
        """
        prediction = self.predict(np.zeros(3), m)
        return np.asarray(-np.linalg.solve(prediction.z_D_m, prediction.z_D_pose), np.float64)

    def carry(self, m: Array, delta: Array) -> tuple[Array, Array]:
        """Return landmarks m (k, dim) moved by delta (k, dim), and the change of `m_D_motion`."""
        after = self.retract(m, delta)
        return after, self.m_D_motion(after) - self.m_D_motion(m)

    def report(self, m: Array) -> Report:
        """Return one landmark (dim,) in the form shown to users."""
        values = dict(zip(self.values, m[2:].tolist(), strict=True))
        return Report(m[:2].copy(), values, np.eye(2, self.dim))

    def distance(self, m: Array, observed: Array) -> tuple[Array, Array]:
        """Return (p,) metres and (p,) rad between landmarks m and observed ones (p, dim), in one frame.

        The thesis associates by these (4.1.4, 5.2.2): points by their distance, with angle 0; walls
        by the distance of the feet of their normals and the angle between them, pi for two walls that
        face each other.
        """
        difference = m - observed
        return np.hypot(difference[:, 0], difference[:, 1]), np.zeros(len(m))

    def extents(self, pose: Array, m: Array, ends: Array) -> Array:
        """Return the begin and end (p, 2) of the observed pieces along landmarks (p, dim), m.

        `ends` (p, 2, 2) are the observations' end points in base_link. The default is that of a
        point: no extent.
        """
        del pose, ends
        return np.zeros((len(m), 2))

    def overlap(self, pose: Array, m: Array, known: Array, observed: Array) -> Overlap:
        """Return the overlap of landmarks m (p, dim): `known` extents (p, 2) and `observed` ones (p, 2)."""
        raise NotImplementedError(f"{type(self).__name__} has no extent")
