"""Large arrays that allocate memory page by page, when they are written."""

from __future__ import annotations

import math
import mmap
import sys
from typing import Any

import numpy as np
import numpy.typing as npt


def zero_pages(shape: tuple[int, ...], kind: npt.DTypeLike) -> npt.NDArray[Any]:
    """Return zeros; pages that are never written take no memory, and all is freed with the array.

    `np.zeros` asks for pages of 2 MB, of which a few values take the whole. Also, once the C library has
    freed a large array, it keeps the memory of later ones, and has to fill it with zeros.
    """
    dtype = np.dtype(kind)
    size = max(1, math.prod(shape) * dtype.itemsize)
    if sys.platform == "win32":
        memory = mmap.mmap(-1, size)
    else:  # a forked child process must not share it
        memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    return np.frombuffer(memory, dtype, math.prod(shape)).reshape(shape)
