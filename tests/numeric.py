"""Numerical derivatives, the oracle of every Jacobian; angles; noise."""

from collections.abc import Callable

import numpy as np

from impslam.types import Array


def jacobian(function: Callable[[Array], Array], at: Array, step: float = 1e-6) -> Array:
    """Return d function / d at by central differences, shape (len(function), len(at))."""
    columns = []
    for i in range(len(at)):
        delta = np.zeros(len(at))
        delta[i] = step
        columns.append((function(at + delta) - function(at - delta)) / (2.0 * step))
    return np.array(columns).T


def drawn(rng: np.random.Generator, mean: Array, covariance: Array) -> Array:
    """Return a normal deviate; numpy's check of the covariance takes longer than the draw."""
    return rng.multivariate_normal(mean, covariance, check_valid="ignore")


def wrapped(difference: Array, *angles: int) -> Array:
    """Wrap some components of a difference, so that +-pi is no jump."""
    out = np.array(difference, dtype=float)
    for i in angles:
        out[..., i] = (out[..., i] + np.pi) % (2 * np.pi) - np.pi
    return out
