"""Robust linear least squares with realistic standard deviations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.geometry.kernels import kernel, plain
from impslam.types import Array

CLEAR = 6.0
"""Standard deviations that a parameter must be below 0 to count as negative."""
BIWEIGHT_CUTOFF = 4.685
"""Standard deviations beyond which a row has no weight: 95 % efficient for normal errors (Tukey's
biweight; Holland & Welsch 1977)."""
MAX_ITERATIONS = 30
RIDGE = 1e-13
"""Share of its squares that is added to those of each parameter: where the rows do not determine the
parameters, the smallest that fit are found. It is above the rounding errors, and far below any sigma."""


class RobustFit(NamedTuple):
    """Solution of y = A p.

    Attributes
    ----------
    p : (n,) parameters
    covariance : (n, n) of them, from the residuals (sandwich; Huber 1967): it needs no noise model, and the
        rows may have unequal noise
    """

    p: Array
    covariance: Array

    @property
    def sigma(self) -> Array:
        """(n,) standard deviations of the parameters."""
        return np.sqrt(np.diag(self.covariance))

    def scaled(self, factor: float) -> RobustFit:
        """Return the fit of y times a factor."""
        return RobustFit(factor * self.p, factor**2 * self.covariance)

    def is_negative(self, k: int) -> bool:
        """Return whether parameter k is significantly below 0."""
        return bool(self.p[k] < -CLEAR * self.sigma[k])


def fit(A: Array, y: Array, block: int = 1, min_sigma: float = 1e-9) -> RobustFit:
    """Fit the parameters (n,) of m rows A (m, n) and y (m,), m > n; see `sandwich` for `block`.

    `min_sigma` is a lower bound of the standard deviation of a row.
    """
    p, residuals, scale = _reweighted(plain(A), plain(y), min_sigma)
    return RobustFit(p, sandwich(A, residuals, scale, block))


@kernel
def _reweighted(A: Array, y: Array, min_sigma: float) -> tuple[Array, Array, float]:
    """Return the parameters (n,), the residuals (m,), and their robust standard deviation."""
    weights, p, scale = np.ones(len(y)), np.zeros(A.shape[1]), min_sigma
    residuals = y.copy()
    for k in range(MAX_ITERATIONS):
        before = p
        p = _least_squares(A, y, weights)
        for i in range(len(y)):
            residuals[i] = y[i] - (A[i] * p).sum()
        scale = max(robust_sigma(residuals), min_sigma)
        if k < MAX_ITERATIONS // 3:  # least absolute residuals: the biweight needs a good start
            weights = 1.0 / np.maximum(np.abs(residuals), scale)
        else:
            weights = biweight(residuals, scale)
            if (np.abs(p - before) <= 1e-9 * np.abs(p) + 1e-12).all():
                break
    return p, residuals, scale


@kernel
def _least_squares(A: Array, y: Array, weights: Array) -> Array:
    """Return the parameters (n,) that minimise the weighted squares; see `RIDGE`."""
    n = A.shape[1]
    N, p = np.zeros((n, n)), np.zeros(n)
    for i in range(len(y)):
        for a in range(n):
            p[a] += weights[i] * A[i, a] * y[i]
            for b in range(n):
                N[a, b] += weights[i] * A[i, a] * A[i, b]
    for a in range(n):
        N[a, a] += RIDGE * N[a, a] + 1e-300  # not 0 where a column is
    for a in range(n):  # elimination; the matrix is positive definite
        for b in range(a + 1, n):
            factor = N[b, a] / N[a, a]
            p[b] -= factor * p[a]
            for c in range(a + 1, n):
                N[b, c] -= factor * N[a, c]
    for a in range(n - 1, -1, -1):
        for b in range(a + 1, n):
            p[a] -= N[a, b] * p[b]
        p[a] /= N[a, a]
    return p


def sandwich(J: Array, residuals: Array, scale: float, block: int = 1) -> Array:
    """Return the covariance (n, n) of n parameters from m residuals and their derivatives J (m, n).

    It is that of a fit by Tukey's biweight of residuals with a robust standard deviation `scale`; see
    `jackknife` for `block`. No variance is less than rows of equal noise would give: if only one row has
    information on a parameter, the fit passes through it and its residual says nothing about its error.
    """
    weights, slopes = biweight(residuals, scale), biweight_slopes(residuals, scale)
    covariance = jackknife(J, weights * residuals, slopes, block)
    equal = scale**2 * np.diag(np.linalg.pinv((J * weights[:, None]).T @ J))
    unsure = np.sqrt(np.maximum(equal / np.maximum(np.diag(covariance), 1e-30), 1.0))
    widened: Array = covariance * np.outer(unsure, unsure)
    return widened


def jackknife(J: Array, scores: Array, slopes: Array, block: int = 1) -> Array:
    """Return the covariance (n, n) of parameters from scores (m,) and their slopes by the residuals.

    Errors of neighbouring rows may be correlated within a `block` of rows, not beyond (Liang & Zeger 1986).
    Each block counts as if it were left out of the fit (CR3, Bell & McCaffrey 2002; for single rows HC3,
    MacKinnon & White 1985), because the fit follows the rows if few of them determine a parameter.
    """
    blocks = -(-len(J) // block)

    def by_block(rows: Array) -> Array:
        padded = np.pad(rows, ((0, blocks * block - len(J)), (0, 0)))
        return padded.reshape(blocks, block, rows.shape[1])

    bread = np.linalg.pinv((J * slopes[:, None]).T @ J)
    derivatives = by_block(J).transpose(0, 2, 1)
    own = by_block(J * slopes[:, None]) @ bread @ derivatives
    rest = (1.0 + 1e-9) * np.eye(block) - own  # regular even if one block determines a parameter
    moved = (derivatives @ np.linalg.solve(rest, by_block(scores[:, None])))[..., 0] @ bread
    covariance: Array = moved.T @ moved
    return covariance


@kernel
def robust_sigma(residuals: Array) -> float:
    """Return the standard deviation of normal residuals (m,) by their median; half may be outliers."""
    return 1.4826 * float(np.median(np.abs(residuals))) + 1e-9


@kernel
def biweight(residuals: Array, scale: float) -> Array:
    """Return Tukey's weights (m,): 1 at zero, 0 from `BIWEIGHT_CUTOFF` standard deviations on."""
    return np.square(np.maximum(1.0 - np.square(residuals / (BIWEIGHT_CUTOFF * scale)), 0.0))


def biweight_slopes(residuals: Array, scale: float) -> Array:
    """Return the derivatives (m,) of weight times residual by the residual."""
    u2 = np.square(residuals / (BIWEIGHT_CUTOFF * scale))
    return np.where(u2 < 1.0, (1.0 - u2) * (1.0 - 5.0 * u2), 0.0)
