"""Convert range and bearing to Cartesian coordinates with covariance."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def to_cartesian(r: float, alpha: float, R_polar: Array) -> tuple[Array, Array]:
    """Return z = r (cos alpha, sin alpha) and its covariance, to first order.

    Parameters
    ----------
    r, alpha : m and rad, about the origin of the frame
    R_polar : (2, 2) covariance of an additive error on [r, alpha]

    Returns
    -------
    z, R : (2,) m and (2, 2) m^2; R = J R_polar J^T with J the Jacobian of z by [r, alpha]
    """
    c, s = math.cos(alpha), math.sin(alpha)
    z_D_polar = np.array([[c, -r * s], [s, r * c]])
    return np.array([r * c, r * s]), z_D_polar @ R_polar @ z_D_polar.T
