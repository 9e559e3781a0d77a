"""Scan matching against the last metres of way: iterated closest points with a motion prior.

The pose [x, y, theta] of the new scan in a local frame maximises the posterior of odometry and
scan: odometry is a Gaussian prior; each point of the scan adds its distance to the surface it falls on
(point to line, Censi 2008), or to a lone point such as a table leg (point to point). Wrong pairs are
weighed down by the Geman-McClure kernel. Along a bare corridor the scan says nothing and the prior
stands, because it is in the same sum.

The frame is only local: points are forgotten after a few metres, so that this stays odometry, whose
increments compose, and closing loops stays the filter's work.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from pydantic import PrivateAttr

from impslam.columns import Motions, Sweeps
from impslam.component import parameter, register
from impslam.errors import NumericalError
from impslam.geometry.kernels import kernel
from impslam.geometry.se2 import between, compose, rotation, transform
from impslam.noise import MotionNoise
from impslam.tracking.base import Tracker
from impslam.tracking.local_map import LocalMap, Surfaces, nearest, normals
from impslam.types import Array, Increment, Mask, Scan

_TINY = 1e-6  # m, rad: floor of the prior's standard deviations, so that it has an inverse


@kernel
def _thin(points: Array, spacing: float) -> Mask:
    """Tell which points in beam order lie at least `spacing` from the last one kept."""
    keep = np.zeros(len(points), np.bool_)
    last = -1
    for i in range(len(points)):
        if (
            last < 0
            or math.hypot(points[i, 0] - points[last, 0], points[i, 1] - points[last, 1]) >= spacing
        ):
            keep[i] = True
            last = i
    return keep


@kernel
def _accumulate(
    pose: Array,
    points: Array,
    scale: float,
    limit: float,
    sigma: float,
    known: Surfaces,
    normal: Array,
) -> int:
    """Add [J^T W J, J^T W e] to normal (3, 4); return how many points have a partner.

    points (n, 3) are x, y, and 1 for points of a flat surface, 0 for lone ones.
    """
    paired = 0
    c, s = math.cos(pose[2]), math.sin(pose[2])
    J = np.empty(3)
    for i in range(len(points)):
        rx, ry = c * points[i, 0] - s * points[i, 1], s * points[i, 0] + c * points[i, 1]
        x, y = pose[0] + rx, pose[1] + ry
        k = nearest(x, y, limit, known)
        if k < 0:
            continue
        flat = known.flat[k]
        # A point of a surface that meets a lone one is that surface's end in view, which moves along.
        if points[i, 2] > 0.0 and not flat:
            continue
        paired += 1
        for axis in range(1 if flat else 2):
            nx = known.normals[k, 0] if flat else 1.0 - axis
            ny = known.normals[k, 1] if flat else 1.0 * axis
            e = nx * (known.points[k, 0] - x) + ny * (known.points[k, 1] - y)
            w = 1.0 / (1.0 + (e / scale) ** 2) ** 2 / sigma**2
            J[0], J[1], J[2] = nx, ny, ny * rx - nx * ry
            for a in range(3):
                normal[a, 3] += w * J[a] * e
                for b in range(3):
                    normal[a, b] += w * J[a] * J[b]
    return paired


@kernel
def _solve(A: Array, b: Array) -> Array:
    """Return x (3,) of A x = b for a symmetric positive definite A (3, 3), by Cholesky."""
    L, x = np.zeros((3, 3)), np.empty(3)
    for i in range(3):
        for j in range(i + 1):
            entry = A[i, j]
            for k in range(j):
                entry -= L[i, k] * L[j, k]
            L[i, j] = math.sqrt(entry) if i == j else entry / L[j, j]
    for i in range(3):
        x[i] = b[i]
        for k in range(i):
            x[i] -= L[i, k] * x[k]
        x[i] /= L[i, i]
    for i in range(2, -1, -1):
        for k in range(i + 1, 3):
            x[i] -= L[k, i] * x[k]
        x[i] /= L[i, i]
    return x


@kernel
def _descend(
    guess: Array,
    prior: Array,
    points: Array,
    known: Surfaces,
    reach: float,
    sigma: float,
    iterations: int,
) -> tuple[Array, Array, int]:
    """Return the best pose (3,), the scan's information at it (3, 3), and the number of pairs.

    `prior` (3, 3) is the information of the guess. Partners are trusted from `reach` down to sigma as
    the pose settles, and sought no farther than ten sigma or four times what is trusted: beyond, the
    kernel gives them no weight.
    """
    pose, scale = guess.copy(), reach
    normal, g, paired = np.zeros((3, 4)), np.zeros(3), 0
    for _ in range(iterations):
        normal[:] = 0.0
        limit = min(max(4.0 * scale, 10.0 * sigma), reach)
        paired = _accumulate(pose, points, scale, limit, sigma, known, normal)
        for a in range(3):
            g[a] = normal[a, 3]
            for b in range(3):
                g[a] -= prior[a, b] * (pose[b] - guess[b])
        step = _solve(prior + normal[:, :3], g)
        pose += step
        if np.abs(step).max() < 1e-4 and scale <= sigma:
            break
        scale = max(0.5 * scale, sigma)
    return pose, normal[:, :3].copy(), paired


def _inverse(A: Array) -> Array:
    try:
        inverse = np.asarray(np.linalg.inv(A), dtype=np.float64)
    except np.linalg.LinAlgError:
        inverse = np.full((3, 3), np.nan)
    if not np.isfinite(inverse).all():
        raise NumericalError("the motion's covariance has no inverse; odometry is used alone")
    return inverse


def gap(scan: Scan) -> float:
    """Return how far apart neighbours of one surface may be, m: three beams' spacing, and 5 cm."""
    if len(scan.angles) < 2 or not scan.valid.any():
        return 0.0
    spacing = abs(float(scan.angles[-1] - scan.angles[0])) / (len(scan.angles) - 1)
    return 0.05 + 3.0 * spacing * float(np.median(scan.ranges[scan.valid]))


@register("icp")
class Icp(Tracker):
    """Iterated closest points against the last metres, with odometry as prior."""

    matches_scans: ClassVar[bool] = True

    sigma: float = parameter(
        0.02,
        "m",
        "standard deviation of one point's distance; more than the lidar's noise, because the points "
        "of one surface share its error",
        gt=0,
    )
    reach: float = parameter(
        0.5, "m", "a point and its partner are at most this far apart: the odometry's error", ge=0.1
    )
    spacing: float = parameter(0.05, "m", "points nearer to each other are one", gt=0)
    memory: float = parameter(6.0, "m", "points are forgotten after so much way", gt=0)
    iterations: int = parameter(15, "1", "linearisations at most", ge=1)
    min_share: float = parameter(
        0.4, "1", "share of the scan's points that must find a partner", gt=0, le=1
    )
    drift: MotionNoise = parameter(
        MotionNoise(forward=0.03, sideways=0.02, turn_per_distance=0.02, turn_per_turn=0.04),
        "",
        "what matched motion strays by all the same: surfaces are not the same from everywhere",
    )
    _map: LocalMap = PrivateAttr()
    _pose: Array = PrivateAttr(default_factory=lambda: np.zeros(3))
    _way: float = PrivateAttr(0.0)

    def refine(self, motions: Motions, sweeps: Sweeps) -> Motions:
        """Match each sweep against the local map; see `Tracker.refine`."""
        if sweeps.scans is None:
            return motions
        d_pose, covariance = motions.d_pose.copy(), motions.covariance.copy()
        for k in range(len(sweeps)):
            try:
                refined = self.match(motions.row(k), sweeps.scans.row(k))
            except NumericalError as error:
                self.problems.add(
                    "scan matching", f"the scan at {motions.stamps[k]:.3f} s: {error}"
                )
                continue
            d_pose[k], covariance[k] = refined.d_pose, refined.covariance
        return Motions(motions.stamps, d_pose, covariance, motions.duration)

    def match(self, increment: Increment, scan: Scan) -> Increment:
        """Return the motion since the scan before, refined by matching; take the scan into the local map.

        Raises
        ------
        NumericalError
            If the scan and the increment admit no solution.
        """
        points = scan.points[scan.valid]
        directions, flat = normals(points, gap(scan))
        keep = _thin(points, self.spacing)
        points, directions, flat = points[keep], directions[keep], flat[keep]
        refined = self._match(increment, np.column_stack([points, flat]))
        self._pose = compose(self._pose, refined.d_pose)
        self._way += math.hypot(refined.d_pose[0], refined.d_pose[1]) + abs(refined.d_pose[2])
        turned = directions @ rotation(self._pose[2]).T
        self._map.add(transform(self._pose, points), turned, flat, self._way)
        return refined

    def model_post_init(self, context: object) -> None:
        """Begin with an empty map."""
        self._map = LocalMap(0.5 * self.reach, self.spacing, self.memory)

    def _match(self, increment: Increment, points: Array) -> Increment:
        if len(points) < 10 or len(self._map.surfaces.points) < 10:
            return increment
        V = np.eye(3)
        V[:2, :2] = rotation(self._pose[2])
        spread = V @ increment.covariance @ V.T + _TINY**2 * np.eye(3)
        prior = _inverse(spread)
        guess = compose(self._pose, increment.d_pose)
        pose, H, paired = _descend(
            guess, prior, points, self._map.surfaces, self.reach, self.sigma, self.iterations
        )
        if not np.isfinite(pose).all():
            raise NumericalError("the normal equations have no solution; odometry is used alone")
        if paired < self.min_share * len(points):
            return increment
        d_pose = between(self._pose, pose)
        covariance = V.T @ _inverse(prior + H) @ V
        covariance = 0.5 * (covariance + covariance.T)
        covariance += self.drift.covariance(math.hypot(d_pose[0], d_pose[1]), float(d_pose[2]))
        return Increment(increment.stamp, d_pose, covariance, increment.duration)
