"""scipy's BLAS for kernels, without importing `scipy.linalg`, which takes 0.1 s.

Routines are called with the Fortran convention, all arguments by address, so they work in place on parts of
a matrix.
"""

from __future__ import annotations

import ctypes
from typing import Any

import llvmlite.binding as llvm
import numpy as np
from numba.core import config, types

from impslam.geometry.kernels import kernel
from impslam.geometry.scipy_extension import load
from impslam.types import Array

_blas = load("scipy.linalg._fblas", "scipy.linalg.blas")
_PANEL = 64  # columns of a triangle that are processed at a time
_L, _N, _T = b"LNT"


def _routine(name: str, arguments: int) -> Any:
    """Return the routine behind scipy's; compiled code refers to it by name, so it can be cached."""
    pointer = ctypes.pythonapi.PyCapsule_GetPointer
    pointer.restype, pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    address = pointer(getattr(_blas, name)._cpointer, None)
    if getattr(config, "DISABLE_JIT", False):  # called from Python
        return ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * arguments)(address)
    llvm.add_symbol(f"impslam_{name}", address)
    return types.ExternalFunction(f"impslam_{name}", types.void(*[types.voidptr] * arguments))


_dsyrk, _dgemm = _routine("dsyrk", 10), _routine("dgemm", 13)


@kernel
def subtract_square(P: Array, n: int, W: Array) -> None:
    """Subtract W^T W from the lower triangle of P[:n, :n] in place.

    P (size, size) is in Fortran order, W (k, >= n) in C order.
    """
    letters, numbers = np.array([_L, _N], np.uint8), np.array([-1.0, 1.0])
    sizes = np.array([n, len(W), W.shape[1], len(P)], np.int32)
    _dsyrk(
        letters.ctypes, letters[1:].ctypes, sizes.ctypes, sizes[1:].ctypes, numbers.ctypes,
        W.ctypes, sizes[2:].ctypes, numbers[1:].ctypes, P.ctypes, sizes[3:].ctypes,
    )  # fmt: skip


@kernel
def subtract_product(P: Array, n: int, L: Array, R: Array) -> None:
    """Subtract L^T R from the lower triangle of P[:n, :n] in place, in one pass over its memory.

    P (size, size) is in Fortran order, L and R (k, >= n) in C order; parts above the diagonal are
    overwritten.
    """
    letters, numbers = np.array([_N, _T], np.uint8), np.array([-1.0, 1.0])
    sizes = np.array([0, 0, len(L), L.shape[1], len(P)], np.int32)
    for j in range(0, n, _PANEL):
        sizes[0], sizes[1] = n - j, min(_PANEL, n - j)
        _dgemm(
            letters.ctypes, letters[1:].ctypes, sizes.ctypes, sizes[1:].ctypes, sizes[2:].ctypes,
            numbers.ctypes, L[:, j:].ctypes, sizes[3:].ctypes, R[:, j:].ctypes, sizes[3:].ctypes,
            numbers[1:].ctypes, P[j:, j:].ctypes, sizes[4:].ctypes,
        )  # fmt: skip
