"""Large arrays whose memory is taken from the system where they are written, page by page."""

from __future__ import annotations

import math
import mmap
import sys
from typing import Any

import numpy as np
import numpy.typing as npt


def zero_pages(shape: tuple[int, ...], kind: npt.DTypeLike) -> npt.NDArray[Any]:
    """Return zeros; what is never written takes no memory, and all is given back with the array.

    `np.zeros` asks for pages of 2 MB, of which a few values take the whole. And once the C library has
    freed a large array, it keeps the memory of later ones, and has to fill it with zeros.
    """
    dtype = np.dtype(kind)
    size = max(1, math.prod(shape) * dtype.itemsize)
    if sys.platform == "win32":
        memory = mmap.mmap(-1, size)
    else:  # a child process that is forked must not share it
        memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    return np.frombuffer(memory, dtype, math.prod(shape)).reshape(shape)
