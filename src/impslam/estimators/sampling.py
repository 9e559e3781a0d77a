"""Shared by estimators with several hypotheses of the path: normalised weights, sampled poses."""

from __future__ import annotations

import numpy as np

from impslam.geometry.angles import wrap
from impslam.types import Array


def normalised(log_weights: Array) -> Array:
    """Return the weights (n,) of log weights (n,), with a sum of 1."""
    weights = np.exp(log_weights - log_weights.max())
    return np.asarray(weights / weights.sum())


def moved(poses: Array, roots: Array, u: Array) -> Array:
    """Return poses (P, 3) moved by roots (P, 3, 3) times u (P, 3)."""
    moved: Array = poses + np.einsum("pij,pj->pi", roots, u)
    moved[:, 2] = wrap(moved[:, 2])
    return moved
