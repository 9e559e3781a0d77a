"""Angles are plain floats in radians; they are wrapped here and nowhere else."""

from __future__ import annotations

import math
from typing import overload

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@overload
def wrap(angle: float) -> float: ...
@overload
def wrap(angle: Array) -> Array: ...
def wrap(angle: float | Array) -> float | Array:
    """Return the angle in (-pi, pi], element by element."""
    if isinstance(angle, float):  # a fifth of numpy's time, which most calls would wait for
        return math.pi - (math.pi - float(angle)) % (2.0 * math.pi)
    wrapped = np.pi - np.mod(np.pi - angle, 2.0 * np.pi)
    return float(wrapped) if np.ndim(wrapped) == 0 else wrapped
