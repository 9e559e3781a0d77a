"""Match scans with the last metres of the path: iterated closest points (ICP) with a motion prior.

The pose [x, y, theta] of the new scan in a local frame maximises the posterior of odometry and
scan: odometry is a Gaussian prior; each point of the scan adds its distance to the surface it falls on
(point to line, Censi 2008), or to a lone point such as a table leg (point to point). The Geman-McClure
kernel reduces the weight of wrong pairs. Along a bare corridor the scan contributes nothing and the prior
determines the pose, because both are in the same sum. Errors are additive on [x, y, theta].

The frame is only local: points are removed after a few metres, so that this remains odometry, whose
increments compose; closing loops is left to the estimator.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.geometry.algebra import between, invert, rotate_covariance, solve
from impslam.geometry.chain import advance_pose
from impslam.geometry.kernels import kernel
from impslam.tracking.local_map import LocalMap, add, nearest, size
from impslam.types import Array, Ints

MIN_POINTS = 10
"""Points of the scan and of the map that matching needs."""
_MIN_PRIOR_SIGMA = 1e-6  # m, rad: keeps the prior invertible


_CONVERGED = 1e-4
"""m, rad: the iteration ends when the last step, and the motion since points were paired, are smaller."""
_MAX_PAIR_MOTION = 1e-3
"""m, rad: before that, a pose that has moved by less keeps its pairs: points are centimetres apart."""


class Settings(NamedTuple):
    """Parameters of matching; `drift` (4,) is as in `MotionNoise`."""

    sigma: float
    reach: float
    spacing: float
    memory: float
    iterations: int
    min_share: float
    drift: Array


@kernel
def match(
    d_pose: Array, covariance: Array, points: Array, local_map: LocalMap, settings: Settings
) -> bool:
    """Refine, in place, the motion (3,), (3, 3) since the last scan, and add the scan to the map.

    `points` are `Surfels.rows` of the scan. Returns whether prior and scan have a solution; without one
    nothing changes.
    """
    can_match = len(points) >= MIN_POINTS and size(local_map) >= MIN_POINTS
    if can_match and not _refine(d_pose, covariance, points, local_map, settings):
        return False
    advance_pose(local_map.pose, d_pose)
    local_map.travelled[0] += math.hypot(d_pose[0], d_pose[1]) + abs(d_pose[2])
    add(local_map, points, settings.spacing, settings.memory)
    return True


@kernel
def _refine(
    d_pose: Array, covariance: Array, points: Array, local_map: LocalMap, settings: Settings
) -> bool:
    """Refine the motion if enough points have partners; return whether there is a solution."""
    angle = local_map.pose[2]
    prior, guess = rotate_covariance(covariance, angle), local_map.pose.copy()
    for a in range(3):
        prior[a, a] += _MIN_PRIOR_SIGMA**2
    advance_pose(guess, d_pose)
    if not invert(prior):
        return False
    pose, information = guess.copy(), prior.copy()
    pairs = _optimise(pose, guess, prior, information, points, local_map, settings)
    if not (np.isfinite(pose).all() and invert(information)):
        return False
    if pairs < settings.min_share * len(points):
        return True
    between(local_map.pose, pose, d_pose)
    covariance[:] = rotate_covariance(information, -angle)
    distance, turn = math.hypot(d_pose[0], d_pose[1]), abs(d_pose[2])
    covariance[0, 0] += settings.drift[0] ** 2 * distance
    covariance[1, 1] += settings.drift[1] ** 2 * distance
    covariance[2, 2] += settings.drift[2] ** 2 * distance + settings.drift[3] ** 2 * turn
    return True


@kernel
def _optimise(
    pose: Array,
    guess: Array,
    prior: Array,
    information: Array,
    points: Array,
    local_map: LocalMap,
    settings: Settings,
) -> int:
    """Optimise `pose`, fill in its `information` (3, 3), and return the number of pairs.

    `prior` (3, 3) is the information of the guess. The scale of the kernel shrinks from `reach` to sigma as
    the pose converges. Partners are searched within ten sigma or four times the scale: farther
    ones would have no weight.
    """
    sigma, reach, scale = settings.sigma, settings.reach, settings.reach
    partners, total, step = np.full(len(points), -1), np.empty(9), np.empty(3)
    pairs, converged, drift = 0, False, np.full(3, math.inf)  # motion since points were paired
    for _ in range(settings.iterations):
        limit = min(max(4.0 * scale, 10.0 * sigma), reach)
        if converged or np.abs(drift).max() > _MAX_PAIR_MOTION:
            _pair(pose, points, limit, local_map, partners)
            drift[:] = 0.0
        pairs = _accumulate(pose, points, scale, limit, local_map.rows, partners, total)
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
        drift += step
        converged = np.abs(step).max() < _CONVERGED and scale <= sigma
        if converged and np.abs(drift).max() < _CONVERGED:
            break
        scale = max(0.5 * scale, sigma)
    return pairs


@kernel
def _pair(pose: Array, points: Array, limit: float, local_map: LocalMap, partners: Ints) -> None:
    """Fill `partners` (n,) with the rows of the nearest map points, -1 if there is none."""
    rows, older, cells = local_map.rows, local_map.older, local_map.cells
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
    """Sum up J^T W J and J^T W e with `_add`, for a sigma of 1 m; return the number of pairs."""
    pairs = 0
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
        # A surface point paired with a lone one is a surface's visible end, which moves with the robot.
        if points[i, 4] > 0.0 and not flat:
            continue
        pairs += 1
        if flat:
            nx, ny = rows[k, 2], rows[k, 3]
            _add(total, nx, ny, ny * rx - nx * ry, nx * dx + ny * dy, scale)
        else:
            _add(total, 1.0, 0.0, -ry, dx, scale)
            _add(total, 0.0, 1.0, rx, dy, scale)
    return pairs


@kernel
def _add(total: Array, nx: float, ny: float, t: float, e: float, scale: float) -> None:
    """Add the residual e along (nx, ny), with Jacobian [nx, ny, t], to `total`.

    `total` holds the entries xx, xy, xt, yy, yt, tt of J^T W J, then x, y, t of J^T W e.
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
