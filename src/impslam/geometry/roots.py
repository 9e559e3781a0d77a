"""Square roots of covariances."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def root(P: Array) -> Array:
    """Return A (n, n) with A A^T = P for a positive semidefinite P (n, n)."""
    values, vectors = np.linalg.eigh(P)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))
