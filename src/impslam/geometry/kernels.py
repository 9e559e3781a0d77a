"""The decorator of every compiled kernel."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt
from numba.core import config, event

from impslam.geometry.dispatcher import Kernel
from impslam.geometry.machine_code import MachineCode, warn_once

_FLOAT64 = np.dtype(np.float64)
F = TypeVar("F", bound=Callable[..., object])


_COMPILING = event.TimingListener()
event.register("numba:compile", _COMPILING)


def compile_seconds() -> float:
    """Return the time that this process has spent compiling, s, without loading cached code."""
    return float(_COMPILING.duration) if _COMPILING.done else 0.0


def kernel(function: F) -> F:
    """Compile a small function on plain arrays; the machine code is cached between runs.

    No `fastmath`, so that results do not depend on how a compiler reorders sums, and no
    `parallel`, whose compile time (5 s) does not pay off for these kernels.
    """
    if getattr(config, "DISABLE_JIT", False):  # by numba's environment variable
        return function
    dispatcher: Any = Kernel(function)
    try:
        dispatcher._cache = MachineCode(function)  # what njit(cache=True) does with numba's own
    except RuntimeError:  # neither the package nor a cache folder is writable
        warn_once("no folder for compiled code can be written")
    return cast("F", dispatcher)


def plain(array: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return an array in the layout of kernels: float64, contiguous, writable; copied if necessary."""
    if isinstance(array, np.ndarray) and array.dtype == _FLOAT64 and array.flags.carray:
        return array  # the usual case; `np.require` takes ten times as long
    return np.require(array, np.float64, ["C", "W"])


def read_only(*arrays: npt.NDArray[Any]) -> list[npt.NDArray[Any]]:
    """Return read-only views: one type for a kernel, whether the arrays are writable or not."""
    views = [array.view() for array in arrays]
    for view in views:
        view.flags.writeable = False
    return views
