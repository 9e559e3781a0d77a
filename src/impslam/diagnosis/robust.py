"""Straight least squares that a minority of wrong rows does not move, with honest standard deviations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.types import Array

CLEAR = 6.0
"""Standard deviations that a parameter is below 0 before its sign is believed."""
CUT = 4.685
"""Standard deviations beyond which a row counts nothing: 95 % efficient for normal errors (Tukey's
biweight; Holland & Welsch 1977)."""
ROUNDS = 30


class Fit(NamedTuple):
    """What y = A p comes to.

    Attributes
    ----------
    p : (n,) parameters
    covariance : (n, n) of them, from the residuals themselves (sandwich; Huber 1967): it needs no noise
        model, and rows of unequal noise do no harm
    scale : robust standard deviation of the residuals
    inliers : share of rows that count
    """

    p: Array
    covariance: Array
    scale: float
    inliers: float

    @property
    def sigma(self) -> Array:
        """(n,) standard deviations of the parameters."""
        return np.sqrt(np.diag(self.covariance))

    def times(self, factor: float) -> Fit:
        """Return the fit of y times a factor."""
        return self._replace(
            p=factor * self.p, covariance=factor**2 * self.covariance, scale=factor * self.scale
        )

    def is_negative(self, k: int) -> bool:
        """Tell whether parameter k is below 0, beyond doubt."""
        return bool(self.p[k] < -CLEAR * self.sigma[k])


def fit(A: Array, y: Array, block: int = 1, least: float = 1e-9) -> Fit:
    """Fit the parameters (n,) of m rows A (m, n) and y (m,), m > n; see `sandwich` for `block`.

    `least` is the standard deviation of a row at least.
    """
    weights: Array = np.ones(len(y))
    p: Array = np.zeros(A.shape[1])
    for k in range(ROUNDS):
        weighted: Array = A * weights[:, None]
        before = p
        p = np.asarray(np.linalg.lstsq(weighted.T @ A, weighted.T @ y, rcond=None)[0])
        residuals = y - A @ p
        scale = max(spread(residuals), least)
        if k < ROUNDS // 3:  # least absolute residuals first: the biweight needs a start near
            weights = 1.0 / np.maximum(np.abs(residuals), scale)
        else:
            weights = biweight(residuals, scale)
            if np.allclose(p, before, rtol=1e-9, atol=1e-12):
                break
    return Fit(p, sandwich(A, residuals, weights, block), scale, float((weights > 0.0).mean()))


def sandwich(J: Array, residuals: Array, weights: Array, block: int = 1) -> Array:
    """Return the covariance (n, n) of n parameters from m residuals, their derivatives and weights.

    Errors of neighbouring rows may hang together within a `block` of rows, not beyond (Liang & Zeger 1986).
    """
    bread = np.linalg.pinv((J * weights[:, None]).T @ J)
    scores = J * (weights * residuals)[:, None]
    meat = np.add.reduceat(scores, np.arange(0, len(J), block))
    m, n = meat.shape
    covariance: Array = bread @ (meat.T @ meat) @ bread * (m / max(m - n, 1))
    return covariance


def spread(residuals: Array) -> float:
    """Return the standard deviation of normal residuals, by their median: half of them may be wrong."""
    return 1.4826 * float(np.median(np.abs(residuals))) + 1e-9


def biweight(residuals: Array, scale: float) -> Array:
    """Return Tukey's weights (m,): 1 in the middle, 0 from `CUT` standard deviations on."""
    return np.square(np.maximum(1.0 - np.square(residuals / (CUT * scale)), 0.0))
