"""Scan matching against the last metres of way: iterated closest points with a motion prior.

The pose [x, y, theta] of the new scan in a local frame maximises the posterior of odometry and
scan: odometry is a Gaussian prior; each point of the scan adds its distance to the surface it falls on
(point to line, Censi 2008), or to a lone point such as a table leg (point to point). Wrong pairs are
weighed down by the Geman-McClure kernel. Along a bare corridor the scan says nothing and the prior
stands, because it is in the same sum. Errors are additive on [x, y, theta].

The frame is only local: points are forgotten after a few metres, so that this stays odometry, whose
increments compose, and closing loops stays the filter's work.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.algebra import between, invert, solve, turned
from impslam.geometry.chain import advance_pose
from impslam.geometry.kernels import kernel
from impslam.tracking.local_map import LocalMap, add, nearest, size
from impslam.types import Array, Ints

AS_GIVEN, MATCHED, UNSOLVED = 0, 1, 2
"""What came of a match: the scan told nothing; it did; prior and scan admit no solution."""
FEWEST_POINTS = 10
"""Of a scan and of the map, below which nothing is matched."""
_TINY = 1e-6  # m, rad: floor of the prior's standard deviations, so that it has an inverse


_SETTLED = 1e-4
"""m, rad: the last step of a pose is smaller, and so is its way since points were paired."""
_MOVED = 1e-3
"""m, rad: until then, a pose that has moved by less keeps its pairs: points lie centimetres apart."""


class Settings(NamedTuple):
    """How scans are matched; `drift` (4,) are as in `MotionNoise`."""

    sigma: float
    reach: float
    spacing: float
    memory: float
    iterations: int
    min_share: float
    drift: Array


@kernel
def match(
    d_pose: Array, covariance: Array, points: Array, known: LocalMap, settings: Settings
) -> int:
    """Refine in place the motion (3,), (3, 3) since the last scan; take the scan into the map.

    `points` are `Surfels.rows` of the scan. Without a solution nothing is changed. Returns one of
    `AS_GIVEN`, `MATCHED` and `UNSOLVED`.
    """
    status = AS_GIVEN
    if len(points) >= FEWEST_POINTS and size(known) >= FEWEST_POINTS:
        status = _refine(d_pose, covariance, points, known, settings)
        if status == UNSOLVED:
            return status
    advance_pose(known.pose, d_pose)
    known.way[0] += math.hypot(d_pose[0], d_pose[1]) + abs(d_pose[2])
    add(known, points, settings.spacing, settings.memory)
    return status


@kernel
def _refine(
    d_pose: Array, covariance: Array, points: Array, known: LocalMap, settings: Settings
) -> int:
    angle = known.pose[2]
    prior, guess = turned(covariance, angle), known.pose.copy()
    for a in range(3):
        prior[a, a] += _TINY**2
    advance_pose(guess, d_pose)
    if not invert(prior):
        return UNSOLVED
    pose, information = guess.copy(), prior.copy()
    paired = _descend(pose, guess, prior, information, points, known, settings)
    if not (np.isfinite(pose).all() and invert(information)):
        return UNSOLVED
    if paired < settings.min_share * len(points):
        return AS_GIVEN
    between(known.pose, pose, d_pose)
    covariance[:] = turned(information, -angle)
    way, turn = math.hypot(d_pose[0], d_pose[1]), abs(d_pose[2])
    covariance[0, 0] += settings.drift[0] ** 2 * way
    covariance[1, 1] += settings.drift[1] ** 2 * way
    covariance[2, 2] += settings.drift[2] ** 2 * way + settings.drift[3] ** 2 * turn
    return MATCHED


@kernel
def _descend(
    pose: Array,
    guess: Array,
    prior: Array,
    information: Array,
    points: Array,
    known: LocalMap,
    settings: Settings,
) -> int:
    """Bring `pose` to the best one, and `information` (3, 3) to that there; return the number of pairs.

    `prior` (3, 3) is the information of the guess. Partners are trusted from `reach` down to sigma as
    the pose settles, and sought no farther than ten sigma or four times what is trusted: beyond, the
    kernel gives them no weight.
    """
    sigma, reach, scale = settings.sigma, settings.reach, settings.reach
    partners, total, step = np.full(len(points), -1), np.empty(9), np.empty(3)
    paired, settled, since = 0, False, np.full(3, math.inf)  # the way since points were paired
    for _ in range(settings.iterations):
        limit = min(max(4.0 * scale, 10.0 * sigma), reach)
        if settled or np.abs(since).max() > _MOVED:
            _pair(pose, points, limit, known, partners)
            since[:] = 0.0
        paired = _accumulate(pose, points, scale, limit, known.rows, partners, total)
        total /= sigma**2
        k = 0
        for a in range(3):
            step[a] = total[6 + a]
            for b in range(3):
                step[a] -= prior[a, b] * (pose[b] - guess[b])
            for b in range(a, 3):
                information[a, b] = information[b, a] = prior[a, b] + total[k]
                k += 1
        if not solve(information, step):
            pose[:] = math.nan
            break
        pose += step
        since += step
        settled = np.abs(step).max() < _SETTLED and scale <= sigma
        if settled and np.abs(since).max() < _SETTLED:
            break
        scale = max(0.5 * scale, sigma)
    return paired


@kernel
def _pair(pose: Array, points: Array, limit: float, known: LocalMap, partners: Ints) -> None:
    """Fill `partners` (n,) with the rows of the nearest known points, -1 where there is none."""
    rows, older, cells = known.rows, known.older, known.cells
    c, s = math.cos(pose[2]), math.sin(pose[2])
    last = -1
    for i in range(len(points)):
        x = pose[0] + c * points[i, 0] - s * points[i, 1]
        y = pose[1] + s * points[i, 0] + c * points[i, 1]
        hint = partners[i] if partners[i] >= 0 else last
        last = partners[i] = nearest(x, y, limit, hint, rows, older, cells)


@kernel
def _accumulate(
    pose: Array,
    points: Array,
    scale: float,
    limit: float,
    rows: Array,
    partners: Ints,
    total: Array,
) -> int:
    """Sum up J^T W J and J^T W e as `_add` does, for a sigma of 1 m; return how many points pair."""
    paired = 0
    c, s = math.cos(pose[2]), math.sin(pose[2])
    total[:] = 0.0
    for i in range(len(points)):
        rx, ry = c * points[i, 0] - s * points[i, 1], s * points[i, 0] + c * points[i, 1]
        x, y = pose[0] + rx, pose[1] + ry
        k = partners[i]
        if k < 0:
            continue
        dx, dy = rows[k, 0] - x, rows[k, 1] - y
        if dx * dx + dy * dy >= limit * limit:
            continue
        flat = rows[k, 4] > 0.0
        # A point of a surface that meets a lone one is that surface's end in view, which moves along.
        if points[i, 4] > 0.0 and not flat:
            continue
        paired += 1
        if flat:
            nx, ny = rows[k, 2], rows[k, 3]
            _add(total, nx, ny, ny * rx - nx * ry, nx * dx + ny * dy, scale)
        else:
            _add(total, 1.0, 0.0, -ry, dx, scale)
            _add(total, 0.0, 1.0, rx, dy, scale)
    return paired


@kernel
def _add(total: Array, nx: float, ny: float, t: float, e: float, scale: float) -> None:
    """Add a point e off along (nx, ny), whose Jacobian is [nx, ny, t].

    To J^T W J as its entries xx, xy, xt, yy, yt, tt, then to J^T W e as x, y, t.
    """
    w = 1.0 / (1.0 + (e / scale) ** 2) ** 2
    wx, wy, wt = w * nx, w * ny, w * t
    total[0] += wx * nx
    total[1] += wx * ny
    total[2] += wx * t
    total[3] += wy * ny
    total[4] += wy * t
    total[5] += wt * t
    total[6] += wx * e
    total[7] += wy * e
    total[8] += wt * e
