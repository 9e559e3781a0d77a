"""The decorator of every compiled kernel."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar, cast

from numba import njit

F = TypeVar("F", bound=Callable[..., object])


def kernel(function: F) -> F:
    """Compile a small function on plain arrays; the machine code is kept between runs.

    No `fastmath`, so that results do not depend on how a compiler reorders sums, and no
    `parallel`, whose compile time (5 s) no kernel here earns back.
    """
    return cast("F", njit(cache=True, nogil=True)(function))
