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
    """

    p: Array
    covariance: Array

    @property
    def sigma(self) -> Array:
        """(n,) standard deviations of the parameters."""
        return np.sqrt(np.diag(self.covariance))

    def times(self, factor: float) -> Fit:
        """Return the fit of y times a factor."""
        return Fit(factor * self.p, factor**2 * self.covariance)

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
            if (np.abs(p - before) <= 1e-9 * np.abs(p) + 1e-12).all():
                break
    return Fit(p, sandwich(A, residuals, scale, block))


def sandwich(J: Array, residuals: Array, scale: float, block: int = 1) -> Array:
    """Return the covariance (n, n) of n parameters from m residuals and their derivatives J (m, n).

    That of a fit by Tukey's biweight of residuals of a robust standard deviation, `scale`; see `jackknife`
    for `block`. No parameter is surer than rows of equal noise make it: the fit passes through a row that
    is alone in telling of turns, whatever its error is.
    """
    weights, slopes = biweight(residuals, scale), biweight_slopes(residuals, scale)
    covariance = jackknife(J, weights * residuals, slopes, block)
    equal = scale**2 * np.diag(np.linalg.pinv((J * weights[:, None]).T @ J))
    unsure = np.sqrt(np.maximum(equal / np.maximum(np.diag(covariance), 1e-30), 1.0))
    widened: Array = covariance * np.outer(unsure, unsure)
    return widened


def jackknife(J: Array, scores: Array, slopes: Array, block: int = 1) -> Array:
    """Return the covariance (n, n) of parameters from scores (m,) and their slopes by the residuals.

    Errors of neighbouring rows may hang together within a `block` of rows, not beyond (Liang & Zeger 1986).
    Each block counts as if it were left out of the fit (CR3, Bell & McCaffrey 2002; for single rows HC3,
    MacKinnon & White 1985): the fit follows the few rows that tell of a parameter.
    """
    blocks = -(-len(J) // block)

    def by_block(rows: Array) -> Array:
        padded = np.pad(rows, ((0, blocks * block - len(J)), (0, 0)))
        return padded.reshape(blocks, block, rows.shape[1])

    bread = np.linalg.pinv((J * slopes[:, None]).T @ J)
    derivatives = by_block(J).transpose(0, 2, 1)
    own = by_block(J * slopes[:, None]) @ bread @ derivatives
    rest = (1.0 + 1e-9) * np.eye(block) - own  # no block tells all of a parameter
    moved = (derivatives @ np.linalg.solve(rest, by_block(scores[:, None])))[..., 0] @ bread
    covariance: Array = moved.T @ moved
    return covariance


def spread(residuals: Array) -> float:
    """Return the standard deviation of normal residuals, by their median: half of them may be wrong."""
    return 1.4826 * float(np.median(np.abs(residuals))) + 1e-9


def biweight(residuals: Array, scale: float) -> Array:
    """Return Tukey's weights (m,): 1 in the middle, 0 from `CUT` standard deviations on."""
    return np.square(np.maximum(1.0 - np.square(residuals / (CUT * scale)), 0.0))


def biweight_slopes(residuals: Array, scale: float) -> Array:
    """Return by how much (m,) weight times residual grows with the residual."""
    u2 = np.square(residuals / (CUT * scale))
    return np.where(u2 < 1.0, (1.0 - u2) * (1.0 - 5.0 * u2), 0.0)
