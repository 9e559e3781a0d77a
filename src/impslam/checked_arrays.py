"""Checks of the arrays that a caller passes: numbers, in rows of one shape."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from impslam.component import shorten
from impslam.errors import ShapeError
from impslam.types import Array, check_shape


def numeric(name: str, values: npt.ArrayLike) -> Array:
    """Return a copy as an array; raise `ShapeError` with the argument's name unless it holds numbers."""
    try:
        array = np.asarray(values)
    except ValueError:
        raise ShapeError(f"{name}: rows of different lengths; give an array") from None
    if array.dtype.kind not in "iuf":
        what = f"{shorten(values)} is of type {array.dtype}"
        raise ShapeError(f"{name}: {what}; give numbers, NaN for missing ones")
    array = array.astype(np.float64)  # a copy: later changes by the caller have no effect
    if isinstance(values, np.ma.MaskedArray):
        array[np.ma.getmaskarray(values)] = np.nan  # not the value under the mask
    return array


def finite(name: str, values: npt.ArrayLike, length: int | None) -> Array:
    """Return a vector of finite numbers, of the given length unless that is None."""
    array = numeric(name, values)
    check_shape(name, array, length)
    if not np.isfinite(array).all():
        k = int(np.argmin(np.isfinite(array)))
        raise ShapeError(f"{name}[{k}] is {array[k]}; give finite numbers, leave out other rows")
    return array


def rows_of(name: str, values: npt.ArrayLike, length: int, row: tuple[int, ...]) -> Array:
    """Return an array (length, *row); a single row may come without its first axis."""
    array = numeric(name, values)
    if length == 0 and array.size == 0:
        return array.reshape(0, *row)
    if length == 1 and array.ndim == len(row):
        array = array[None]
    check_shape(name, array, length, *row)
    return array
