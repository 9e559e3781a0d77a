"""The least covariance that any unbiased extractor can have: Cramér-Rao bounds.

With it known which beams hit a landmark, ranges r_i with independent Gaussian noise sigma_i carry
the Fisher information sum_i J_i^T J_i / sigma_i^2 about its parameters, J_i being the derivative of
r_i by them (Kay 1993, Eq. 3.31). That sigma_i itself changes with the range adds 2 (d sigma / d r)^2,
for a lidar whose noise grows by 3 mm per metre 2e-5 of it; this is left out. An error b ~ N(0, bias^2)
that all beams share is one more parameter, known beforehand to bias, and is marginalised.

What is perturbed, by addition, is [rho, alpha] of a wall and [x, y, radius] of a cylinder, in the
frame of the beams' origins (base_link).
"""

from __future__ import annotations

import numpy as np

from impslam.types import Array


def wall_ranges(z: Array, origins: Array, directions: Array) -> Array:
    """Return the ranges (n,) at which beams meet the wall z = [rho, alpha]: rho' / cos(theta - alpha).

    Parameters
    ----------
    z : (2,) m and rad; rho' is rho counted from the beam's origin
    origins, directions : (n, 2) m and (n,) rad
    """
    normal = np.array([np.cos(z[1]), np.sin(z[1])])
    ranges = (z[0] - origins @ normal) / np.cos(directions - z[1])
    return np.asarray(ranges)


def wall_jacobian(z: Array, origins: Array, directions: Array) -> Array:
    """Return (n, 2), the derivative of `wall_ranges` by [rho, alpha]."""
    cosines = np.cos(directions - z[1])
    places = _places(wall_ranges(z, origins, directions), origins, directions)
    lever = places @ np.array([-np.sin(z[1]), np.cos(z[1])])
    return np.asarray(np.column_stack((np.ones(len(lever)), -lever)) / cosines[:, None])


def circle_ranges(circle: Array, origins: Array, directions: Array) -> Array:
    """Return the ranges (n,) at which beams meet the circle [x, y, radius]; NaN where they miss."""
    to_centre = circle[:2] - origins
    c, s = np.cos(directions), np.sin(directions)
    across = to_centre[:, 0] * s - to_centre[:, 1] * c
    half2 = circle[2] ** 2 - across**2
    half = np.sqrt(np.where(half2 >= 0.0, half2, np.nan))
    return np.asarray(to_centre[:, 0] * c + to_centre[:, 1] * s - half)


def circle_jacobian(circle: Array, origins: Array, directions: Array) -> Array:
    """Return (n, 3), the derivative of `circle_ranges` by [x, y, radius].

    From |o + r u - c| = radius, with the outward normal n where the beam meets the circle:
    n . (u dr - dc) = d radius.
    """
    places = _places(circle_ranges(circle, origins, directions), origins, directions)
    normals = (places - circle[:2]) / circle[2]
    cosines = normals[:, 0] * np.cos(directions) + normals[:, 1] * np.sin(directions)
    return np.asarray(np.column_stack((normals, np.ones(len(normals)))) / cosines[:, None])


def bound(jacobian: Array, sigmas: Array, bias: float = 0.0) -> Array:
    """Return the Cramér-Rao bound (k, k) of parameters by which ranges have this Jacobian (n, k).

    Infinite on its diagonal where the ranges do not define the parameters.

    Parameters
    ----------
    sigmas : (n,) m > 0, noise of each range
    bias : m, standard deviation of the error that all ranges share
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


def _places(ranges: Array, origins: Array, directions: Array) -> Array:
    """Return where beams of these ranges end, (n, 2)."""
    beams = np.column_stack((np.cos(directions), np.sin(directions)))
    return np.asarray(origins + ranges[:, None] * beams)
