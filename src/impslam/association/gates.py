"""Chi-square quantiles, remembered: a scan asks for many, and always for the same few."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.special import chdtri

from impslam.types import Array


@cache
def quantile(probability: float, dof: int) -> float:
    """Return the chi-square quantile for one number of degrees of freedom."""
    return float(chdtri(dof, 1.0 - probability))


@cache
def quantiles(probability: float, dof: int) -> Array:
    """Return the quantiles (dof + 1,) for 0, 1, ..., dof degrees of freedom; read only."""
    table = np.zeros(dof + 1)
    table[1:] = chdtri(np.arange(1, dof + 1), 1.0 - probability)
    table.flags.writeable = False
    return table
