"""The decorator of every compiled kernel, and where machine code is kept between runs."""

from __future__ import annotations

import logging
import multiprocessing
from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar, cast

from numba import njit
from numba.core.caching import FunctionCache
from numba.core.runtime.nrt import rtsys

F = TypeVar("F", bound=Callable[..., object])


def kernel(function: F) -> F:
    """Compile a small function on plain arrays; the machine code is kept between runs.

    No `fastmath`, so that results do not depend on how a compiler reorders sums, and no
    `parallel`, whose compile time (5 s) no kernel here earns back.
    """
    dispatcher: Any = njit(nogil=True)(function)
    try:
        dispatcher._cache = MachineCode(function)  # what njit(cache=True) does with numba's own
    except RuntimeError:  # numba's word for: neither the package nor a cache folder can be written
        _warn_once("no folder for compiled code can be written")
    return cast("F", dispatcher)


class MachineCode(FunctionCache):
    """Compiled code in NUMBA_CACHE_DIR, beside the module, or in the user's cache folder.

    The first of these that can be written is used. Code that cannot be kept still runs.
    """

    def load_overload(self, sig: object, target_context: object) -> object:
        """Return a function compiled before, or None.

        numba would first import what its compiler needs: 0.2 s, much of scipy among it. Machine code
        needs the runtime alone, and where there is none numba imports the rest when it compiles.
        """
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)

    def save_overload(self, sig: object, data: object) -> None:
        """Keep a compiled function for the next run."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _warn_once(f"compiled code cannot be kept: {error}")


@cache
def _warn_once(problem: str) -> None:
    if multiprocessing.parent_process() is None:  # a worker's parent has said so
        logging.getLogger(__name__).warning(
            "%s, so every run compiles anew (20 s); set NUMBA_CACHE_DIR to a folder of yours",
            problem,
        )
