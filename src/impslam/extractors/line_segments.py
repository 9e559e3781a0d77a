"""Find the straight pieces of a scan: split, merge and fit (compiled)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.extractors.line_splitting import MIN_PIECE, split, variance_across
from impslam.extractors.segmentation import SegmentedScan
from impslam.geometry.chi_square import GATE_2D
from impslam.geometry.kernels import kernel
from impslam.geometry.lines import fit_line_core
from impslam.types import Array, Ints

OUTLIER = 3.5  # standard deviations: exceeded by 1 of 2000 Gaussian residuals
_PASS_THROUGH = 0.05  # m: a beam this far beyond a wall, plus noise, passed through an opening
_TRIM_FROM = 20
"""points; from this number on, the outermost, perhaps mixed with the background, are dropped."""
_LOOK_AHEAD = 6  # pieces to search for the continuation of a wall behind an obstacle
_COLUMNS = 8  # columns of a fit: rho, alpha, rr, ra, aa, bias r, bias a, chi2


class Segments(NamedTuple):
    """Straight pieces in beam order.

    Attributes
    ----------
    lines : (k, 8) rho, alpha, covariance rr, ra, aa, bias Jacobian r, a, chi2; in base_link
    end_points : (k, 2, 2) m, first and last point along increasing beam, on the line
    counts, lengths, reduced_chi2 : (k,) beams, m, chi2 per degree of freedom
    label : (m,) the piece each point of the cloud supports, or -1
    indices : (m,) beam of each point of the cloud
    """

    lines: Array
    end_points: Array
    counts: Ints
    lengths: Array
    reduced_chi2: Array
    label: Ints
    indices: Ints

    def beams(self, k: int) -> Ints:
        """Return the beams on piece k, in order."""
        beams: Ints = self.indices[self.label == k]
        return beams


def find_segments(cloud: SegmentedScan, flatness: float, gap: float) -> Segments:
    """Return all straight pieces of at least four points.

    Parameters
    ----------
    cloud : the scan's points, cut where the surface ends
    flatness : m, standard deviation of a wall from a straight line
    gap : m, widest occlusion across which collinear pieces are one
    """
    found = _find(cloud.points, cloud.beams, cloud.variances, cloud.starts, flatness, gap)
    return Segments(*found, cloud.index)


@kernel
def _fit(
    points: Array,
    beams: Array,
    variances: Array,
    flat2: float,
    label: Ints,
    piece: tuple[int, int, int],
    out: Array,
) -> None:
    """Fit the points with the label of a piece, unlabel its outliers and fit again.

    `piece` is its label, its first point and the one past its last. Writes the fit to `out`.
    """
    number, first, last = piece
    for attempt in range(3):
        which = first + np.flatnonzero(label[first:last] == number)
        if len(which) < 3:
            out[:] = math.nan
            return
        if len(which) >= _TRIM_FROM:
            which = which[1:-1]
        fit = fit_line_core(points[which], beams[which], variances[which], math.sqrt(flat2))
        for c in range(_COLUMNS):
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
    """Remove the label of points that are not on the line; return whether there were any."""
    removed, nx, ny = False, math.cos(line[1]), math.sin(line[1])
    for k in which:
        distance = line[0] - nx * points[k, 0] - ny * points[k, 1]
        if distance * distance > OUTLIER**2 * variance_across(beams, variances, flat2, k, -ny, nx):
            label[k] = -1
            removed = True
    return removed


@kernel
def _line_at(line: Array, x: float, y: float, flat2: float, length: float) -> Array:
    """Return rho, rr, ra, aa of a line about (x, y), including the wall's own shape."""
    arm = math.cos(line[1]) * y - math.sin(line[1]) * x
    rho = line[0] - math.cos(line[1]) * x - math.sin(line[1]) * y
    ra = line[3] - arm * line[4]
    rr = line[2] - 2.0 * arm * line[3] + arm * arm * line[4]
    return np.array([rho, rr + flat2, ra, line[4] + 4.0 * flat2 / (length * length)])


@kernel
def _collinear(points: Array, one: Array, two: Array, ends: Ints, flat2: float) -> bool:
    """Return whether two pieces are on one line, by their covariances at the middle of the gap.

    `ends` are the first and last points of both pieces.
    """
    turn = two[1] - one[1]
    sign = 1.0 if math.cos(turn) > 0.0 else -1.0
    turn = math.asin(sign * math.sin(turn))
    if abs(turn) > 0.35:
        return False
    p, q = points[ends[1]], points[ends[2]]
    x, y = 0.5 * (p[0] + q[0]), 0.5 * (p[1] + q[1])
    first = math.hypot(p[0] - points[ends[0], 0], p[1] - points[ends[0], 1])
    second = math.hypot(q[0] - points[ends[3], 0], q[1] - points[ends[3], 1])
    a = _line_at(one, x, y, flat2, max(first, 1e-3))
    b = _line_at(two, x, y, flat2, max(second, 1e-3))
    shift = sign * b[0] - a[0]
    rr, ra, aa = a[1] + b[1], a[2] + sign * b[2], a[3] + b[3]
    d2 = (aa * shift * shift - 2.0 * ra * shift * turn + rr * turn * turn) / (rr * aa - ra * ra)
    return bool(d2 < GATE_2D)


@kernel
def _open_between(
    points: Array, beams: Array, variances: Array, line: Array, i: int, j: int
) -> bool:
    """Return whether a beam of the points (i, j) passed through the line."""
    nx, ny = math.cos(line[1]), math.sin(line[1])
    for k in range(i + 1, j):
        beyond = nx * points[k, 0] + ny * points[k, 1] - line[0]
        if nx * beams[k, 0] + ny * beams[k, 1] < 0.0:
            beyond = -beyond
        if beyond > _PASS_THROUGH + OUTLIER * math.sqrt(variances[k]):
            return True
    return False


@kernel
def _squared_error(
    points: Array, beams: Array, variances: Array, flat2: float, k: int, line: Array
) -> float:
    """Return the squared distance of a point from a line, divided by its variance."""
    nx, ny = math.cos(line[1]), math.sin(line[1])
    distance = line[0] - nx * points[k, 0] - ny * points[k, 1]
    off2: float = distance * distance / variance_across(beams, variances, flat2, k, -ny, nx)
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
    """Assign the points between two adjacent pieces to the nearer line; fit again.

    Only for pieces of the same segment, whose number is column 2 of `pieces`.
    """
    for a in range(len(pieces) - 1):
        b, cut = a + 1, pieces[a, 1]
        # Fragments too short for a piece are shared, too.
        if pieces[b, 2] != pieces[a, 2] or pieces[b, 0] - cut >= MIN_PIECE:
            continue
        first, last = pieces[a, 0] + MIN_PIECE, pieces[b, 1] - MIN_PIECE
        one, two = lines[a], lines[b]
        while cut > first and _nearer(points, beams, variances, flat2, cut - 1, two, one):
            cut -= 1
        while cut < last and _nearer(points, beams, variances, flat2, cut, one, two):
            cut += 1
        if cut != pieces[a, 1] or cut != pieces[b, 0]:
            pieces[a, 1] = pieces[b, 0] = cut
            label[pieces[a, 0] : cut], label[cut : pieces[b, 1]] = a, b
            _fit(points, beams, variances, flat2, label, (a, pieces[a, 0], cut), one)
            _fit(points, beams, variances, flat2, label, (b, cut, pieces[b, 1]), two)


@kernel
def _nearer(
    points: Array, beams: Array, variances: Array, flat2: float, k: int, one: Array, two: Array
) -> bool:
    """Return whether a point is nearer to line one than to line two, relative to its variance."""
    to_one = _squared_error(points, beams, variances, flat2, k, one)
    return to_one < _squared_error(points, beams, variances, flat2, k, two)


@kernel
def _merge(
    points: Array, beams: Array, variances: Array, flat2: float, pieces: Ints, gap: float
) -> tuple[Array, Ints]:
    """Fit the pieces and merge collinear ones; return the fits (NaN if merged) and the labels."""
    p = len(pieces)
    lines = np.full((p, _COLUMNS), np.nan)
    label = np.full(len(points), -1, np.int64)
    for a in range(p):
        label[pieces[a, 0] : pieces[a, 1]] = a
        _fit(points, beams, variances, flat2, label, (a, pieces[a, 0], pieces[a, 1]), lines[a])
    _share_corners(points, beams, variances, flat2, pieces, lines, label)
    ends = np.empty(4, np.int64)
    for a in range(p):
        for b in range(a + 1, min(p, a + 1 + _LOOK_AHEAD)):
            if not (lines[a, 0] == lines[a, 0] and lines[b, 0] == lines[b, 0]):
                continue
            ends[0], ends[1] = pieces[a, 0], pieces[a, 1] - 1
            ends[2], ends[3] = pieces[b, 0], pieces[b, 1] - 1
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
                piece = a, pieces[a, 0], pieces[a, 1]
                _fit(points, beams, variances, flat2, label, piece, lines[a])
    return lines, label


@kernel
def _find(
    points: Array, beams: Array, variances: Array, starts: Ints, flatness: float, gap: float
) -> tuple[Array, Array, Ints, Array, Array, Ints]:
    """Split, merge and fit; return the fields of `Segments` up to the labels."""
    flat2 = flatness * flatness
    pieces = split(points, beams, variances, starts, flat2)
    fits, label = _merge(points, beams, variances, flat2, pieces, gap)
    keep = np.flatnonzero(fits[:, 0] == fits[:, 0])
    lines, counts = fits[keep], np.zeros(len(keep), np.int64)
    ends = np.empty((len(keep), 2, 2))
    new = np.full(len(fits) + 1, -1, np.int64)
    new[keep] = np.arange(len(keep))
    normals_x, normals_y = np.cos(lines[:, 1]), np.sin(lines[:, 1])
    for k in range(len(points)):
        piece = new[label[k]]
        label[k] = piece
        if piece < 0:
            continue
        nx, ny = normals_x[piece], normals_y[piece]
        distance = lines[piece, 0] - nx * points[k, 0] - ny * points[k, 1]
        side = 0 if counts[piece] == 0 else 1
        ends[piece, side, 0] = points[k, 0] + distance * nx
        ends[piece, side, 1] = points[k, 1] + distance * ny
        counts[piece] += 1
    lengths, reduced_chi2 = np.empty(len(keep)), np.empty(len(keep))
    for k in range(len(keep)):
        lengths[k] = math.hypot(ends[k, 1, 0] - ends[k, 0, 0], ends[k, 1, 1] - ends[k, 0, 1])
        reduced_chi2[k] = lines[k, 7] / max(counts[k] - 2, 1)
    return lines, ends, counts, lengths, reduced_chi2, label
