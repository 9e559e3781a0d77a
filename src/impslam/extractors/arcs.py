"""Find the complete visible arcs of cylinders in a scan (compiled)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.extractors.line_segments import OUTLIER
from impslam.geometry.circle_start import circle_start
from impslam.geometry.circles import covariance_at, fit_circle_core
from impslam.geometry.kernels import kernel
from impslam.geometry.lines import fit_line_core
from impslam.types import Array, Ints, Mask

_MAX_UNSEEN = 0.3  # share of the half-width that may be missing at a side
_MAX_FITS = 3  # the last two drop end points that are partly on the background
_LINE_GAIN = 16.0  # chi-square by which a circle of any radius must beat a line: 4 sigma
_CORNER_GAIN = 9.0  # chi-square by which a corner (one more parameter) beats a circle: 3 sigma
_EDGE_SIGMA = 0.5  # of the beam spacing: an edge is anywhere between a hit and the next miss
_FADE_SIGMA = 0.1  # of the radius: beams that hit a round side beyond 64 deg may not return

COLUMNS = 12  # first, past the last, x, y, radius, covariance (3), bias (3), reduced chi2


class ArcLimits(NamedTuple):
    """What counts as a cylinder.

    Attributes
    ----------
    radius : m, if it is known, else NaN
    smallest, largest : m, limits of the radius
    min_points : minimum number of points
    max_chi2 : largest mean chi-square
    max_sigma : largest standard deviation of the radius, relative to it
    spacing : rad between beams
    """

    radius: float
    smallest: float
    largest: float
    min_points: int
    max_chi2: float
    max_sigma: float
    spacing: float


@kernel
def find_arcs(
    points: Array,
    beams: Array,
    variances: Array,
    starts: Ints,
    sides: Array,
    limits: ArcLimits,
    origins: Array,
) -> Array:
    """Return a row for each segment that is the whole visible side of a cylinder.

    Parameters
    ----------
    points, beams, variances, starts : as in `Cloud`
    sides : (m, 2, 3) direction and range of the beams before and after each point; the range is inf
        without a return, and 0 at the end of the scan
    origins : (m, 2) m, laser as each beam was fired
    """
    out = np.empty((len(starts), COLUMNS))
    count = 0
    for s in range(len(starts) - 1):
        i, j = starts[s], starts[s + 1]
        origin = origins[(i + j) // 2]
        if j - i < limits.min_points or not _is_plausible(points[i:j], sides[i:j], limits, origin):
            continue
        p, b, v, n = points[i:j], beams[i:j], variances[i:j], sides[i:j]
        if _fit_arc(p, b, v, n, limits, origin, out[count]):
            out[count, :2] += i
            count += 1
    return out[:count]


@kernel
def _is_plausible(points: Array, sides: Array, limits: ArcLimits, origin: Array) -> bool:
    """Return whether a segment is in front of its neighbours, and of a cylinder's width."""
    first = math.hypot(points[0, 0] - origin[0], points[0, 1] - origin[1])
    last = math.hypot(points[-1, 0] - origin[0], points[-1, 1] - origin[1])
    if sides[0, 0, 2] <= first or sides[-1, 1, 2] <= last:
        return False
    width = math.hypot(points[-1, 0] - points[0, 0], points[-1, 1] - points[0, 1])
    step = limits.spacing * first
    wide: bool = (
        0.5 * limits.smallest < width + 2.0 * step and width < 2.0 * limits.largest + 4.0 * step
    )
    return wide


@kernel
def _edges(beams: Array, sides: Array) -> Array:
    """Return the directions (2, 2) halfway between the outermost hits and the misses beside them."""
    edges = np.empty((2, 2))
    for side in range(2):
        k = 0 if side == 0 else len(beams) - 1
        x, y = beams[k, 0] + sides[k, side, 0], beams[k, 1] + sides[k, side, 1]
        length = max(math.hypot(x, y), 1e-12)
        edges[side, 0], edges[side, 1] = x / length, y / length
    return edges


@kernel
def _misses(sides: Array) -> Array:
    """Return the directions (2, 2) of the beams beside a segment."""
    return np.stack((sides[0, 0, :2], sides[-1, 1, :2]))


@kernel
def _bisector(edges: Array) -> tuple[float, float, float]:
    """Return the direction halfway between two edges, and the cosine of half the angle between them."""
    x, y = edges[0, 0] + edges[1, 0], edges[0, 1] + edges[1, 1]
    length = max(math.hypot(x, y), 1e-12)
    return x / length, y / length, 0.5 * length


@kernel
def _axis(edges: Array, origin: Array, sigma: float) -> Array:
    """Return the ray (1, 5) halfway between two edges, each with a sigma across in m.

    The width is not used: beams that are partly on the background do not count as hits, and those at a
    shallow angle may not return, so that an arc is always narrower than its cylinder.
    """
    x, y, _ = _bisector(edges)
    return np.array([[origin[0], origin[1], x, y, sigma / math.sqrt(2.0)]])


@kernel
def _start(points: Array, beams: Array, limits: ArcLimits, distance: float) -> Array:
    """Return the start of the fit: the algebraic circle, or one as wide as the arc."""
    start = circle_start(points, beams, limits.radius)
    is_likely = 0.5 * limits.smallest < start[2] < 2.0 * limits.largest
    if math.isnan(limits.radius) and not is_likely:
        start = circle_start(points, beams, 0.5 * distance * limits.spacing * len(points))
    return start


@kernel
def _fit_arc(
    points: Array,
    beams: Array,
    variances: Array,
    sides: Array,
    limits: ArcLimits,
    origin: Array,
    out: Array,
) -> bool:
    """Fit a cylinder to a segment and write its row; return whether it is one."""
    known_radius = not math.isnan(limits.radius)
    if not known_radius and not fit_line_core(points, beams, variances, 0.0)[7] > _LINE_GAIN:
        return False
    middle = points[len(points) // 2]
    distance = math.hypot(middle[0] - origin[0], middle[1] - origin[1])
    enough, fit, i, j = _fit_without_ends(points, beams, variances, sides, limits, origin, distance)
    good, circle, _, _, chi2 = fit
    if not (good and enough):
        return False
    dof = j - i + 1 - (2 if known_radius else 3)
    if chi2 > limits.max_chi2 * dof:
        return False
    if not _is_round(points[i:j], beams[i:j], variances[i:j], circle, limits, origin):
        return False
    near = math.hypot(circle[0] - origin[0], circle[1] - origin[1]) - circle[2]
    apparent = _between(_misses(sides[i:j]), origin, near, limits.radius)
    axis = _axis(_edges(beams[i:j], sides[i:j]), origin, _edge_sigma(limits, distance, apparent[2]))
    good, cov, bias, _ = covariance_at(
        apparent, points[i:j], beams[i:j], variances[i:j], axis, known_radius
    )
    if not good or math.sqrt(cov[2, 2]) > limits.max_sigma * apparent[2]:
        return False
    out[0], out[1], out[2:5] = i, j, circle
    out[5], out[6], out[7] = cov[0, 0], cov[0, 1], cov[1, 1]
    out[8:11] = bias
    out[11] = chi2 / dof
    return True


@kernel
def _fit_without_ends(
    points: Array,
    beams: Array,
    variances: Array,
    sides: Array,
    limits: ArcLimits,
    origin: Array,
    distance: float,
) -> tuple[bool, tuple[bool, Array, Array, Array, float], int, int]:
    """Fit to a segment without outliers at its ends.

    Returns whether enough points are left, the fit of `fit_circle_core` to the points [i, j), i and j.
    """
    known_radius, circle = not math.isnan(limits.radius), _start(points, beams, limits, distance)
    edge = _edge_sigma(limits, distance, circle[2])
    i, j, enough = 0, len(points), True
    for _ in range(_MAX_FITS):
        if j - i < limits.min_points:
            enough = False
            break
        axis = _axis(_edges(beams[i:j], sides[i:j]), origin, edge)
        fit = fit_circle_core(points[i:j], beams[i:j], variances[i:j], axis, circle, known_radius)
        first, last, circle = i, j, fit[1]
        if not fit[0]:
            break
        i, j = _trimmed(points, beams, variances, circle, i, j)
        if i == first and j == last:
            break
    return enough, fit, first, last


@kernel
def _between(misses: Array, origin: Array, near: float, known: float) -> Array:
    """Return the circle between two misses that is `near` m away from the laser.

    Its direction and radius do not depend on the noise of ranges, so the covariance of the fit is that at
    this circle. At the fit itself, noise that makes an arc look more curved brings the centre nearer and
    makes it seem more accurate, and the weighted mean of many fits is too near. Beams are about as wide as
    their spacing (URG-04LX 10 of 6 mrad, LMS200 13 of 9 or 17 mrad) and no hits if a part passes by, so a
    cylinder extends beyond its outermost hits by half of both.
    """
    x, y, cosine = _bisector(misses)
    sine = math.sqrt(max(1.0 - cosine * cosine, 0.0))
    radius = near * sine / (1.0 - sine) if math.isnan(known) else known
    distance = near + radius
    return np.array([origin[0] + distance * x, origin[1] + distance * y, radius])


@kernel
def _edge_sigma(limits: ArcLimits, distance: float, radius: float) -> float:
    """Return the standard deviation of an edge across, m."""
    return math.hypot(_EDGE_SIGMA * limits.spacing * distance, _FADE_SIGMA * radius)


@kernel
def _trimmed(
    points: Array, beams: Array, variances: Array, circle: Array, i: int, j: int
) -> tuple[int, int]:
    """Return [i, j) without the outermost points if they are outliers."""
    a, b, last = i, j, j - 1
    if _squared_error(points[i], beams[i], variances[i], circle) > OUTLIER**2:
        a += 1
    if _squared_error(points[last], beams[last], variances[last], circle) > OUTLIER**2:
        b -= 1
    return a, b


@kernel
def _squared_error(point: Array, beam: Array, variance: float, circle: Array) -> float:
    """Return the squared distance of a point from the circle, divided by its variance."""
    dx, dy = point[0] - circle[0], point[1] - circle[1]
    distance = max(math.hypot(dx, dy), 1e-12)
    cosine = (dx * beam[0] + dy * beam[1]) / distance
    off: float = distance - circle[2]
    off2: float = off * off / (variance * (cosine * cosine + 0.01))
    return off2


@kernel
def _is_round(
    points: Array,
    beams: Array,
    variances: Array,
    circle: Array,
    limits: ArcLimits,
    origin: Array,
) -> bool:
    """Return whether a fit is a cylinder: size, complete arc, better than a line or a corner."""
    radius = circle[2]
    vx, vy = circle[0] - origin[0], circle[1] - origin[1]
    distance = math.hypot(vx, vy)
    if radius < limits.smallest or radius > limits.largest or distance <= 1.05 * radius:
        return False
    half = math.asin(radius / distance)
    slack = max(2.0 * limits.spacing, _MAX_UNSEEN * half)
    for k in (0, len(points) - 1):
        bearing = abs(vx * beams[k, 1] - vy * beams[k, 0]) / distance
        if bearing < math.sin(max(half - slack, 0.0)):
            return False
    # With a known radius, the right width is stronger evidence than the shape, which real surfaces
    # (glossy, narrower than a few beams' footprints) blur: a line may fit slightly better.
    known_radius = not math.isnan(limits.radius)
    gain = -_LINE_GAIN if known_radius else _LINE_GAIN
    chi2 = 0.0
    for k in range(len(points)):
        chi2 += _squared_error(points[k], beams[k], variances[k], circle)
    if not fit_line_core(points, beams, variances, 0.0)[7] > chi2 + gain:
        return False
    gain = _CORNER_GAIN + _LINE_GAIN if known_radius else _CORNER_GAIN
    return _corner_misfit(points, beams, variances) > chi2 - gain


@kernel
def _corner_misfit(points: Array, beams: Array, variances: Array) -> float:
    """Return the smallest chi2 of two lines through a segment, each with at least three points."""
    best, n = math.inf, len(points)
    for k in range(3, n - 2, max(1, n // 8)):
        left = fit_line_core(points[:k], beams[:k], variances[:k], 0.0)[7]
        right = fit_line_core(points[k:], beams[k:], variances[k:], 0.0)[7]
        best = min(best, left + right)
    return best


@kernel
def neighbours(index: Ints, directions: Array, ranges: Array, valid: Mask, closed: bool) -> Array:
    """Return the `sides` of `find_arcs`: measurements of the beams next to each point."""
    n = len(ranges)
    sides = np.empty((len(index), 2, 3))
    for k in range(len(index)):
        for side in range(2):
            beam = index[k] + (1 if side == 1 else -1)
            if closed:
                beam %= n
            if beam < 0 or beam >= n:
                sides[k, side, 0], sides[k, side, 1] = math.cos(directions[index[k]]), 0.0
                sides[k, side, 2] = 0.0
                continue
            sides[k, side, 0] = math.cos(directions[beam])
            sides[k, side, 1] = math.sin(directions[beam])
            sides[k, side, 2] = ranges[beam] if valid[beam] else math.inf
    return sides
