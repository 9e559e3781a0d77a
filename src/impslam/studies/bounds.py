"""Cramér-Rao bounds: the smallest possible covariance of an unbiased extractor.

If the beams that hit a landmark are known, ranges r_i with independent Gaussian noise sigma_i have the
Fisher information sum_i J_i^T J_i / sigma_i^2 about its parameters, with J_i the derivative of r_i by them
(Kay 1993, Eq. 3.31). The dependence of sigma_i on the range would add 2 (d sigma / d r)^2, a share of 2e-5
for a noise that grows by 3 mm per metre; this is neglected. A common error b ~ N(0, bias^2) of all beams
is a further parameter with a prior, and is marginalised.

The parameters are [rho, alpha] of a wall and [x, y, radius] of a cylinder, perturbed by addition, in the
frame of the beams' origins (base_link).
"""

from __future__ import annotations

import numpy as np

from impslam.types import Array


def wall_ranges(z: Array, origins: Array, directions: Array) -> Array:
    """Return the ranges (n,) at which beams meet the wall z = [rho, alpha]: rho' / cos(theta - alpha).

    Parameters
    ----------
    z : (2,) m and rad; rho' is rho relative to the beam's origin
    origins, directions : (n, 2) m and (n,) rad
    """
    normal = np.array([np.cos(z[1]), np.sin(z[1])])
    ranges = (z[0] - origins @ normal) / np.cos(directions - z[1])
    return np.asarray(ranges)


def wall_jacobian(z: Array, origins: Array, directions: Array) -> Array:
    """Return (n, 2), the derivative of `wall_ranges` by [rho, alpha]."""
    cosines = np.cos(directions - z[1])
    points = _end_points(wall_ranges(z, origins, directions), origins, directions)
    lever = points @ np.array([-np.sin(z[1]), np.cos(z[1])])
    return np.asarray(np.column_stack((np.ones(len(lever)), -lever)) / cosines[:, None])


def circle_ranges(circle: Array, origins: Array, directions: Array) -> Array:
    """Return the ranges (n,) at which beams hit the circle [x, y, radius]; NaN if they miss."""
    to_centre = circle[:2] - origins
    c, s = np.cos(directions), np.sin(directions)
    across = to_centre[:, 0] * s - to_centre[:, 1] * c
    half2 = circle[2] ** 2 - across**2
    half = np.sqrt(np.where(half2 >= 0.0, half2, np.nan))
    return np.asarray(to_centre[:, 0] * c + to_centre[:, 1] * s - half)


def circle_jacobian(circle: Array, origins: Array, directions: Array) -> Array:
    """Return (n, 3), the derivative of `circle_ranges` by [x, y, radius].

    From |o + r u - c| = radius, with the outward normal n at the point hit by the beam:
    n . (u dr - dc) = d radius.
    """
    points = _end_points(circle_ranges(circle, origins, directions), origins, directions)
    normals = (points - circle[:2]) / circle[2]
    cosines = normals[:, 0] * np.cos(directions) + normals[:, 1] * np.sin(directions)
    return np.asarray(np.column_stack((normals, np.ones(len(normals)))) / cosines[:, None])


def bound(jacobian: Array, sigmas: Array, bias: float = 0.0) -> Array:
    """Return the Cramér-Rao bound (k, k) of parameters, for the Jacobian (n, k) of the ranges.

    The diagonal is infinite if the ranges do not determine the parameters.

    Parameters
    ----------
    sigmas : (n,) m > 0, noise of each range
    bias : m, standard deviation of the common error of all ranges
    """
    k = jacobian.shape[1]
    scaled = jacobian / sigmas[:, None]
    information = scaled.T @ scaled
    if bias > 0.0:
        shared = scaled.T @ (1.0 / sigmas)
        own = float(np.sum(sigmas**-2.0)) + bias**-2.0
        information = information - np.outer(shared, shared) / own
    if not np.linalg.cond(information) < 1e14:
        return np.diag(np.full(k, np.inf))
    return np.asarray(np.linalg.inv(information))


def _end_points(ranges: Array, origins: Array, directions: Array) -> Array:
    """Return the end points (n, 2) of beams."""
    beams = np.column_stack((np.cos(directions), np.sin(directions)))
    return np.asarray(origins + ranges[:, None] * beams)
