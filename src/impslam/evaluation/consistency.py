"""Does the filter know how wrong it is? Normalised errors against chi-square bounds.

Bar-Shalom, Li & Kirubarajan 2001, 5.4: the normalised estimation error squared (NEES) of a
consistent filter has a chi-square distribution, whose mean is its number of degrees of freedom.
"""

from __future__ import annotations

import numpy as np

from impslam.geometry.angles import wrap
from impslam.types import Array


def pose_errors(estimate: Array, truth: Array) -> Array:
    """Return estimate minus truth (n, 3), headings wrapped: the error the covariance speaks of."""
    error = estimate - truth
    error[:, 2] = wrap(error[:, 2])
    return error


def nees(errors: Array, covariances: Array) -> Array:
    """Return (n,) e^T P^-1 e of errors (n, k) and covariances (n, k, k).

    Raises
    ------
    numpy.linalg.LinAlgError
        If a covariance is singular, like that of a pose which is the origin by definition.
    """
    solved = np.linalg.solve(covariances, errors[..., None])[..., 0]
    return np.asarray(np.sum(errors * solved, axis=-1))


def chi2_bounds(dof: int, runs: int = 1, confidence: float = 0.95) -> tuple[float, float]:
    """Return the interval that the mean of `runs` independent normalised errors lies in."""
    from scipy.special import chdtri  # noqa: PLC0415  0.1 s, only where a truth is known

    tail = 0.5 * (1.0 - confidence)
    low, high = (float(chdtri(dof * runs, above)) / runs for above in (1.0 - tail, tail))
    return low, high


def share_within(values: Array, runs: int, dof: int, confidence: float = 0.95) -> float:
    """Return which part of means over `runs` (n,) lies within its bounds; ideally `confidence`."""
    low, high = chi2_bounds(dof, runs, confidence)
    return float(np.mean((values >= low) & (values <= high)))


def resampled_means(values: Array, rng: np.random.Generator, times: int = 500) -> Array:
    """Return means (times, n) over runs drawn anew with replacement from values (runs, n).

    The bootstrap (Efron 1979): they scatter about the mean as it does about the truth.
    """
    runs = len(values)
    counts = rng.multinomial(runs, np.full(runs, 1.0 / runs), size=times)
    return np.asarray(counts @ values / runs)
