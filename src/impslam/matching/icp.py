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

import numpy as np
from pydantic import PrivateAttr

from impslam.component import parameter, register
from impslam.geometry.kernels import kernel
from impslam.geometry.se2 import between, compose, rotation, transform
from impslam.matching.base import Matcher
from impslam.matching.local_map import LocalMap, nearest, normals
from impslam.noise import MotionNoise
from impslam.types import Array, Increment, Ints, Mask, Scan

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
def _accumulate(  # noqa: PLR0913, PLR0917  a kernel takes plain arrays
    pose: Array,
    points: Array,
    scale: float,
    sigma: float,
    known: Array,
    directions: Array,
    flat: Mask,
    starts: Ints,
    order: Ints,
    origin: Array,
    cell: float,
    shape: tuple[int, int],
) -> tuple[Array, Array, int]:
    """Return J^T W J (3, 3), J^T W e (3,) at a pose, and how many points have a partner."""
    H, g, paired = np.zeros((3, 3)), np.zeros(3), 0
    c, s = math.cos(pose[2]), math.sin(pose[2])
    J = np.empty(3)
    for i in range(len(points)):
        rx, ry = c * points[i, 0] - s * points[i, 1], s * points[i, 0] + c * points[i, 1]
        x, y = pose[0] + rx, pose[1] + ry
        k = nearest(x, y, cell, known, starts, order, origin, cell, shape)
        if k < 0:
            continue
        paired += 1
        for axis in range(1 if flat[k] else 2):
            nx = directions[k, 0] if flat[k] else 1.0 - axis
            ny = directions[k, 1] if flat[k] else 1.0 * axis
            e = nx * (known[k, 0] - x) + ny * (known[k, 1] - y)
            w = 1.0 / (1.0 + (e / scale) ** 2) ** 2 / sigma**2
            J[0], J[1], J[2] = nx, ny, ny * rx - nx * ry
            for a in range(3):
                g[a] += w * J[a] * e
                for b in range(3):
                    H[a, b] += w * J[a] * J[b]
    return H, g, paired


@register("icp")
class Icp(Matcher):
    """Iterated closest points against the last metres, with odometry as prior."""

    sigma: float = parameter(
        0.02,
        "m",
        "standard deviation of one point's distance; more than the lidar's noise, because the points "
        "of one surface share its error",
        gt=0,
    )
    reach: float = parameter(
        0.5, "m", "a point and its partner are at most this far apart: the odometry's error", gt=0
    )
    spacing: float = parameter(0.04, "m", "points nearer to each other are one", gt=0)
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

    def refine(self, increment: Increment, scan: Scan) -> Increment:
        """Return the motion since the previous scan; see `Matcher.refine`."""
        points = scan.points[scan.valid]
        spread = float(np.median(np.abs(np.diff(scan.angles)))) if len(points) > 1 else 0.0
        gap = (
            0.05 + 3.0 * spread * float(np.median(scan.ranges[scan.valid])) if len(points) else 0.0
        )
        directions, flat = normals(points, gap)
        keep = _thin(points, self.spacing)
        points, directions, flat = points[keep], directions[keep], flat[keep]
        refined = self._match(increment, points)
        self._pose = compose(self._pose, refined.d_pose)
        self._way += math.hypot(refined.d_pose[0], refined.d_pose[1]) + abs(refined.d_pose[2])
        turned = directions @ rotation(self._pose[2]).T
        self._map.add(transform(self._pose, points), turned, flat, self._way)
        return refined

    def model_post_init(self, context: object) -> None:
        """Begin with an empty map."""
        self._map = LocalMap(self.reach, self.spacing, self.memory)

    def _match(self, increment: Increment, points: Array) -> Increment:
        if len(points) < 10 or len(self._map.points) < 10:
            return increment
        V = np.eye(3)
        V[:2, :2] = rotation(self._pose[2])
        spread = V @ increment.covariance @ V.T + _TINY**2 * np.eye(3)
        prior = np.asarray(np.linalg.inv(spread), dtype=np.float64)
        guess = compose(self._pose, increment.d_pose)
        pose, H, paired = self._descend(guess, prior, points)
        if paired < self.min_share * len(points):
            return increment
        d_pose = between(self._pose, pose)
        covariance = V.T @ np.linalg.inv(prior + H) @ V
        covariance = 0.5 * (covariance + covariance.T)
        covariance += self.drift.covariance(math.hypot(d_pose[0], d_pose[1]), float(d_pose[2]))
        return Increment(increment.stamp, d_pose, covariance, increment.duration)

    def _descend(self, guess: Array, prior: Array, points: Array) -> tuple[Array, Array, int]:
        """Return the best pose, the information of the scan at it, and the number of pairs."""
        known = self._map
        pose, scale = guess.copy(), self.reach
        for _ in range(self.iterations):
            H, g, paired = _accumulate(
                pose,
                points,
                scale,
                self.sigma,
                known.points,
                known.normals,
                known.flat,
                *known.index,
            )
            away = pose - guess
            step = np.linalg.solve(prior + H, g - prior @ away)
            pose = pose + step
            done = np.abs(step).max() < 1e-4 and scale <= self.sigma
            scale = max(0.5 * scale, self.sigma)  # from catching all to trusting the near
            if done:
                break
        return pose, H, paired
