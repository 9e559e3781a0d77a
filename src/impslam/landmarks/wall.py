"""Walls: oriented lines, each with a frame of its own (thesis 4.2.6; Castellanos's SPmap, 1999).

State m = [x, y, phi]: the pose in map of a frame on the wall near where it was first seen, its x axis
n pointing *into* the wall, its y axis along it. It is perturbed in its own frame,

    m [+] (dn, dt, dphi) = [p + R(phi) (dn, dt), phi + dphi],

and measured as z = [rho, alpha] in base_link (thesis Eq. 4.15, signed):

    rho = n . (p - t),    alpha = phi - theta    for the pose [t, theta].

The thesis's state, the foot of the normal from the map origin, is singular if a wall passes through the
origin, and its covariance is nearly singular for every wall far from its foot; this form is regular
everywhere, and the signed rho stays smooth when the robot crosses the wall's line (a door).
A surface is seen from one side only, so its normal has a direction and no +-pi ambiguity.

The position of the frame along the wall (dt) is not observed. It is still part of the state: it
is correlated with the robot's pose when the wall was first seen, so that a wall moves along itself
when a loop closes, and its end points, stored along the wall from p, move with it. The perturbation
in the wall's own frame keeps that direction free of false information when phi is corrected.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from impslam.component import parameter, register
from impslam.geometry.angles import wrap, wrap_in_kernel
from impslam.geometry.kernels import kernel, plain
from impslam.geometry.se2 import between, compose, transform
from impslam.landmarks.base import Initial, LandmarkModel, Overlap, Prediction, Report
from impslam.landmarks.batch import batched
from impslam.types import Array, Observation


@kernel
def _predict(poses: Array, m: Array) -> tuple[Array, Array, Array]:
    """Return z (b, k, 2), z_D_pose (b, k, 2, 3) and z_D_m (b, k, 2, 3)."""
    b, n, _ = m.shape
    z, z_D_pose, z_D_m = np.empty((b, n, 2)), np.zeros((b, n, 2, 3)), np.zeros((b, n, 2, 3))
    for i in range(b):
        for k in range(n):
            c, s = math.cos(m[i, k, 2]), math.sin(m[i, k, 2])
            dx, dy = m[i, k, 0] - poses[i, 0], m[i, k, 1] - poses[i, 1]
            z[i, k, 0] = c * dx + s * dy
            z[i, k, 1] = wrap_in_kernel(m[i, k, 2] - poses[i, 2])
            by_m, by_pose = z_D_m[i, k], z_D_pose[i, k]
            by_pose[0, 0], by_pose[0, 1], by_pose[1, 2] = -c, -s, -1.0
            by_m[0, 0], by_m[0, 2], by_m[1, 2] = 1.0, c * dy - s * dx, 1.0
    return z, z_D_pose, z_D_m


@kernel
def _extents(pose: Array, m: Array, ends: Array) -> Array:
    """Return the sorted positions (p, 2) of ends (p, 2, 2), in base_link, along walls m (p, 3)."""
    out = np.empty((len(m), 2))
    for p in range(len(m)):
        dx, dy = pose[0] - m[p, 0], pose[1] - m[p, 1]
        origin = math.cos(m[p, 2]) * dy - math.sin(m[p, 2]) * dx
        c, s = math.cos(m[p, 2] - pose[2]), math.sin(m[p, 2] - pose[2])
        one = origin + c * ends[p, 0, 1] - s * ends[p, 0, 0]
        two = origin + c * ends[p, 1, 1] - s * ends[p, 1, 0]
        out[p, 0], out[p, 1] = min(one, two), max(one, two)
    return out


@kernel
def _fill_m_D_motion(m: Array, c: float, s: float, out: Array) -> None:
    """Fill out (3, 3) with R(phi)^T [I, (-y, x)] over [0, 0, 1] of a wall, c and s those of phi."""
    out[0, 0], out[0, 1], out[0, 2] = c, s, s * m[0] - c * m[1]
    out[1, 0], out[1, 1], out[1, 2] = -s, c, c * m[0] + s * m[1]
    out[2, 0], out[2, 1], out[2, 2] = 0.0, 0.0, 1.0


@kernel
def _m_D_motion(m: Array) -> Array:
    """Return `LandmarkModel.m_D_motion` (k, 3, 3) of walls m (k, 3)."""
    out = np.empty((len(m), 3, 3))
    for k in range(len(m)):
        _fill_m_D_motion(m[k], math.cos(m[k, 2]), math.sin(m[k, 2]), out[k])
    return out


@kernel
def _carry(m: Array, delta: Array) -> tuple[Array, Array]:
    """Return walls m (k, 3) moved by delta (k, 3), and the change of `_m_D_motion`."""
    after, change, before = np.empty_like(m), np.empty((len(m), 3, 3)), np.empty((3, 3))
    for k in range(len(m)):
        c, s = math.cos(m[k, 2]), math.sin(m[k, 2])
        after[k, 0] = m[k, 0] + c * delta[k, 0] - s * delta[k, 1]
        after[k, 1] = m[k, 1] + s * delta[k, 0] + c * delta[k, 1]
        after[k, 2] = wrap_in_kernel(m[k, 2] + delta[k, 2])
        _fill_m_D_motion(m[k], c, s, before)
        _fill_m_D_motion(after[k], math.cos(after[k, 2]), math.sin(after[k, 2]), change[k])
        change[k] -= before
    return after, change


@kernel
def _overlap(pose: Array, m: Array, known: Array, observed: Array) -> tuple[Array, Array, Array]:
    """Return gap (p,), gap_D_pose (p, 3) and gap_D_m (p, 3); see `Overlap`."""
    p = len(m)
    gap, gap_D_pose, gap_D_m = np.empty(p), np.empty((p, 3)), np.zeros((p, 3))
    for k in range(p):
        c, s = math.cos(m[k, 2]), math.sin(m[k, 2])
        gap[k] = max(observed[k, 0] - known[k, 1], known[k, 0] - observed[k, 1])
        gap_D_pose[k, 0], gap_D_pose[k, 1] = -s, c
        gap_D_pose[k, 2] = c * (m[k, 0] - pose[0]) + s * (m[k, 1] - pose[1])
        gap_D_m[k, 1] = -1.0
    return gap, gap_D_pose, gap_D_m


@kernel
def _outline(m: Array, extents: Array) -> Array:
    """Return the two ends (k, 2, 2) of walls m (k, 3) in map, from extents (k, 2)."""
    out = np.empty((len(m), 2, 2))
    for k in range(len(m)):
        c, s = math.cos(m[k, 2]), math.sin(m[k, 2])
        for e in range(2):
            out[k, e, 0] = m[k, 0] - extents[k, e] * s
            out[k, e, 1] = m[k, 1] + extents[k, e] * c
    return out


@register("wall")
class Wall(LandmarkModel):
    """A straight wall with two ends."""

    dim: ClassVar[int] = 3
    dim_z: ClassVar[int] = 2
    z_angles: ClassVar[tuple[int, ...]] = (1,)
    has_extent: ClassVar[bool] = True
    is_place: ClassVar[bool] = False  # the position is perturbed in the frame's own axes

    max_gap: float = parameter(
        1.0,
        "m",
        "two collinear pieces with at most this between them are one wall (a door is 0.8 to 1 m)",
        ge=0,
    )

    def observe(self, pose: Array, m: Array) -> Array:
        """Return signed distances and directions of the walls; see `LandmarkModel.observe`."""
        x, y, theta = np.moveaxis(pose[..., None, :], -1, 0)
        c, s = np.cos(m[..., 2]), np.sin(m[..., 2])
        rho = c * (m[..., 0] - x) + s * (m[..., 1] - y)
        return np.stack([rho, wrap(m[..., 2] - theta)], axis=-1)

    def invert(self, pose: Array, z: Array) -> Array:
        """Return the walls with their frames at the feet of the normals from base_link."""
        rho, alpha = z[..., 0], z[..., 1]
        foot = np.stack([rho * np.cos(alpha), rho * np.sin(alpha), alpha], axis=-1)
        return compose(pose[..., None, :], foot)

    def predict(self, pose: Array, m: Array) -> Prediction:
        """Return `observe` with its Jacobians in closed form."""
        return batched(_predict, pose, m)

    def initialise(self, pose: Array, observation: Observation) -> Initial:
        """Return the wall with its frame at the middle of the observed piece (thesis Algorithm 2)."""
        rho, alpha = observation.z
        along = np.array([-math.sin(alpha), math.cos(alpha)])
        ends = observation.end_points if observation.end_points is not None else np.zeros((2, 2))
        middle = float(along @ ends.mean(axis=0))
        in_base = rho * np.array([math.cos(alpha), math.sin(alpha)]) + middle * along
        phi = wrap(float(pose[2] + alpha))
        n, t = np.array([math.cos(phi), math.sin(phi)]), np.array([-math.sin(phi), math.cos(phi)])
        m = np.array([*transform(pose, in_base), phi])
        m_D_pose = np.array([[*n, -middle], [*t, rho], [0.0, 0.0, 1.0]])
        m_D_z = np.array([[1.0, -middle], [0.0, 0.0], [0.0, 1.0]])
        # Along the wall the ends are known to a beam's spacing, uniformly distributed.
        spacing = float(np.linalg.norm(ends[1] - ends[0])) / max(len(observation.beams) - 1, 1)
        slack = np.diag([0.0, spacing**2 / 12.0 + 1e-6, 0.0])
        return Initial(m, m_D_pose, m_D_z, slack)

    def retract(self, m: Array, delta: Array) -> Array:
        """Move the frames in their own axes."""
        return compose(m, delta)

    def difference(self, m: Array, other: Array) -> Array:
        """Return the others as seen from the frames; see `LandmarkModel.difference`."""
        return between(m, other)

    def m_D_motion(self, m: Array) -> Array:
        """Return R(phi)^T [I, (-y, x)] over [0, 0, 1]; see `LandmarkModel.m_D_motion`."""
        return _m_D_motion(m)

    def carry(self, m: Array, delta: Array) -> tuple[Array, Array]:
        """Return `retract` and the change of `m_D_motion` in one kernel."""
        return _carry(m, delta)

    def report(self, m: Array) -> Report:
        """Return the foot of the normal from the map origin, r >= 0 and alpha (thesis Fig. 20)."""
        c, s = math.cos(m[2]), math.sin(m[2])
        distance, lever = c * m[0] + s * m[1], c * m[1] - s * m[0]
        sign = -1.0 if distance < 0.0 else 1.0
        alpha = wrap(float(m[2]) + (math.pi if sign < 0.0 else 0.0))
        values_D_m = np.array([[sign, 0.0, sign * lever], [0.0, 0.0, 1.0]])
        foot = np.array([distance * c, distance * s])
        return Report(foot, {"r": sign * distance, "alpha": alpha}, values_D_m)

    def distance(self, m: Array, observed: Array) -> tuple[Array, Array]:
        """Return distances of feet (thesis 5.2.2), and angles between normals in [0, pi]."""
        feet = []
        for walls in (m, observed):
            c, s = np.cos(walls[:, 2]), np.sin(walls[:, 2])
            feet.append((c * walls[:, 0] + s * walls[:, 1]) * np.stack([c, s]))
        return np.hypot(*(feet[0] - feet[1])), np.abs(wrap(m[:, 2] - observed[:, 2]))

    def extents(self, pose: Array, m: Array, ends: Array) -> Array:
        """Return the begin and end of each observed piece along its wall, from the frame, m."""
        return _extents(pose, m, ends)

    def overlap(self, pose: Array, m: Array, known: Array, observed: Array) -> Overlap:
        """Return the gaps between known and observed pieces; see `LandmarkModel.overlap`."""
        return Overlap(*_overlap(pose, m, known, observed), self.max_gap)

    def outline(self, m: Array, extents: Array) -> Array:
        """Return the walls' two ends in map."""
        m, extents = plain(m), plain(extents)
        ends = _outline(m.reshape(-1, 3), extents.reshape(-1, 2))
        return ends.reshape(*m.shape[:-1], 2, 2)
