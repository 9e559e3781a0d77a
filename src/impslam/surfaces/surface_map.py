"""A map of surfaces that scans are aligned with: a grid whose cells name the nearest surface element.

Each surface element (surfel) keeps the mean of the points that fell into its cell, and their mean
normal. The grid finds the surfel for a point with one look-up, and the surfel gives the distance below
the size of a cell. Points are weighed by the squared Geman-McClure weight, whose scale narrows while the
pose settles; a prior holds what the surfaces leave open (Censi 2008 for the
point-to-line error; Chebrolu et al. 2021 for narrowing kernels). Poses are [x, y, theta] with additive
errors.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np

from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.pages import zero_pages
from impslam.surfaces.features import Features
from impslam.types import Array, Ints

CELL = 0.05  # m: two surfels of one wall lie in neighbouring cells
REACH = 8  # cells: a point finds a surfel up to 0.4 m away
FACING = 0.6  # cosine of 53 degrees: normals farther apart belong to two surfaces
LONE, ODD = (
    0.2,
    0.1,
)  # weight of a point without surface, and of one whose surfel has one, or reversely
_X, _Y, _NX, _NY, _COUNT, _WEIGHT, _X0, _Y0 = range(8)
_INSIDE, _INLIERS, _SQUARES, _WEIGHTS = range(4)


class SurfaceMap(NamedTuple):
    """Surfels and the grid that finds them; memory is taken where surfels are.

    Attributes
    ----------
    nearest : (h, w) int32, 1 + the index of the nearest surfel; 0 where none is within `REACH`
    closeness : (h, w) uint8, `REACH**2 + 1` minus the squared distance to that surfel's cell, in cells
    surfels : (n, 8) x, y of the mean point, normal, number of points, weight of the normal, and the
        point that founded it
    size : (1,) number of surfels
    corner : (2,) m, the lower left corner of the grid
    """

    nearest: np.ndarray[tuple[int, ...], np.dtype[np.int32]]
    closeness: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]
    surfels: Array
    size: Ints
    corner: Array


class Alignment(NamedTuple):
    """How a scan is aligned.

    Attributes
    ----------
    iterations : linearisations at most
    wide, narrow : m, scale of the robust kernel at the start and at the end
    information : 1/m^2, of the distance of one point
    step : every step-th feature is used
    slack2 : squared Mahalanobis distance from the prior, beyond which it counts for less and less
        (Cauchy); inf: never
    """

    iterations: int
    wide: float
    narrow: float
    information: float
    step: int
    slack2: float


class Evidence(NamedTuple):
    """What the points of a scan say of its pose, in units of one point.

    Attributes
    ----------
    H, g : (3, 3), (3,) of the normal equations
    sums : (4,) points on the grid; the sum of their inlier weights, by Geman and McClure; over the
        points on surfaces, the weighted sum of squared distances, m^2, and that of the weights
    """

    H: Array
    g: Array
    sums: Array


def no_evidence() -> Evidence:
    """Return room for the evidence of a scan."""
    return Evidence(np.zeros((3, 3)), np.zeros(3), np.zeros(4))


def empty_surface_map(width: float, height: float, surfels: int) -> SurfaceMap:
    """Return a map of width x height m around the origin, with room for so many surfels."""
    shape = math.ceil(height / CELL), math.ceil(width / CELL)
    return SurfaceMap(
        zero_pages(shape, np.int32),
        zero_pages(shape, np.uint8),
        zero_pages((surfels, 8), np.float64),
        np.zeros(1, np.int64),
        np.array([-0.5 * width, -0.5 * height]),
    )


@kernel
def clear(known: SurfaceMap, corner: Array) -> None:
    """Remove all surfels, and move the grid's corner (2,) m."""
    height, width = known.nearest.shape
    one_by_one = known.size[0] * (2 * REACH + 1) ** 2 < height * width
    if not one_by_one:
        known.nearest[:] = 0
        known.closeness[:] = 0
    for k in range(known.size[0] if one_by_one else 0):
        column = int((known.surfels[k, _X0] - known.corner[0]) / CELL)
        row = int((known.surfels[k, _Y0] - known.corner[1]) / CELL)
        for r in range(max(0, row - REACH), min(height, row + REACH + 1)):
            for c in range(max(0, column - REACH), min(width, column + REACH + 1)):
                known.nearest[r, c] = 0
                known.closeness[r, c] = 0
    known.size[0] = 0
    known.corner[:] = corner


@kernel
def add(known: SurfaceMap, features: Features, pose: Array, most: float) -> None:
    """Add the features of a scan taken at pose (3,) in the map's frame.

    A surfel averages over at most `most` points, so that it follows what changes. Features off the grid
    are left out.
    """
    height, width = known.nearest.shape
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for i in range(len(features)):
        x = pose[0] + c * features[i, 0] - s * features[i, 1]
        y = pose[1] + s * features[i, 0] + c * features[i, 1]
        u, v = (x - known.corner[0]) / CELL, (y - known.corner[1]) / CELL
        inside = min(u, v) >= REACH + 1 and u < width - REACH - 1 and v < height - REACH - 1
        if not inside:  # also where a pose is not finite
            continue
        column, row = int(u), int(v)
        nx = c * features[i, 2] - s * features[i, 3]
        ny = s * features[i, 2] + c * features[i, 3]
        weight = float(features[i, 4])
        if known.closeness[row, column] == REACH * REACH + 1:
            _refresh(known.surfels[known.nearest[row, column] - 1], x, y, nx, ny, weight, most)
        elif known.size[0] < len(known.surfels):
            surfel = known.surfels[known.size[0]]
            surfel[_X], surfel[_Y], surfel[_NX], surfel[_NY] = x, y, nx, ny
            surfel[_COUNT], surfel[_WEIGHT], surfel[_X0], surfel[_Y0] = 1.0, weight, x, y
            known.size[0] += 1
            _found(known, row, column)


@kernel
def _found(known: SurfaceMap, row: int, column: int) -> None:
    """Make the newest surfel the nearest one of the cells around that have none nearer."""
    for dr in range(-REACH, REACH + 1):
        for dc in range(-REACH, REACH + 1):
            close = REACH * REACH + 1 - dr * dr - dc * dc
            if close > known.closeness[row + dr, column + dc]:
                known.closeness[row + dr, column + dc] = close
                known.nearest[row + dr, column + dc] = known.size[0]


@kernel
def _refresh(
    surfel: Array, x: float, y: float, nx: float, ny: float, weight: float, most: float
) -> None:
    """Average one more point into its surfel; the other side of a thin wall is another surface."""
    if weight > 0.0 and surfel[_WEIGHT] == 0.0:
        surfel[_NX], surfel[_NY], surfel[_WEIGHT] = nx, ny, weight
    elif weight > 0.0:
        if surfel[_NX] * nx + surfel[_NY] * ny < 0.3:
            return
        a = surfel[_NX] * surfel[_COUNT] + nx * weight
        b = surfel[_NY] * surfel[_COUNT] + ny * weight
        length = math.sqrt(a * a + b * b)
        surfel[_NX], surfel[_NY] = a / length, b / length
        surfel[_WEIGHT] = max(surfel[_WEIGHT], weight)
    elif surfel[_WEIGHT] > 0.0:
        return
    surfel[_COUNT] = min(surfel[_COUNT] + 1.0, most)
    surfel[_X] += (x - surfel[_X]) / surfel[_COUNT]
    surfel[_Y] += (y - surfel[_Y]) / surfel[_COUNT]


@kernel
def normal_equations(
    known: SurfaceMap, features: Features, pose: Array, scale: float, step: int, out: Evidence
) -> None:
    """Fill `out` with what every `step`-th feature says of a pose (3,); `scale` m is the kernel's."""
    height, width = known.nearest.shape
    c, s = math.cos(pose[2]), math.sin(pose[2])
    reach = min(float(REACH), max(3.0 * scale / CELL, 2.0))
    least = REACH * REACH + 1 - reach * reach
    # Sums in tuples stay in registers; in arrays, every point would wait for the one before it.
    sums = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    inside = inliers = squares = weights = 0.0
    for i in range(0, len(features), step):
        rx = c * features[i, 0] - s * features[i, 1]
        ry = s * features[i, 0] + c * features[i, 1]
        x, y = pose[0] + rx, pose[1] + ry
        u, v = (x - known.corner[0]) / CELL, (y - known.corner[1]) / CELL
        if not (0.0 <= u < width and 0.0 <= v < height):  # also where a pose is not finite
            continue
        inside += 1.0
        k = known.nearest[int(v), int(u)] - 1
        if k < 0 or known.closeness[int(v), int(u)] < least:
            continue
        surfel, weight = known.surfels[k], float(features[i, 4])
        ex, ey = x - surfel[_X], y - surfel[_Y]
        if surfel[_WEIGHT] > 0.0 and weight > 0.0:
            nx, ny = surfel[_NX], surfel[_NY]
            along = c * (features[i, 2] * nx + features[i, 3] * ny)
            along += s * (features[i, 2] * ny - features[i, 3] * nx)
            if along < FACING:
                continue
            e = nx * ex + ny * ey
            share = 1.0 / (1.0 + (e / scale) ** 2)
            w = surfel[_WEIGHT] * weight * share**2
            sums = _plus(sums, nx, ny, ny * rx - nx * ry, e, w)
            squares += share * share * e * e
            weights += share * share
        else:
            share = 1.0 / (1.0 + (ex * ex + ey * ey) / (scale * scale))
            w = (LONE if surfel[_WEIGHT] == weight else ODD) * share * share
            sums = _plus(_plus(sums, 1.0, 0.0, -ry, ex, w), 0.0, 1.0, rx, ey, w)
        inliers += share
    _write(out, sums, (inside, inliers, squares, weights))


_Sums: TypeAlias = tuple[float, float, float, float, float, float, float, float, float]
"""The upper triangle of H, row by row, and g."""


@kernel
def _plus(sums: _Sums, nx: float, ny: float, lever: float, e: float, w: float) -> _Sums:
    """Return the sums with the row (nx, ny, lever), of residual e m and weight w."""
    xx, xy, xt, yy, yt, tt, gx, gy, gt = sums
    wx, wy, wt = w * nx, w * ny, w * lever
    xx, xy, xt = xx + wx * nx, xy + wx * ny, xt + wx * lever
    yy, yt, tt = yy + wy * ny, yt + wy * lever, tt + wt * lever
    return xx, xy, xt, yy, yt, tt, gx + wx * e, gy + wy * e, gt + wt * e


@kernel
def _write(out: Evidence, sums: _Sums, counts: tuple[float, float, float, float]) -> None:
    """Fill `out` with the sums, and its own `sums` with the counts."""
    H, g, n = out.H, out.g, out.sums
    n[_INSIDE], n[_INLIERS], n[_SQUARES], n[_WEIGHTS] = counts
    H[0, 0], H[0, 1], H[0, 2], H[1, 1], H[1, 2], H[2, 2], g[0], g[1], g[2] = sums
    H[1, 0], H[2, 0], H[2, 1] = H[0, 1], H[0, 2], H[1, 2]


@kernel
def align(
    known: SurfaceMap,
    features: Features,
    pose: Array,
    prior: Array,
    how: Alignment,
    out: Evidence,
) -> float:
    """Move pose (3,) in place to where the features fit the map best, and return the inlier share.

    prior (3,) is the information of the pose as given, 1/m^2, 1/m^2 and 1/rad^2; see `Alignment.slack2`.
    `out` becomes what the scan alone says of the pose that is returned.
    """
    given, g, A = pose.copy(), np.empty(3), np.empty((3, 3))
    for i in range(how.iterations):
        narrowing = min(1.0, i / (0.5 * how.iterations))
        scale = how.wide * (how.narrow / how.wide) ** narrowing
        normal_equations(known, features, pose, scale, how.step, out)
        ex, ey = pose[0] - given[0], pose[1] - given[1]
        et = wrap_in_kernel(pose[2] - given[2])
        chi2 = prior[0] * ex * ex + prior[1] * ey * ey + prior[2] * et * et
        w = 1.0 / (1.0 + chi2 / how.slack2)
        A[:], g[:] = how.information * out.H, how.information * out.g
        for a in range(3):
            A[a, a] += w * prior[a]
        g[0] += w * prior[0] * ex
        g[1] += w * prior[1] * ey
        g[2] += w * prior[2] * et
        dx, dy, dt = solve_3x3(A, g)
        pose[0] -= dx
        pose[1] -= dy
        pose[2] -= dt
        if abs(dx) + abs(dy) < 2e-4 and abs(dt) < 1e-4 and scale == how.narrow:
            break
    pose[2] = wrap_in_kernel(pose[2])
    return float(out.sums[_INLIERS] / max(out.sums[_INSIDE], 1.0))


@kernel
def solve_3x3(A: Array, b: Array) -> tuple[float, float, float]:
    """Return A^-1 b for a symmetric A (3, 3); zeros where A has no inverse."""
    p = A[1, 1] * A[2, 2] - A[1, 2] * A[1, 2]
    q = A[1, 2] * A[0, 2] - A[0, 1] * A[2, 2]
    r = A[0, 1] * A[1, 2] - A[1, 1] * A[0, 2]
    det = A[0, 0] * p + A[0, 1] * q + A[0, 2] * r
    if not det > 0.0:
        return 0.0, 0.0, 0.0
    u = A[0, 0] * A[2, 2] - A[0, 2] * A[0, 2]
    v = A[0, 1] * A[0, 2] - A[0, 0] * A[1, 2]
    w = A[0, 0] * A[1, 1] - A[0, 1] * A[0, 1]
    return (
        (p * b[0] + q * b[1] + r * b[2]) / det,
        (q * b[0] + u * b[1] + v * b[2]) / det,
        (r * b[0] + v * b[1] + w * b[2]) / det,
    )
