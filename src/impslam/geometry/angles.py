"""Wrap angles, which are plain floats in radians; no other module wraps angles."""

from __future__ import annotations

import math
from typing import overload

import numpy as np
import numpy.typing as npt

from impslam.geometry.kernels import kernel

Array = npt.NDArray[np.float64]


@overload
def wrap(angle: float) -> float: ...
@overload
def wrap(angle: Array) -> Array: ...
def wrap(angle: float | Array) -> float | Array:
    """Return the angle in (-pi, pi], element by element; kernels call `wrap_in_kernel`."""
    return math.pi - (math.pi - angle) % (2.0 * math.pi)


wrap_in_kernel = kernel(wrap)
