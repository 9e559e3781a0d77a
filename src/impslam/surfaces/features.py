"""Compute features: points of a scan with the normals of their surfaces."""

from __future__ import annotations

import math
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from impslam.errors import ShapeError
from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints, Mask, Scan, check_shape

Features: TypeAlias = np.ndarray[Any, np.dtype[np.float32]]
"""(n, 5) x, y in m; the unit normal on the lidar's side; and the weight of that normal.

The weight is 1 on a surface, `END_WEIGHT` at its end, where no other feature of it follows, and 0 without a
surface: the normal is then 0, that of a wall that is seen obliquely, or that of a piece too short for one.
Rows are in beam order.

A single point counts as on such a wall if the next two beams on one side end nearer, and the line through
all three points is oblique and straight. Beams beside a table leg go past it.
"""

END_WEIGHT = 0.5
NORMAL_RADIUS = 0.25
"""m on either side for fitting a normal: long compared with the noise of a beam, 1 to 3 cm."""
MAX_NEIGHBOURS = 8
"""Nearest neighbours used on either side. If they are on one plane, about as many up to `NORMAL_RADIUS` are
used, too: at 1.5 m, 8 beams 0.35 deg apart cover 7 cm, and noise of 1 cm would turn the normal by 4 deg."""
MAX_NORMAL_SIGMA, MAX_END_SIGMA = 0.15, 0.075
"""rad, 1 sigma: larger errors of the normal, and at the end of a surface, leave it without weight. Along a
corridor, the squares of these errors look like information. A few beams between two lost ones, at the edge
of the view, could hold the robot in place."""
NORMAL_NOISE = 0.005, 0.03
"""m, limits of the noise of a range for those errors: few lidars have less, and one with more would have no
normals."""
MIN_GAP, GAP_BEAMS = 0.12, 6.0  # m, and beam spacings: neighbours farther apart are on two surfaces
MAX_GAP = 0.8  # m: upper bound of that distance
MAX_LOST = 2
"""Lost beams between neighbours that may be farther apart than `MIN_GAP`: if 30 % are lost at random, 3 in
a row are lost at 3 % of the points; through an open door, many are."""
OBLIQUE_BEAMS = 2.0  # beam spacings between neighbours on a wall that is seen at 30 degrees
MIN_STRAIGHT = 0.9
"""cosine between lines of three points on it: 26 degrees, 2 cm of noise over 5 cm."""
MIN_INCIDENCE = 0.12  # cosine of incidence (83 degrees): below, the beam's width smears the range
FLATNESS, ROUGHNESS = 0.05, 4e-4
"""Limit of the scatter across a surface: share of that along it, plus (2 cm)^2."""
NOISE_ROUGHNESS, NOISE_GAP = 2.0, 4.0
"""If the range noise is larger: that limit in variances, which 1 % of surfaces exceed with 8 neighbours on
either side, and the minimum gap in standard deviations."""
NOISE_SAMPLES, MIN_NOISE_SAMPLES = 128, 16
"""Triples of beams for estimating the noise, and the least number in one half of the ranges."""
NOISE_GROWTH = 6.6
"""Over the root of the number of triples in one half, the relative increase of the variance from the nearer
to the farther half that is no chance: two standard deviations of a ratio of squared medians."""
MIN_NOISE_COSINE = 0.3  # of their incidence: at more than 73 degrees, curvature looks like noise


class Sampling(NamedTuple):
    """How a scan is sampled, and its features.

    Attributes
    ----------
    spacing : rad between neighbouring beams
    thin : m between features on a surface
    smooth : whether a point on a surface is moved along its normal to the line through its neighbours, as
        far as they scatter by noise only: 17 beams determine a wall to a quarter of the noise of one. The
        errors of neighbouring features are then correlated
    """

    spacing: float
    thin: float
    smooth: bool


class _Limits(NamedTuple):
    """Limits for the points of a scan.

    Attributes
    ----------
    spacing, thin : see `Sampling`
    noise : variance of a range, m^2, and its increase with the squared range, 1
    """

    spacing: float
    thin: float
    noise: tuple[float, float]


def features(scan: Scan, thin: float, *, smooth: bool = True) -> Features:
    """Return the features of a scan in base_link; see `Sampling` for `thin` and `smooth`."""
    out = np.empty((len(scan.ranges), 5), np.float32)
    sampling = Sampling(beam_spacing(scan.angles), thin, smooth)
    count = find_features(scan.points, scan.valid, scan.ranges, scan.origins, sampling, out)
    return out[:count].copy()


def check_rows(features: Features, starts: Ints, scans: int) -> None:
    """Raise `ShapeError` unless `starts` splits the rows of the features into scans."""
    check_shape("features", features, None, 5)
    check_shape("starts", starts, scans + 1)
    if starts[0] < 0 or starts[-1] > len(features) or (np.diff(starts) < 0).any():
        raise ShapeError(f"starts do not rise from 0 to {len(features)}, the rows of features")


def beam_spacing(angles: Array) -> float:
    """Return the mean angle between neighbouring beams, rad; 0 of fewer than two."""
    if len(angles) < 2:
        return 0.0
    return abs(float(angles[-1] - angles[0])) / (len(angles) - 1)


@kernel
def find_features(
    points: Array,
    valid: Mask,
    ranges: Array,
    origins: Array,
    sampling: Sampling,
    out: Features,
) -> int:
    """Fill `out` (n, 5) with the features of n beams; return their number.

    points, origins (n, 2) are each beam's end and start, in one frame.
    """
    spacing, thin = sampling.spacing, sampling.thin
    beams = np.flatnonzero(valid)
    points, ranges, origins = points[beams], ranges[beams], origins[beams]
    limits = _Limits(spacing, thin, _noise(points, ranges, origins, spacing))
    connected = _connected(points, beams, ranges, limits)
    count, last, due, near = 0, -1, 0, 0.0
    for i in range(len(points)):
        x, y = points[i, 0], points[i, 1]
        if beams[i] < due and math.hypot(points[last, 0] - x, points[last, 1] - y) < near:
            continue
        nx, ny, weight, off = _normal(points, connected, ranges, origins, limits, i)
        dx, dy = origins[i, 0] - x, origins[i, 1] - y
        skipped = _skipped_beams(math.hypot(dx, dy), nx * dx + ny * dy, spacing, thin)
        last, due, near = i, beams[i] + skipped, thin + _gap(ranges[i], limits)
        if skipped == 0:
            due, near = len(valid), thin
        if sampling.smooth:
            x, y = x + off * nx, y + off * ny
        out[count, 0], out[count, 1] = x, y
        out[count, 2], out[count, 3], out[count, 4] = nx, ny, weight
        count += 1
    return count


@kernel
def _skipped_beams(distance: float, across: float, spacing: float, thin: float) -> int:
    """Return after how many beams a surface is hit `thin` m further along; 0 if unknown.

    `distance` is that of the last point kept, and `across` its part along the normal there, m. Whether a
    point is kept must not depend on its own noise: of many beams on a wall, the first that was measured far
    enough from the last point has noise away from it. That is a longer range on one side of the wall's
    nearest point, and a shorter one on the other: with 1 cm of noise, walls were turned by 0.4 deg.
    """
    if not (spacing > 0.0 and across > MIN_INCIDENCE * distance):
        return 0
    return max(math.ceil(thin * across / (distance * distance * spacing)), 1)


@kernel
def _single(
    points: Array, ranges: Array, origins: Array, spacing: float, i: int
) -> tuple[float, float, float]:
    """Return the normal and weight of a point without neighbours; see `Features`."""
    x, y = points[i, 0], points[i, 1]
    nx = ny = nearest = 0.0
    for step in (-1, 1):
        j, k = i + step, i + 2 * step
        if min(j, k) < 0 or max(j, k) >= len(ranges):
            continue
        dx, dy = points[j, 0] - x, points[j, 1] - y
        distance = math.hypot(dx, dy)
        if ranges[j] >= ranges[i] or distance <= OBLIQUE_BEAMS * ranges[j] * spacing:
            continue
        ex, ey = points[k, 0] - points[j, 0], points[k, 1] - points[j, 1]
        straight = dx * ex + dy * ey > MIN_STRAIGHT * distance * math.hypot(ex, ey)
        if straight and not 0.0 < nearest < distance:
            nx, ny, nearest = -dy / distance, dx / distance, distance
    if nx * (origins[i, 0] - x) + ny * (origins[i, 1] - y) < 0.0:
        nx, ny = -nx, -ny
    return nx, ny, 0.0


@kernel
def _noise(points: Array, ranges: Array, origins: Array, spacing: float) -> tuple[float, float]:
    """Return the variance of the ranges of a scan, m^2, and its increase with the squared range.

    The error of a range is that of a point, along its beam, from the line through its two neighbours; with
    the same noise, they add half of its variance. The medians of the nearer and the farther half of the
    points tell how it increases: by time of flight, hardly; by triangulation, as in depth cameras, it does.
    """
    step = max(1, len(points) // NOISE_SAMPLES)
    off, at, count = np.empty(len(points) // step + 1), np.empty(len(points) // step + 1), 0
    for i in range(1, len(points) - 1, step):
        ux, uy = points[i + 1, 0] - points[i - 1, 0], points[i + 1, 1] - points[i - 1, 1]
        dx, dy = points[i, 0] - origins[i, 0], points[i, 1] - origins[i, 1]
        chord = math.sqrt(ux * ux + uy * uy)
        cosine = abs(dx * uy - dy * ux) / max(ranges[i] * chord, 1e-12)
        if chord > max(2.0 * MIN_GAP, GAP_BEAMS * ranges[i] * spacing) or cosine < MIN_NOISE_COSINE:
            continue
        ex, ey = points[i, 0] - points[i - 1, 0], points[i, 1] - points[i - 1, 1]
        off[count], at[count] = abs(ex * uy - ey * ux) / (chord * cosine), ranges[i]
        count += 1
    if count < MIN_NOISE_SAMPLES:
        return 0.0, 0.0
    off, at = off[:count], at[:count]
    near = at < np.median(at)
    if near.sum() >= MIN_NOISE_SAMPLES:
        first, second = _variance_of(off[near]), _variance_of(off[~near])
        if second > first * (1.0 + NOISE_GROWTH / math.sqrt(near.sum())):
            low, high = float((at[near] ** 2).mean()), float((at[~near] ** 2).mean())
            # The variance at the lidar is 0 or more.
            growth = min((second - first) / (high - low), first / low)
            return first - growth * low, growth
    return _variance_of(off), 0.0


@kernel
def _variance_of(off: Array) -> float:
    """Return the variance of a range by the distances of points from lines through neighbours."""
    return float(np.median(off) ** 2 / (0.6745**2 * 1.5))


@kernel
def _variance_at(distance: float, limits: _Limits) -> float:
    """Return the variance of a range, m^2."""
    return limits.noise[0] + limits.noise[1] * distance * distance


@kernel
def _gap(distance: float, limits: _Limits) -> float:
    """Return the minimum distance of two surfaces at a range, m."""
    return max(MIN_GAP, NOISE_GAP * math.sqrt(_variance_at(distance, limits)))


@kernel
def _normal(
    points: Array,
    connected: Mask,
    ranges: Array,
    origins: Array,
    limits: _Limits,
    i: int,
) -> tuple[float, float, float, float]:
    """Return the normal at point i, its weight, and how far along it the surface is, m.

    The normal is the minor axis of the scatter of its neighbours; the surface goes through their mean. The
    noise of the point remains in the distance if the scatter is more than noise.
    """
    spacing, variance = limits.spacing, _variance_at(ranges[i], limits)
    stride = max(1, int(NORMAL_RADIUS / (MAX_NEIGHBOURS * max(ranges[i] * spacing, 1e-3))))
    for reach in (stride, 1):
        n, at_end, mx, my, xx, xy, yy = _scatter(points, connected, reach, limits.thin, i)
        if n < 3.0:
            nx, ny, weight = _single(points, ranges, origins, spacing, i)
            return nx, ny, weight, 0.0
        mean, difference = 0.5 * (xx + yy), 0.5 * (xx - yy)
        half = math.sqrt(difference * difference + xy * xy)
        roughness = max(ROUGHNESS, NOISE_ROUGHNESS * variance)
        flat = mean - half < FLATNESS * (mean + half) + roughness
        if flat:  # else the surface may end near by
            break
    x, y = points[i, 0], points[i, 1]
    if not flat or half == 0.0:
        return 0.0, 0.0, 0.0, 0.0
    # The eigenvector of the smaller eigenvalue; of its two forms, the one that does not cancel.
    nx, ny = (-xy, half + difference) if difference > 0.0 else (difference - half, xy)
    length = math.sqrt(nx * nx + ny * ny)
    nx, ny = nx / length, ny / length
    towards = (nx * (origins[i, 0] - x) + ny * (origins[i, 1] - y)) / ranges[i]
    if towards < 0.0:
        nx, ny, towards = -nx, -ny, -towards
    max_sigma = MAX_END_SIGMA if at_end else MAX_NORMAL_SIGMA
    spread = n * 2.0 * half  # the noise adds to both eigenvalues
    bounded = min(max(variance, NORMAL_NOISE[0] ** 2), NORMAL_NOISE[1] ** 2)
    is_known = bounded < max_sigma * max_sigma * spread
    if towards <= MIN_INCIDENCE or not is_known:
        return nx, ny, 0.0, 0.0
    noise = min(variance / max(mean - half, 1e-12), 1.0)  # its share of the scatter
    return nx, ny, END_WEIGHT if at_end else 1.0, noise * (nx * mx + ny * my)


@kernel
def _connected(points: Array, beams: Ints, ranges: Array, limits: _Limits) -> Mask:
    """Return (n,) whether each point and the next one are on one surface.

    `beams` (n,) are the numbers of their beams: some in between may be lost.
    """
    out = np.zeros(len(points), np.bool_)
    for i in range(len(points) - 1):
        j = i + 1
        gap = _gap(min(ranges[i], ranges[j]), limits)
        if beams[j] - beams[i] <= MAX_LOST + 1:
            gap = max(gap, min(GAP_BEAMS * min(ranges[i], ranges[j]) * limits.spacing, MAX_GAP))
        dx, dy = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
        out[i] = dx * dx + dy * dy <= gap * gap
    return out


@kernel
def _scatter(
    points: Array, connected: Mask, stride: int, thin: float, i: int
) -> tuple[float, int, float, float, float, float, float]:
    """Return the scatter of point i and its neighbours on the same surface.

    Beyond the nearest ones, only every `stride`-th counts.

    The values are the number of points, that of sides on which the surface ends within `thin` m, the mean
    x, y from point i, and the variances xx, xy, yy.
    `connected` (n,) is whether a point and the next one are on one surface.
    """
    x, y = points[i, 0], points[i, 1]
    n, at_end = 1.0, 0
    sx = sy = xx = xy = yy = 0.0
    for step in (-1, 1):
        first = min(i, i + step)  # of the pair of neighbours
        length2 = 0.0  # m^2, of the surface on this side, squared
        for k in range(MAX_NEIGHBOURS * stride):
            pair, j = first + step * k, i + step * (k + 1)
            if pair < 0 or not connected[pair]:
                at_end += length2 <= thin * thin
                break
            if k >= MAX_NEIGHBOURS and k % stride:
                continue
            dx, dy = points[j, 0] - x, points[j, 1] - y
            length2 = dx * dx + dy * dy
            if k > 0 and length2 > NORMAL_RADIUS * NORMAL_RADIUS:
                break
            n, sx, sy = n + 1.0, sx + dx, sy + dy
            xx, xy, yy = xx + dx * dx, xy + dx * dy, yy + dy * dy
    mx, my = sx / n, sy / n
    return n, at_end, mx, my, xx / n - mx * mx, xy / n - mx * my, yy / n - my * my


@kernel
def leave_out_oblique(rows: Features) -> int:
    """Move the features (n, 5) to the front, except those of walls seen obliquely; return their number.

    The visible ends of such walls move with the robot; without odometry nothing outweighs that in a
    corridor.
    """
    count = 0
    for i in range(len(rows)):
        if rows[i, 4] > 0.0 or (rows[i, 2] == 0.0 and rows[i, 3] == 0.0):
            rows[count] = rows[i]
            count += 1
    return count
