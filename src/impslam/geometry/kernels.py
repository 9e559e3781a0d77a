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
    """Return how long this process has compiled by now, s; loading what was compiled before is none."""
    return float(_COMPILING.duration) if _COMPILING.done else 0.0


def kernel(function: F) -> F:
    """Compile a small function on plain arrays; the machine code is kept between runs.

    No `fastmath`, so that results do not depend on how a compiler reorders sums, and no
    `parallel`, whose compile time (5 s) no kernel here earns back.
    """
    if getattr(config, "DISABLE_JIT", False):  # set by numba's own name in the environment
        return function
    dispatcher: Any = Kernel(function)
    try:
        dispatcher._cache = MachineCode(function)  # what njit(cache=True) does with numba's own
    except RuntimeError:  # numba's word for: neither the package nor a cache folder can be written
        warn_once("no folder for compiled code can be written")
    return cast("F", dispatcher)


def plain(array: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return an array as kernels are compiled for: float64, contiguous, writable; copied if need be."""
    if isinstance(array, np.ndarray) and array.dtype == _FLOAT64 and array.flags.carray:
        return array  # as most are: `np.require` takes ten times as long to say so
    return np.require(array, np.float64, ["C", "W"])


def read_only(*arrays: npt.NDArray[Any]) -> list[npt.NDArray[Any]]:
    """Return views that cannot be written to: one type for a kernel, whatever each array allows."""
    views = [array.view() for array in arrays]
    for view in views:
        view.flags.writeable = False
    return views
