"""A map of surfaces for aligning scans: a grid whose cells refer to the nearest surface element.

Each surface element (surfel) keeps the mean of the points in its cell, and their mean normal. The grid
finds the surfel for a point with one look-up, and the surfel gives the distance at sub-cell resolution.
Points have the squared Geman-McClure weight, whose scale narrows while the pose converges; a prior
constrains the directions that surfaces do not determine (Censi 2008 for the point-to-line error; Chebrolu
et al. 2021 for narrowing kernels). Poses are [x, y, theta] with additive errors.
"""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np

from impslam.geometry.algebra import solve
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.surfaces.features import END_WEIGHT, Features
from impslam.surfaces.zero_pages import zero_pages
from impslam.types import Array, Ints

CELL = 0.05  # m: surfels of one wall are in neighbouring cells
RADIUS = 8  # cells: a point finds a surfel up to 0.4 m away
MIN_NORMAL_COSINE = 0.6
"""53 degrees: normals farther apart belong to two surfaces. The weight falls to 0 there: at a corner, the
mean normal of a surfel is between those of both walls, and would hold a robot that passes in place."""
MIN_AVERAGE_COSINE = 0.3  # 73 degrees: normals of one cell farther apart are of two surfaces
MAX_POINTS = 20.0  # over which a surfel averages
MAX_BEYOND_END = 0.05
"""m along a surface from a surfel at its end, beyond which points say nothing about the pose: the error of
the normal there is multiplied by that distance, and would pull back a robot that sees more of a wall."""
LONE_WEIGHT, MIXED_WEIGHT = 0.2, 0.1
"""Weights of a point if neither it nor its surfel is on a surface, or only one of them."""
_X, _Y, _NX, _NY, _COUNT, _WEIGHT, _X0, _Y0 = range(8)
_INSIDE, _INLIERS, _SQUARES, _WEIGHTS = range(4)
_BITS = 24  # of a cell's value, for the surfel
_LAST = 2**_BITS - 1  # largest number of a surfel


class SurfaceMap(NamedTuple):
    """Surfels and the grid that finds them; memory is only used around surfels.

    Attributes
    ----------
    cells : (h, w) int32, the nearest surfel and its closeness, see `surfel_of` and `closeness_of`; 0 if
        none is within `RADIUS`. One number holds both, so that a look-up reads memory once, and the larger
        of two is that of the nearer surfel, or of the older one at the same distance.
    surfels : (n, 8) x, y of the mean point, normal, number of points, weight of the normal, and its
        first point
    size : (1,) number of surfels
    corner : (2,) m, the lower left corner of the grid
    """

    cells: np.ndarray[tuple[int, ...], np.dtype[np.int32]]
    surfels: Array
    size: Ints
    corner: Array


class Alignment(NamedTuple):
    """Settings for aligning a scan.

    Attributes
    ----------
    iterations : maximum number of linearisations
    wide, narrow : m, scale of the robust kernel at the start and at the end
    information : 1/m^2, of the distance of one point
    step : every step-th feature is used
    slack2 : squared Mahalanobis distance from the prior beyond which its weight falls (Cauchy); inf: never
    """

    iterations: int
    wide: float
    narrow: float
    information: float
    step: int
    slack2: float


class FitSums(NamedTuple):
    """Information about a pose from the points of a scan, in units of one point.

    Attributes
    ----------
    H, g : (3, 3), (3,) of the normal equations
    sums : (4,) points on the grid; the sum of their inlier weights, by Geman and McClure; over the
        points on surfaces, the weighted sum of squared distances, m^2, and that of the weights
    """

    H: Array
    g: Array
    sums: Array


@kernel
def no_evidence() -> FitSums:
    """Return zero evidence, to be filled in place."""
    return FitSums(np.zeros((3, 3)), np.zeros(3), np.zeros(4))


def empty_surface_map(width: float, height: float, surfels: int) -> SurfaceMap:
    """Return a map of width x height m around the origin, with room for this number of surfels."""
    shape = math.ceil(height / CELL), math.ceil(width / CELL)
    return SurfaceMap(
        zero_pages(shape, np.int32),
        zero_pages((min(surfels, _LAST + 1), 8), np.float64),
        np.zeros(1, np.int64),
        np.array([-0.5 * width, -0.5 * height]),
    )


@kernel
def surfel_of(cell: int) -> int:
    """Return the index of the surfel nearest to a cell with this value, -1 if there is none."""
    return _LAST - (cell & _LAST) if cell > 0 else -1


@kernel
def closeness_of(cell: int) -> int:
    """Return `RADIUS**2 + 1` minus the squared distance to that surfel, in cells; 0 if there is none."""
    return cell >> _BITS


@kernel
def surfel_at(surface_map: SurfaceMap, x: float, y: float) -> int:
    """Return the index of the surfel nearest to a point, -1 if none is within `RADIUS`."""
    height, width = surface_map.cells.shape
    u, v = (x - surface_map.corner[0]) / CELL, (y - surface_map.corner[1]) / CELL
    if not (0.0 <= u < width and 0.0 <= v < height):  # also if the point is not finite
        return -1
    return surfel_of(surface_map.cells[int(v), int(u)])


@kernel
def clear(surface_map: SurfaceMap, corner: Array) -> None:
    """Remove all surfels, and move the grid's corner (2,) m."""
    height, width = surface_map.cells.shape
    one_by_one = surface_map.size[0] * (2 * RADIUS + 1) ** 2 < height * width
    if not one_by_one:
        surface_map.cells[:] = 0
    for k in range(surface_map.size[0] if one_by_one else 0):
        column = int((surface_map.surfels[k, _X0] - surface_map.corner[0]) / CELL)
        row = int((surface_map.surfels[k, _Y0] - surface_map.corner[1]) / CELL)
        left, right = max(0, column - RADIUS), min(width, column + RADIUS + 1)
        for r in range(max(0, row - RADIUS), min(height, row + RADIUS + 1)):
            surface_map.cells[r, left:right] = 0
    surface_map.size[0] = 0
    surface_map.corner[:] = corner


@kernel
def add(surface_map: SurfaceMap, features: Features, pose: Array, max_points: float) -> None:
    """Add the features of a scan taken at pose (3,) in the map's frame.

    A surfel averages over at most `max_points` points, so that it adapts to changes. Features outside the
    grid are left out.
    """
    height, width = surface_map.cells.shape
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for i in range(len(features)):
        x = pose[0] + c * features[i, 0] - s * features[i, 1]
        y = pose[1] + s * features[i, 0] + c * features[i, 1]
        u, v = (x - surface_map.corner[0]) / CELL, (y - surface_map.corner[1]) / CELL
        inside = min(u, v) >= RADIUS + 1 and u < width - RADIUS - 1 and v < height - RADIUS - 1
        if not inside:  # also if the pose is not finite
            continue
        column, row = int(u), int(v)
        nx = c * features[i, 2] - s * features[i, 3]
        ny = s * features[i, 2] + c * features[i, 3]
        weight = float(features[i, 4])
        cell = surface_map.cells[row, column]
        if closeness_of(cell) == RADIUS * RADIUS + 1:
            _average(
                surface_map.surfels[surfel_of(cell)],
                x,
                y,
                nx,
                ny,
                weight,
                max_points,
            )
        elif surface_map.size[0] < len(surface_map.surfels):
            surfel = surface_map.surfels[surface_map.size[0]]
            surfel[_X], surfel[_Y], surfel[_NX], surfel[_NY] = x, y, nx, ny
            surfel[_COUNT], surfel[_WEIGHT], surfel[_X0], surfel[_Y0] = 1.0, weight, x, y
            _claim_cells(surface_map, row, column)
            surface_map.size[0] += 1


def _claims() -> np.ndarray[tuple[int, ...], np.dtype[np.int32]]:
    """Return the values (17, 17) of the cells around surfel `_LAST`; negative beyond `RADIUS`."""
    offsets = np.arange(-RADIUS, RADIUS + 1)
    closeness = RADIUS**2 + 1 - offsets[:, None] ** 2 - offsets**2
    return np.where(closeness > 0, closeness << _BITS, -(_LAST + 1)).astype(np.int32)


_CLAIMS = _claims()


@kernel
def _claim_cells(surface_map: SurfaceMap, row: int, column: int) -> None:
    """Make the next surfel the nearest one of the cells around it without a nearer one."""
    surfel = _LAST - surface_map.size[0]
    for r in range(2 * RADIUS + 1):
        cells, claims = surface_map.cells[row + r - RADIUS, column - RADIUS :], _CLAIMS[r]
        for c in range(2 * RADIUS + 1):
            cells[c] = max(cells[c], claims[c] + surfel)


@kernel
def _average(
    surfel: Array, x: float, y: float, nx: float, ny: float, weight: float, max_points: float
) -> None:
    """Average one more point into its surfel; the other side of a thin wall is another surface."""
    if weight > 0.0 and surfel[_WEIGHT] == 0.0:
        surfel[_NX], surfel[_NY], surfel[_WEIGHT] = nx, ny, weight
    elif weight > 0.0:
        if surfel[_NX] * nx + surfel[_NY] * ny < MIN_AVERAGE_COSINE:
            return
        a = surfel[_NX] * surfel[_COUNT] + nx * weight
        b = surfel[_NY] * surfel[_COUNT] + ny * weight
        length = math.sqrt(a * a + b * b)
        surfel[_NX], surfel[_NY] = a / length, b / length
        surfel[_WEIGHT] = max(surfel[_WEIGHT], weight)
    elif surfel[_WEIGHT] > 0.0:
        return
    surfel[_COUNT] = min(surfel[_COUNT] + 1.0, max_points)
    surfel[_X] += (x - surfel[_X]) / surfel[_COUNT]
    surfel[_Y] += (y - surfel[_Y]) / surfel[_COUNT]


@kernel
def normal_equations(
    surface_map: SurfaceMap, features: Features, pose: Array, scale: float, step: int, out: FitSums
) -> None:
    """Fill `out` with the evidence of every `step`-th feature for a pose (3,), with kernel `scale` m."""
    height, width = surface_map.cells.shape
    c, s = math.cos(pose[2]), math.sin(pose[2])
    min_cell = _min_cell(scale)
    # Sums in tuples stay in registers; in arrays, every point would wait for the previous one.
    sums = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    left, low = pose[0] - surface_map.corner[0], pose[1] - surface_map.corner[1]
    per_cell, per_scale2 = 1.0 / CELL, 1.0 / scale**2
    inside = inliers = squares = weights = 0.0
    for i in range(0, len(features), step):
        rx = c * features[i, 0] - s * features[i, 1]
        ry = s * features[i, 0] + c * features[i, 1]
        u, v = (left + rx) * per_cell, (low + ry) * per_cell
        if not (0.0 <= u < width and 0.0 <= v < height):  # also if the pose is not finite
            continue
        inside += 1.0
        cell = surface_map.cells[int(v), int(u)]
        if cell < min_cell:
            continue
        surfel, weight = surface_map.surfels[surfel_of(cell)], float(features[i, 4])
        ex, ey = pose[0] + rx - surfel[_X], pose[1] + ry - surfel[_Y]
        if surfel[_WEIGHT] > 0.0 and weight > 0.0:
            nx, ny = surfel[_NX], surfel[_NY]
            cosine = c * (features[i, 2] * nx + features[i, 3] * ny)
            cosine += s * (features[i, 2] * ny - features[i, 3] * nx)
            if cosine < MIN_NORMAL_COSINE:
                continue
            e = nx * ex + ny * ey
            share = 1.0 / (1.0 + e * e * per_scale2)
            w = surfel[_WEIGHT] * weight * (share * _agreement(cosine)) ** 2
            if surfel[_WEIGHT] == 1.0 or abs(nx * ey - ny * ex) < MAX_BEYOND_END:
                sums = _add_row(sums, nx, ny, ny * rx - nx * ry, e, w)
            squares, weights = squares + share * share * e * e, weights + share * share
        else:
            nx = c * features[i, 2] - s * features[i, 3]
            ny = s * features[i, 2] + c * features[i, 3]
            sums, share = _add_lone(sums, (rx, ry, nx, ny, weight), surfel, ex, ey, scale)
        inliers += share
    _store(out, sums, (inside, inliers, squares, weights))


@kernel
def _agreement(cosine: float) -> float:
    """Return how far two normals agree: 1 if they are the same, 0 at `MIN_NORMAL_COSINE`."""
    return (cosine - MIN_NORMAL_COSINE) / (1.0 - MIN_NORMAL_COSINE)


@kernel
def _min_cell(scale: float) -> int:
    """Return the least value of a cell whose surfel is within 3 `scale` m, or two cells."""
    radius = min(float(RADIUS), max(3.0 * scale / CELL, 2.0))
    return math.ceil(RADIUS * RADIUS + 1 - radius * radius) << _BITS


_Sums: TypeAlias = tuple[float, float, float, float, float, float, float, float, float]
"""The upper triangle of H, row by row, and g."""


@kernel
def _add_row(sums: _Sums, nx: float, ny: float, lever: float, e: float, w: float) -> _Sums:
    """Return the sums plus the row (nx, ny, lever), of residual e m and weight w."""
    xx, xy, xt, yy, yt, tt, gx, gy, gt = sums
    wx, wy, wt = w * nx, w * ny, w * lever
    xx, xy, xt = xx + wx * nx, xy + wx * ny, xt + wx * lever
    yy, yt, tt = yy + wy * ny, yt + wy * lever, tt + wt * lever
    return xx, xy, xt, yy, yt, tt, gx + wx * e, gy + wy * e, gt + wt * e


@kernel
def _add_lone(
    sums: _Sums,
    point: tuple[float, float, float, float, float],
    surfel: Array,
    ex: float,
    ey: float,
    scale: float,
) -> tuple[_Sums, float]:
    """Return the sums plus a point, of which it or its surfel is on no surface, and its inlier weight.

    `point` is its position and normal in the directions of the map, and the weight of that normal. If one
    of the two is on a surface, or on a wall seen obliquely, only the distance across it counts: the other
    is anywhere along it, and the visible end of the wall moves with the robot. At its end, both count.
    """
    rx, ry, nx, ny, weight = point
    if weight == END_WEIGHT:
        nx = ny = 0.0
    if nx == 0.0 and ny == 0.0 and surfel[_WEIGHT] != END_WEIGHT:
        nx, ny = surfel[_NX], surfel[_NY]
    w = LONE_WEIGHT if surfel[_WEIGHT] == weight else MIXED_WEIGHT
    if nx != 0.0 or ny != 0.0:
        e = nx * ex + ny * ey
        share = 1.0 / (1.0 + (e / scale) ** 2)
        return _add_row(sums, nx, ny, ny * rx - nx * ry, e, w * share * share), share
    share = 1.0 / (1.0 + (ex * ex + ey * ey) / (scale * scale))
    w *= share * share
    return _add_row(_add_row(sums, 1.0, 0.0, -ry, ex, w), 0.0, 1.0, rx, ey, w), share


@kernel
def _store(out: FitSums, sums: _Sums, counts: tuple[float, float, float, float]) -> None:
    """Fill `out` with the sums, and its own `sums` with the counts."""
    H, g, n = out.H, out.g, out.sums
    n[_INSIDE], n[_INLIERS], n[_SQUARES], n[_WEIGHTS] = counts
    H[0, 0], H[0, 1], H[0, 2], H[1, 1], H[1, 2], H[2, 2], g[0], g[1], g[2] = sums
    H[1, 0], H[2, 0], H[2, 1] = H[0, 1], H[0, 2], H[1, 2]


@kernel
def align(
    surface_map: SurfaceMap,
    features: Features,
    pose: Array,
    prior: Array,
    settings: Alignment,
    out: FitSums,
) -> float:
    """Move pose (3,) in place to the best fit of the features to the map; return the inlier share.

    `prior` (3,) is the information of the initial pose, 1/m^2, 1/m^2 and 1/rad^2; see `Alignment.slack2`.
    `out` becomes the evidence of the scan alone at the pose before the last step.
    """
    start, g, A = pose.copy(), np.empty(3), np.empty((3, 3))
    for i in range(settings.iterations):
        narrowing = min(1.0, i / (0.5 * settings.iterations))
        scale = settings.wide * (settings.narrow / settings.wide) ** narrowing
        normal_equations(surface_map, features, pose, scale, settings.step, out)
        ex, ey = pose[0] - start[0], pose[1] - start[1]
        et = wrap_in_kernel(pose[2] - start[2])
        chi2 = prior[0] * ex * ex + prior[1] * ey * ey + prior[2] * et * et
        w = 1.0 / (1.0 + chi2 / settings.slack2)
        for a in range(3):
            g[a] = settings.information * out.g[a]
            for b in range(3):
                A[a, b] = settings.information * out.H[a, b]
            A[a, a] += w * prior[a]
        g[0] += w * prior[0] * ex
        g[1] += w * prior[1] * ey
        g[2] += w * prior[2] * et
        if not solve(A, g):
            g[:] = 0.0
        for a in range(3):
            pose[a] -= g[a]
        if abs(g[0]) + abs(g[1]) < 2e-4 and abs(g[2]) < 1e-4 and scale == settings.narrow:
            break
    pose[2] = wrap_in_kernel(pose[2])
    return float(out.sums[_INLIERS] / max(out.sums[_INSIDE], 1.0))
