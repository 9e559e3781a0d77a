"""The straight pieces of a scan: split, merge and fit, compiled."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from impslam.extractors.segmentation import Cloud
from impslam.geometry.kernels import kernel
from impslam.geometry.lines import fit_line_core
from impslam.types import Array, Ints

_CORNER = 4.5  # standard deviations off the chord: 1 of 500 straight segments of 300 points
_OUTLIER = 3.5  # standard deviations: 1 of 2000 Gaussian residuals is beyond
_BEND_GAIN = 25.0  # chi-square of three parameters (two lines for one, and where): p = 1.5e-5
_BEND_FLAT = 3.0  # a bend that stands out less than this many `flatness` is the wall's own shape
_COLLINEAR = 13.8  # chi-square of two degrees of freedom at 99.9 %
_THROUGH = 0.05  # m: a beam this far beyond a wall (and its noise) went through an opening
_MIN_PIECE = 4  # points: two make a line, two more tell that it is one
_MANY = 20  # points from which on the outermost, perhaps half on what is behind, are not needed
_AHEAD = 6  # pieces to look past for the other side of something in front of a wall
_LINE = 8  # columns of a fit: rho, alpha, rr, ra, aa, bias r, bias a, chi2


@dataclass(frozen=True, slots=True, eq=False)
class Segments:
    """Straight pieces in beam order.

    Attributes
    ----------
    lines : (k, 8) rho, alpha, covariance rr, ra, aa, bias Jacobian r, a, chi2; in base_link
    end_points : (k, 2, 2) m, first and last point along increasing beam, on the line
    counts, lengths, reduced_chi2 : (k,) beams, m, chi2 per degree of freedom
    label : (m,) the piece each point of the cloud supports, or -1
    index : (m,) beam of each point of the cloud
    """

    lines: Array
    end_points: Array
    counts: Ints
    lengths: Array
    reduced_chi2: Array
    label: Ints
    index: Ints

    def beams(self, k: int) -> Ints:
        """Return the beams on piece k, in order."""
        beams: Ints = self.index[self.label == k]
        return beams


def find_segments(cloud: Cloud, flatness: float, gap: float) -> Segments:
    """Return all straight pieces of at least four points.

    Parameters
    ----------
    cloud : the scan's points, cut where the surface ends
    flatness : m, standard deviation of a wall from a straight line
    gap : m, widest hidden stretch across which collinear pieces are one
    """
    lines, ends, counts, label = _find(
        cloud.points, cloud.beams, cloud.variances, cloud.starts, flatness, gap
    )
    lengths = np.hypot(ends[:, 1, 0] - ends[:, 0, 0], ends[:, 1, 1] - ends[:, 0, 1])
    reduced = lines[:, 7] / np.maximum(counts - 2, 1)
    return Segments(lines, ends, counts, lengths, reduced, label, cloud.index)


@kernel
def _farthest(
    points: Array, beams: Array, variances: Array, flat2: float, i: int, j: int
) -> tuple[int, float]:
    """Return the point of [i, j) farthest off the chord, and by how many standard deviations."""
    cx, cy = points[j - 1, 0] - points[i, 0], points[j - 1, 1] - points[i, 1]
    length = math.hypot(cx, cy)
    if length == 0.0:
        return i, 0.0
    tx, ty = cx / length, cy / length
    best, where = 0.0, i
    for k in range(i + 1, j - 1):
        off = abs(tx * (points[k, 1] - points[i, 1]) - ty * (points[k, 0] - points[i, 0]))
        if off > best:
            best, where = off, k
    along = (
        tx * (points[where, 0] - points[i, 0]) + ty * (points[where, 1] - points[i, 1])
    ) / length
    variance = _across(beams, variances, flat2, where, tx, ty)
    variance += (1.0 - along) ** 2 * _across(beams, variances, flat2, i, tx, ty)
    variance += along**2 * _across(beams, variances, flat2, j - 1, tx, ty)
    return where, best / math.sqrt(variance)


@kernel
def _across(beams: Array, variances: Array, flat2: float, k: int, tx: float, ty: float) -> float:
    """Return the variance of a point across a line along (tx, ty)."""
    cosine = tx * beams[k, 1] - ty * beams[k, 0]
    variance: float = variances[k] * (cosine * cosine + 1e-6) + flat2
    return variance


@kernel
def _misfit(sums: Array, a: int, b: int) -> float:
    """Return the squared residuals of the regression line through points [a, b)."""
    w = sums[b, 0] - sums[a, 0]
    x = (sums[b, 1] - sums[a, 1]) / w
    y = (sums[b, 2] - sums[a, 2]) / w
    xx = sums[b, 3] - sums[a, 3] - w * x * x
    xy = sums[b, 4] - sums[a, 4] - w * x * y
    yy = sums[b, 5] - sums[a, 5] - w * y * y
    misfit: float = yy - xy * xy / xx if xx > 0.0 else yy
    return misfit


@kernel
def _sums(points: Array, beams: Array, variances: Array, flat2: float, i: int, j: int) -> Array:
    """Return running sums of w, x, y, xx, xy, yy in the frame of the chord of [i, j)."""
    cx, cy = points[j - 1, 0] - points[i, 0], points[j - 1, 1] - points[i, 1]
    length = max(math.hypot(cx, cy), 1e-9)
    tx, ty = cx / length, cy / length
    sums = np.zeros((j - i + 1, 6))
    for k in range(i, j):
        dx, dy = points[k, 0] - points[i, 0], points[k, 1] - points[i, 1]
        x, y = tx * dx + ty * dy, tx * dy - ty * dx
        w = 1.0 / _across(beams, variances, flat2, k, tx, ty)
        at = k - i
        sums[at + 1, 0] = sums[at, 0] + w
        sums[at + 1, 1] = sums[at, 1] + w * x
        sums[at + 1, 2] = sums[at, 2] + w * y
        sums[at + 1, 3] = sums[at, 3] + w * x * x
        sums[at + 1, 4] = sums[at, 4] + w * x * y
        sums[at + 1, 5] = sums[at, 5] + w * y * y
    return sums


@kernel
def _bend(
    points: Array, beams: Array, variances: Array, flat2: float, i: int, j: int
) -> tuple[int, float, float]:
    """Return where [i, j) is best taken as two lines, the gain in chi2, and the gain per point."""
    sums = _sums(points, beams, variances, flat2, i, j)
    n = j - i
    one = _misfit(sums, 0, n)
    best, where = one, 0
    for k in range(_MIN_PIECE, n - _MIN_PIECE + 1):
        two = _misfit(sums, 0, k) + _misfit(sums, k, n)
        if two < best:
            best, where = two, k
    # Mean square that the second line takes away, in m^2: the square of the bend's height.
    return i + where, one - best, (one - best) / max(sums[n, 0], 1e-300)


@kernel
def _split_at(points: Array, beams: Array, variances: Array, flat2: float, i: int, j: int) -> int:
    """Return where to split [i, j), or i if it is straight."""
    where, off = _farthest(points, beams, variances, flat2, i, j)
    if off > _CORNER:
        return where
    if j - i >= 2 * _MIN_PIECE:
        where, gain, height2 = _bend(points, beams, variances, flat2, i, j)
        # A hat of height h has the mean square h^2 / 12 about its best line.
        if gain > _BEND_GAIN and 12.0 * height2 > _BEND_FLAT * _BEND_FLAT * flat2:
            return where
    return i


@kernel
def _split(points: Array, beams: Array, variances: Array, starts: Ints, flat2: float) -> Ints:
    """Return the straight pieces of all segments: (p, 3) first and past-the-last point, segment."""
    n = len(points)
    pieces = np.empty((n, 3), np.int64)
    stack = np.empty((n + 1, 2), np.int64)
    count = 0
    for s in range(len(starts) - 1):
        stack[0, 0], stack[0, 1] = starts[s], starts[s + 1]
        top = 1
        while top > 0:
            top -= 1
            i, j = stack[top, 0], stack[top, 1]
            if j - i < _MIN_PIECE:
                continue
            k = _split_at(points, beams, variances, flat2, i, j)
            if k == i:
                pieces[count, 0], pieces[count, 1], pieces[count, 2] = i, j, s
                count += 1
            else:  # the first part is handled first, so that pieces come out in order
                stack[top, 0], stack[top, 1] = k, j
                stack[top + 1, 0], stack[top + 1, 1] = i, k
                top += 2
    return pieces[:count]


@kernel
def _fit(
    points: Array,
    beams: Array,
    variances: Array,
    flat2: float,
    label: Ints,
    piece: int,
    out: Array,
) -> None:
    """Fit the points labelled `piece`, unlabel its outliers and fit again; write the fit to out."""
    for attempt in range(3):
        which = np.flatnonzero(label == piece)
        if len(which) < 3:
            out[:] = math.nan
            return
        if len(which) >= _MANY:
            which = which[1:-1]
        fit = fit_line_core(points[which], beams[which], variances[which], math.sqrt(flat2))
        for c in range(_LINE):
            out[c] = fit[c]
        if attempt == 2 or not _unlabel(points, beams, variances, flat2, label, which, out):
            return


@kernel
def _unlabel(
    points: Array,
    beams: Array,
    variances: Array,
    flat2: float,
    label: Ints,
    which: Ints,
    line: Array,
) -> bool:
    """Take the label off points that are not on the line; tell if there were any."""
    found = False
    for k in which:
        if _off(points, beams, variances, flat2, k, line) > _OUTLIER**2:
            label[k] = -1
            found = True
    return found


@kernel
def _about(line: Array, x: float, y: float, flat2: float, length: float) -> Array:
    """Return rho, rr, ra, aa of a line about (x, y), the wall's own shape included."""
    arm = math.cos(line[1]) * y - math.sin(line[1]) * x
    rho = line[0] - math.cos(line[1]) * x - math.sin(line[1]) * y
    ra = line[3] - arm * line[4]
    rr = line[2] - 2.0 * arm * line[3] + arm * arm * line[4]
    return np.array([rho, rr + flat2, ra, line[4] + 4.0 * flat2 / (length * length)])


@kernel
def _collinear(points: Array, one: Array, two: Array, ends: Ints, flat2: float) -> bool:
    """Tell whether two pieces are on one line, by their covariances at the middle of the gap.

    `ends` are the first and last points of both pieces.
    """
    turn = two[1] - one[1]
    flip = 1.0 if math.cos(turn) > 0.0 else -1.0
    turn = math.asin(flip * math.sin(turn))
    if abs(turn) > 0.35:
        return False
    p, q = points[ends[1]], points[ends[2]]
    x, y = 0.5 * (p[0] + q[0]), 0.5 * (p[1] + q[1])
    first = math.hypot(p[0] - points[ends[0], 0], p[1] - points[ends[0], 1])
    second = math.hypot(q[0] - points[ends[3], 0], q[1] - points[ends[3], 1])
    a = _about(one, x, y, flat2, max(first, 1e-3))
    b = _about(two, x, y, flat2, max(second, 1e-3))
    shift = flip * b[0] - a[0]
    rr, ra, aa = a[1] + b[1], a[2] + flip * b[2], a[3] + b[3]
    d2 = (aa * shift * shift - 2.0 * ra * shift * turn + rr * turn * turn) / (rr * aa - ra * ra)
    return bool(d2 < _COLLINEAR)


@kernel
def _open_between(
    points: Array, beams: Array, variances: Array, line: Array, i: int, j: int
) -> bool:
    """Tell whether a beam of the points (i, j) went through the line."""
    nx, ny = math.cos(line[1]), math.sin(line[1])
    for k in range(i + 1, j):
        beyond = nx * points[k, 0] + ny * points[k, 1] - line[0]
        if nx * beams[k, 0] + ny * beams[k, 1] < 0.0:
            beyond = -beyond
        if beyond > _THROUGH + _OUTLIER * math.sqrt(variances[k]):
            return True
    return False


@kernel
def _off(points: Array, beams: Array, variances: Array, flat2: float, k: int, line: Array) -> float:
    """Return the squared distance of a point from a line, in its variances."""
    nx, ny = math.cos(line[1]), math.sin(line[1])
    off = line[0] - nx * points[k, 0] - ny * points[k, 1]
    off2: float = off * off / _across(beams, variances, flat2, k, -ny, nx)
    return off2


@kernel
def _share_corners(
    points: Array,
    beams: Array,
    variances: Array,
    flat2: float,
    pieces: Ints,
    lines: Array,
    label: Ints,
) -> None:
    """Give the points where two pieces meet to the line that they are nearer to; fit again.

    Pieces of one segment, that is: column 2 of `pieces` is its number.
    """
    for a in range(len(pieces) - 1):
        b, cut = a + 1, pieces[a, 1]
        # Fragments too short for a piece are shared too.
        if pieces[b, 2] != pieces[a, 2] or pieces[b, 0] - cut >= _MIN_PIECE:
            continue
        first, last = pieces[a, 0] + _MIN_PIECE, pieces[b, 1] - _MIN_PIECE
        one, two = lines[a], lines[b]
        while cut > first and _nearer(points, beams, variances, flat2, cut - 1, two, one):
            cut -= 1
        while cut < last and _nearer(points, beams, variances, flat2, cut, one, two):
            cut += 1
        if cut != pieces[a, 1] or cut != pieces[b, 0]:
            pieces[a, 1] = pieces[b, 0] = cut
            label[pieces[a, 0] : cut], label[cut : pieces[b, 1]] = a, b
            _fit(points, beams, variances, flat2, label, a, one)
            _fit(points, beams, variances, flat2, label, b, two)


@kernel
def _nearer(
    points: Array, beams: Array, variances: Array, flat2: float, k: int, one: Array, two: Array
) -> bool:
    """Tell whether a point is nearer to line one than to line two, in its variances."""
    to_one = _off(points, beams, variances, flat2, k, one)
    return to_one < _off(points, beams, variances, flat2, k, two)


@kernel
def _merge(
    points: Array, beams: Array, variances: Array, flat2: float, pieces: Ints, gap: float
) -> tuple[Array, Ints]:
    """Fit the pieces and merge collinear ones; return the fits (NaN if gone) and the labels."""
    p = len(pieces)
    lines = np.full((p, _LINE), np.nan)
    label = np.full(len(points), -1, np.int64)
    for a in range(p):
        label[pieces[a, 0] : pieces[a, 1]] = a
        _fit(points, beams, variances, flat2, label, a, lines[a])
    _share_corners(points, beams, variances, flat2, pieces, lines, label)
    ends = np.empty(4, np.int64)
    for a in range(p):
        for b in range(a + 1, min(p, a + 1 + _AHEAD)):
            if not (lines[a, 0] == lines[a, 0] and lines[b, 0] == lines[b, 0]):
                continue
            ends[0], ends[1], ends[2], ends[3] = (
                pieces[a, 0],
                pieces[a, 1] - 1,
                pieces[b, 0],
                pieces[b, 1] - 1,
            )
            p1, p2 = points[ends[1]], points[ends[2]]
            if (
                math.hypot(p2[0] - p1[0], p2[1] - p1[1]) <= gap
                and _collinear(points, lines[a], lines[b], ends, flat2)
                and not _open_between(points, beams, variances, lines[a], ends[1], ends[2])
            ):
                for k in range(pieces[b, 0], pieces[b, 1]):
                    if label[k] == b:
                        label[k] = a
                lines[b] = np.nan
                pieces[a, 1] = pieces[b, 1]
                _fit(points, beams, variances, flat2, label, a, lines[a])
    return lines, label


@kernel
def _find(
    points: Array, beams: Array, variances: Array, starts: Ints, flatness: float, gap: float
) -> tuple[Array, Array, Ints, Ints]:
    """Split, merge and fit; return lines, end points, counts and labels of what is left."""
    flat2 = flatness * flatness
    pieces = _split(points, beams, variances, starts, flat2)
    fits, label = _merge(points, beams, variances, flat2, pieces, gap)
    keep = np.flatnonzero(fits[:, 0] == fits[:, 0])
    lines, counts = fits[keep], np.zeros(len(keep), np.int64)
    ends = np.empty((len(keep), 2, 2))
    new = np.full(len(fits) + 1, -1, np.int64)
    new[keep] = np.arange(len(keep))
    for k in range(len(points)):
        piece = new[label[k]]
        label[k] = piece
        if piece < 0:
            continue
        nx, ny = math.cos(lines[piece, 1]), math.sin(lines[piece, 1])
        off = lines[piece, 0] - nx * points[k, 0] - ny * points[k, 1]
        side = 0 if counts[piece] == 0 else 1
        ends[piece, side, 0] = points[k, 0] + off * nx
        ends[piece, side, 1] = points[k, 1] + off * ny
        counts[piece] += 1
    return lines, ends, counts, label
