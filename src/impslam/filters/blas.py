"""BLAS of scipy without the rest of `scipy.linalg`, whose import costs a run 0.1 s."""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

from impslam.geometry.scipy_extension import load
from impslam.types import Array

_blas = load("scipy.linalg._fblas", "scipy.linalg.blas")
_PANEL = 128  # columns at a time: 2 MB of 2000 rows, which a core's second cache holds


@cache
def _dgemm() -> Any:
    """Return the dgemm behind scipy's, all arguments by address: it takes parts of a matrix."""
    capsule = _blas.dgemm._cpointer
    pointer = ctypes.pythonapi.PyCapsule_GetPointer
    pointer.restype, pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    letters, addresses = [ctypes.c_char_p] * 2, [ctypes.c_void_p] * 11
    return ctypes.CFUNCTYPE(None, *letters, *addresses)(pointer(capsule, None))


def subtract_product(P: Array, n: int, L: Array, R: Array) -> None:
    """Subtract L^T R from the lower triangle of P[:n, :n] in place, in one pass over its memory.

    P (size, size) is in Fortran order, L and R (k, size) in C order; what lies above the diagonal is
    overwritten here and there.
    """
    k, size = L.shape
    assert P.flags.f_contiguous
    assert L.flags.c_contiguous
    assert R.flags.c_contiguous
    assert P.shape == (size, size)
    assert R.shape == (k, size)
    dgemm, integers = _dgemm(), (ctypes.c_int * 4)(n, _PANEL, k, size)
    numbers = (ctypes.c_double * 2)(-1.0, 1.0)
    rows = ctypes.addressof(integers)
    columns, inner, stride = rows + 4, rows + 8, rows + 12
    minus, one = ctypes.addressof(numbers), ctypes.addressof(numbers) + 8
    p, left, right = (array.__array_interface__["data"][0] for array in (P, L, R))
    for j in range(0, n, _PANEL):
        integers[0], integers[1] = n - j, min(_PANEL, n - j)
        a, b, c = left + 8 * j, right + 8 * j, p + 8 * j * (size + 1)
        dgemm(b"N", b"T", rows, columns, inner, minus, a, stride, b, stride, one, c, stride)
