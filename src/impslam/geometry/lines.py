"""Lines through range measurements, with their covariance from the noise of the beams.

A line is {p : p . n(alpha) = rho} with n(alpha) = (cos alpha, sin alpha); its parameters [rho,
alpha] are perturbed by addition. Noise of beam i moves its point along the beam u_i by sigma_i, so
off the line by sigma_i |n . u_i| (Arras and Siegwart 1997; Pfister et al. 2003). The estimate is
the maximum-likelihood one of the ranges r_i = (rho - n . o_i) / (n . u_i): orthogonal least squares
with these weights, in which each point's lever arm is that of its *estimated* position on the line. With
the measured position, as in the papers, noise enters twice and turns the line towards the beams.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from impslam.errors import ShapeError
from impslam.geometry.angles import wrap
from impslam.geometry.kernels import kernel

Array = npt.NDArray[np.float64]

_GRAZING2 = 1e-6  # (1e-3 rad)^2: lower bound of the noise of a beam's direction
_ITERATIONS = 10  # Gauss-Newton converges quadratically; three are typical
_CONVERGED = 1e-7  # m + rad: the step after this one would be below 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class LineFit:
    """A line with its covariance.

    Attributes
    ----------
    rho, alpha : m >= 0 and rad in (-pi, pi], normal form about the frame's origin
    covariance : (2, 2) of [rho, alpha] from the beams' independent noise
    bias_jacobian : (2,), change of [rho, alpha] per metre that all ranges are too long
    chi2 : sum of squared residuals in units of their standard deviations, n - 2 degrees of freedom
    """

    rho: float
    alpha: float
    covariance: Array
    bias_jacobian: Array
    chi2: float


@kernel
def principal_direction(points: Array, variances: Array) -> tuple[float, float, float]:
    """Return the weighted mean (x, y) and the angle of the normal of the orthogonal line fit.

    Closed form: Arras and Siegwart 1997, Eq. 3.
    """
    total = mean_x = mean_y = 0.0
    for i in range(len(points)):
        w = 1.0 / variances[i]
        total += w
        mean_x += w * points[i, 0]
        mean_y += w * points[i, 1]
    mean_x /= total
    mean_y /= total
    xx = xy = yy = 0.0
    for i in range(len(points)):
        dx, dy = points[i, 0] - mean_x, points[i, 1] - mean_y
        xx += dx * dx / variances[i]
        xy += dx * dy / variances[i]
        yy += dy * dy / variances[i]
    return mean_x, mean_y, 0.5 * math.atan2(-2.0 * xy, yy - xx)


@kernel
def _step(
    points: Array, beams: Array, variances: Array, flat2: float, line: Array, out: Array
) -> None:
    """Write the Gauss-Newton step, the information and the bias sums of `line` to `out`.

    `line` is [x, y, rho, alpha], rho counted from (x, y). `out` becomes [step_rho, step_alpha,
    chi2, information rr, ra, aa, bias right-hand side r, a].
    """
    nx, ny = math.cos(line[3]), math.sin(line[3])
    chi2 = rr = ra = aa = g_r = g_a = b_r = b_a = 0.0
    for i in range(len(points)):
        dx, dy = points[i, 0] - line[0], points[i, 1] - line[1]
        cosine = nx * beams[i, 0] + ny * beams[i, 1]
        variance = variances[i] * (cosine * cosine + _GRAZING2) + flat2
        off = line[2] - (nx * dx + ny * dy)
        # The point slides along its beam to the line; `lever` is its position on the line.
        slide = off * variances[i] * cosine / variance
        lever = nx * dy - ny * dx + slide * (nx * beams[i, 1] - ny * beams[i, 0])
        w = 1.0 / variance
        chi2 += w * off * off
        rr += w
        ra -= w * lever
        aa += w * lever * lever
        g_r -= w * off
        g_a += w * off * lever
        b_r += w * cosine
        b_a -= w * cosine * lever
    det = rr * aa - ra * ra
    out[0] = (aa * g_r - ra * g_a) / det if det > 0.0 else math.nan
    out[1] = (rr * g_a - ra * g_r) / det if det > 0.0 else math.nan
    out[2], out[3], out[4], out[5], out[6], out[7] = chi2, rr, ra, aa, b_r, b_a


@kernel
def fit_line_core(
    points: Array, beams: Array, variances: Array, flatness: float
) -> tuple[float, float, float, float, float, float, float, float]:
    """Fit a line and return rho, alpha, their variances rr, ra, aa, bias r, a, and chi2.

    The sign of rho follows from alpha; all values are NaN if the points define no line.

    Parameters
    ----------
    points, beams : (n, 2) m, and unit vectors of the beams' directions
    variances : (n,) m^2, of the range noise
    flatness : m, standard deviation of each point's own deviation from a straight line
    """
    x, y, alpha = principal_direction(points, variances)
    line = np.array([x, y, 0.0, alpha])
    out = np.empty(8)
    flat2 = flatness * flatness
    for _ in range(_ITERATIONS):
        _step(points, beams, variances, flat2, line, out)
        line[2] += out[0]
        line[3] += out[1]
        if not abs(out[0]) + abs(out[1]) > _CONVERGED:
            break
    det = out[3] * out[5] - out[4] * out[4]
    if not det > 1e-9 * out[3] * out[5]:
        nan = math.nan
        return nan, nan, nan, nan, nan, nan, nan, nan
    rr, ra, aa = out[5] / det, -out[4] / det, out[3] / det
    b_r, b_a = rr * out[6] + ra * out[7], ra * out[6] + aa * out[7]
    # From rho about (x, y) to rho about the origin: rho + n . (x, y), whose slope is `arm`.
    nx, ny = math.cos(line[3]), math.sin(line[3])
    arm = nx * y - ny * x
    rho = line[2] + nx * x + ny * y
    rr += 2.0 * arm * ra + arm * arm * aa
    return rho, line[3], rr, ra + arm * aa, aa, b_r + arm * b_a, b_a, out[2]


def _check(points: Array, directions: Array, sigmas: Array) -> None:
    n = len(points)
    if points.shape != (n, 2) or directions.shape != (n,) or sigmas.shape != (n,) or n < 2:
        raise ShapeError(
            f"points {points.shape}, directions {directions.shape}, sigmas {sigmas.shape}; "
            "expected (n, 2), (n,), (n,) with n >= 2"
        )


def fit_line(points: Array, directions: Array, sigmas: Array, flatness: float = 0.0) -> LineFit:
    """Fit the maximum-likelihood line to points whose noise lies along their beams.

    Parameters
    ----------
    points : (n, 2) m
    directions : (n,) rad, of the beams, in the frame of the points
    sigmas : (n,) m > 0, standard deviation of the ranges
    flatness : m, standard deviation of each point's own deviation from a straight line

    Raises
    ------
    ShapeError
        If the shapes do not match, or the points define no line (all points coincide).
    """
    _check(points, directions, sigmas)
    beams = np.column_stack((np.cos(directions), np.sin(directions)))
    rho, alpha, rr, ra, aa, b_r, b_a, chi2 = fit_line_core(points, beams, sigmas**2, flatness)
    if not math.isfinite(rho):
        raise ShapeError("the points define no line; give at least two distinct points")
    sign = -1.0 if rho < 0.0 else 1.0
    return LineFit(
        sign * rho,
        wrap(alpha if sign > 0.0 else alpha + math.pi),
        np.array([[rr, sign * ra], [sign * ra, aa]]),
        np.array([sign * b_r, b_a]),
        chi2,
    )
