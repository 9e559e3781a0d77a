"""Circles through range measurements, of unknown or known radius, with their covariance.

A circle is [x, y, radius], perturbed by addition. As for lines, noise of beam i moves its point
along the beam, hence off the circle by sigma_i times the cosine of incidence, and each point's
normal is that at the intersection of the beam with the *estimated* circle. The fit is by Gauss-Newton, from
`circle_start`. The direction of the centre may be measured, too, by a ray through it ("axis").
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from impslam.errors import ShapeError
from impslam.geometry.algebra import invert_into
from impslam.geometry.circle_start import circle_start
from impslam.geometry.kernels import kernel

Array = npt.NDArray[np.float64]

_ITERATIONS = 25
_CONVERGED = 1e-7  # m: each step is at most half the last, so that less than a micrometre remains
_GRAZING2 = 0.01  # cosine^2 at 84 deg: beyond, a beam's width matters more than its range noise
_MAX_RADIUS = 1e3  # m: a larger circle is a line
_NO_AXIS = np.empty((0, 5))


@dataclass(frozen=True, slots=True, eq=False)
class CircleFit:
    """A circle with its covariance.

    Attributes
    ----------
    centre, radius : (2,) m and m
    covariance : (3, 3) of [x, y, radius] from the beams' independent noise; zero for a known radius
    bias_jacobian : (3,), change of [x, y, radius] per metre that all ranges are too long
    chi2 : sum of squared residuals in units of their standard deviations
    """

    centre: Array
    radius: float
    covariance: Array
    bias_jacobian: Array
    chi2: float


@kernel
def _row(circle: Array, point: Array, beam: Array, variance: float, row: Array) -> float:
    """Write normal (2), residual and cosine of incidence of a point to `row`; return its variance."""
    dx, dy = point[0] - circle[0], point[1] - circle[1]
    distance = max(math.sqrt(dx * dx + dy * dy), 1e-12)
    off = distance - circle[2]
    cosine = (dx * beam[0] + dy * beam[1]) / distance
    slide = -off * cosine / (cosine * cosine + _GRAZING2)
    # No farther than a quarter radius: a bad start must not throw points across the circle.
    slide = min(max(slide, -0.25 * circle[2]), 0.25 * circle[2])
    qx, qy = dx + slide * beam[0], dy + slide * beam[1]
    length = max(math.sqrt(qx * qx + qy * qy), 1e-12)
    row[0], row[1], row[2] = qx / length, qy / length, off
    row[3] = row[0] * beam[0] + row[1] * beam[1]
    off_variance: float = variance * (row[3] * row[3] + _GRAZING2)
    return off_variance


@kernel
def _axis_row(circle: Array, axis: Array, row: Array) -> float:
    """Write the row of a ray [origin, direction, sigma] through the centre; return its variance."""
    vx, vy = circle[0] - axis[0], circle[1] - axis[1]
    row[0], row[1], row[2], row[3] = axis[3], -axis[2], axis[2] * vy - axis[3] * vx, 0.0
    variance: float = axis[4] * axis[4]
    return variance


@kernel
def _normal_equations(
    circle: Array,
    points: Array,
    beams: Array,
    variances: Array,
    axis: Array,
    info: Array,
    sums: Array,
) -> float:
    """Write information (3, 3), right-hand sides (2, 3) of step and bias; return chi2."""
    row = np.empty(4)
    chi2 = xx = xy = yy = xr = yr = rr = 0.0
    sums[:] = 0.0
    for i in range(len(points) + len(axis)):
        by_radius = 1.0 if i < len(points) else 0.0
        if i < len(points):
            variance = _row(circle, points[i], beams[i], variances[i], row)
        else:
            variance = _axis_row(circle, axis[i - len(points)], row)
        hx, hy, off, cosine, w = row[0], row[1], row[2], row[3], 1.0 / variance
        chi2 += w * off * off
        xx += w * hx * hx
        xy += w * hx * hy
        yy += w * hy * hy
        xr += w * hx * by_radius
        yr += w * hy * by_radius
        rr += w * by_radius
        sums[0, 0] += w * hx * off
        sums[0, 1] += w * hy * off
        sums[0, 2] += w * off * by_radius
        sums[1, 0] += w * hx * cosine
        sums[1, 1] += w * hy * cosine
        sums[1, 2] += w * cosine
    info[0, 0], info[0, 1], info[0, 2] = xx, xy, xr
    info[1, 0], info[1, 1], info[1, 2] = xy, yy, yr
    info[2, 0], info[2, 1], info[2, 2] = xr, yr, rr
    return chi2


@kernel
def _inverse(info: Array, known: bool, out: Array) -> bool:
    """Write the covariance; return whether it exists."""
    if known:
        info[0, 2] = info[1, 2] = info[2, 0] = info[2, 1] = 0.0
        info[2, 2] = 1.0
    if not invert_into(info, (info[0, 0], info[1, 1], info[2, 2]), out):
        return False
    if known:
        out[2, 2] = 0.0
    return True


@kernel
def _multiply(matrix: Array, vector: Array) -> Array:
    """Return matrix (3, 3) times vector (3,); BLAS is slower, and imports scipy.linalg."""
    out = np.empty(3)
    for a in range(3):
        out[a] = matrix[a, 0] * vector[0] + matrix[a, 1] * vector[1] + matrix[a, 2] * vector[2]
    return out


@kernel
def covariance_at(
    circle: Array, points: Array, beams: Array, variances: Array, axis: Array, known: bool
) -> tuple[bool, Array, Array, float]:
    """Return success, covariance, bias Jacobian and chi2 of a fit if `circle` were its result.

    The arguments are those of `fit_circle_core`.
    """
    info, sums, covariance = np.empty((3, 3)), np.empty((2, 3)), np.zeros((3, 3))
    chi2 = _normal_equations(circle, points, beams, variances, axis, info, sums)
    good = _inverse(info, known, covariance)
    return good, covariance, _multiply(covariance, sums[1]), chi2


@kernel
def fit_circle_core(
    points: Array, beams: Array, variances: Array, axis: Array, start: Array, known: bool
) -> tuple[bool, Array, Array, Array, float]:
    """Fit from a start [x, y, radius]; return success, circle, covariance, bias Jacobian, chi2.

    Parameters
    ----------
    points, beams : (n, 2) m, and unit vectors of the beams' directions
    variances : (n,) m^2, of the range noise
    axis : (0 or 1, 5) origin, unit direction and sigma (m, across) of a ray through the centre
    known : the radius is that of the start
    """
    circle = start.copy()
    info, sums, covariance = np.empty((3, 3)), np.empty((2, 3)), np.zeros((3, 3))
    bias = np.zeros(3)
    step_length = math.inf
    for _ in range(_ITERATIONS):
        if not (circle[2] > 0.0 and circle[2] < _MAX_RADIUS):
            return False, circle, covariance, bias, math.nan
        _normal_equations(circle, points, beams, variances, axis, info, sums)
        if not _inverse(info, known, covariance):
            return False, circle, covariance, bias, math.nan
        step = _multiply(covariance, sums[0])
        step_length = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        circle += step * min(1.0, circle[2] / max(step_length, 1e-300))
        if step_length < _CONVERGED:
            break
    good, covariance, bias, chi2 = covariance_at(circle, points, beams, variances, axis, known)
    return good and step_length < 1e-4, circle, covariance, bias, chi2


def fit_circle(
    points: Array, directions: Array, sigmas: Array, radius: float | None = None
) -> CircleFit:
    """Fit the circle, seen from outside, to points whose noise lies along their beams.

    Parameters
    ----------
    points : (n, 2) m, n >= 3 (2 if the radius is known)
    directions : (n,) rad, of the beams, in the frame of the points
    sigmas : (n,) m > 0, standard deviation of the ranges
    radius : m, if it is known

    Raises
    ------
    ShapeError
        If the shapes do not match, or the points define no circle (points on a line).
    """
    n = len(points)
    min_points = 3 if radius is None else 2
    if points.shape != (n, 2) or directions.shape != (n,) or sigmas.shape != (n,) or n < min_points:
        raise ShapeError(
            f"points {points.shape}, directions {directions.shape}, sigmas {sigmas.shape}; "
            f"expected (n, 2), (n,), (n,) with n >= {min_points}"
        )
    beams = np.column_stack((np.cos(directions), np.sin(directions)))
    start = circle_start(points, beams, math.nan if radius is None else radius)
    good, circle, covariance, bias, chi2 = fit_circle_core(
        points, beams, sigmas**2, _NO_AXIS, start, radius is not None
    )
    if not good:
        raise ShapeError("the points define no circle; give points on an arc, not on a line")
    return CircleFit(circle[:2], float(circle[2]), covariance, bias, chi2)
