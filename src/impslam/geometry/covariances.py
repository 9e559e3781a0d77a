"""Covariances and their inverses."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from impslam.errors import NumericalError

Array = npt.NDArray[np.float64]


def inverse_of(matrix: Array) -> Array:
    """Return the inverses (..., d, d) of covariances or of informations.

    Raises
    ------
    NumericalError
        If one of them is singular, as the covariance of odometry without noise.
    """
    try:
        return np.asarray(np.linalg.inv(matrix))
    except np.linalg.LinAlgError:
        raise NumericalError("a covariance is singular: is there a sensor without noise?") from None
