"""The decorator of every compiled kernel."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt
from numba.core import config, event
from numba.core.compiler_lock import global_compiler_lock

from impslam.geometry.dispatcher import KernelDispatcher
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

    Python passes arguments by position. No `fastmath`, so that results do not depend on how a compiler
    reorders sums, and no `parallel`, whose compile time (5 s) does not pay off for these kernels.
    """
    if getattr(config, "DISABLE_JIT", False):  # by numba's environment variable
        return function
    return cast("F", Kernel(function))


class Kernel:
    """A function that is compiled when it is first called, or compiled into another kernel.

    numba's dispatcher takes 0.15 ms to create. A run calls a sixth of the kernels that it imports, and the
    cached machine code of these contains all that they call.
    """

    __slots__ = ("__dict__", "__weakref__", "_dispatcher")  # read faster than from the dictionary

    def __init__(self, function: Callable[..., object]) -> None:
        functools.update_wrapper(self, function)
        self.py_func = function
        self._dispatcher: Any = None

    def __call__(self, *args: Any) -> Any:
        """Call the function, compiled for the types of these arguments."""
        return (self._dispatcher or self.dispatcher)(*args)

    @property
    def dispatcher(self) -> Any:
        """The dispatcher of numba, created when it is first needed."""
        with global_compiler_lock:  # two threads must not create one each
            if self._dispatcher is None:
                self._dispatcher = _make_dispatcher(self.py_func)
        return self._dispatcher

    @property
    def _numba_type_(self) -> Any:
        """The type that numba requests to compile a call by another kernel."""
        return self.dispatcher._numba_type_

    def __reduce__(self) -> Any:
        """Pickle the dispatcher, which brings its function along, and is called in the same way."""
        return self.dispatcher.__reduce__()


def _make_dispatcher(function: Callable[..., object]) -> Any:
    dispatcher: Any = KernelDispatcher(function)
    try:
        dispatcher._cache = MachineCode(function)  # what njit(cache=True) does with numba's own
    except RuntimeError:  # neither the package nor a cache folder is writable
        warn_once("no folder for compiled code can be written")
    return dispatcher


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
