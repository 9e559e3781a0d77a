"""Chi-square quantiles, remembered: scipy takes 60 us for one, a scan asks for many."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.stats import chi2

from impslam.types import Array


@cache
def quantile(probability: float, dof: int) -> float:
    """Return the chi-square quantile for one number of degrees of freedom."""
    return float(np.asarray(chi2.ppf(probability, dof)))


@cache
def quantiles(probability: float, dof: int) -> Array:
    """Return the quantiles (dof + 1,) for 0, 1, ..., dof degrees of freedom; read only."""
    table = np.zeros(dof + 1)
    table[1:] = chi2.ppf(probability, np.arange(1, dof + 1))
    table.flags.writeable = False
    return table
