"""Chi-square quantiles, cached: a scan needs many, but always the same few."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import numpy.typing as npt

GATE_2D = 13.8
GATE_3D_95, GATE_3D_99, GATE_3D_999, GATE_3D_9999 = 7.815, 11.345, 16.266, 21.108
"""Quantiles as constants for compiled code: 99.9 % for two degrees of freedom; 95 to 99.99 % for three."""


@cache
def quantile(probability: float, dof: int) -> float:
    """Return the chi-square quantile for one number of degrees of freedom."""
    # Runs with only walls and points save an import of 0.1 s.
    if dof == 2 and probability < 1.0:
        return -2.0 * math.log1p(-probability)
    return float(quantiles(probability, dof)[dof])


@cache
def quantiles(probability: float, dof: int) -> npt.NDArray[np.float64]:
    """Return the quantiles (dof + 1,) for 0, 1, ..., dof degrees of freedom; read only."""
    from scipy.special import chdtri  # noqa: PLC0415

    table = np.zeros(dof + 1)
    table[1:] = chdtri(np.arange(1, dof + 1), 1.0 - probability)
    table.flags.writeable = False
    return table
