"""Arrays that a caller gives, checked: numbers, in rows of one shape."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from impslam.component import shorten
from impslam.errors import ShapeError
from impslam.types import Array, check_shape


def numeric(name: str, given: npt.ArrayLike) -> Array:
    """Return a copy as an array; raise `ShapeError`, which names the argument, unless it holds numbers."""
    try:
        array = np.asarray(given)
    except ValueError:
        raise ShapeError(f"{name}: rows of different lengths; give an array") from None
    if array.dtype.kind not in "iuf":
        what = f"{shorten(given)} is of type {array.dtype}"
        raise ShapeError(f"{name}: {what}; give numbers, NaN where there is none")
    return array.astype(np.float64)  # a copy: what the caller does with its own changes nothing


def finite(name: str, given: npt.ArrayLike, length: int | None) -> Array:
    """Return a vector of finite numbers, of a length if one is given."""
    array = numeric(name, given)
    check_shape(name, array, length)
    if not np.isfinite(array).all():
        k = int(np.argmin(np.isfinite(array)))
        raise ShapeError(f"{name}[{k}] is {array[k]}; give finite numbers, leave out other rows")
    return array


def rows_of(name: str, given: npt.ArrayLike, length: int, row: tuple[int, ...]) -> Array:
    """Return an array (length, *row), also of the one row that was given."""
    array = numeric(name, given)
    if length == 0 and array.size == 0:
        return array.reshape(0, *row)
    if length == 1 and array.ndim == len(row):
        array = array[None]
    check_shape(name, array, length, *row)
    return array
