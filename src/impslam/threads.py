"""One thread for BLAS while a run computes.

The matrices of a scan are small: threads cost four times the CPU time that they save (measured with
100 to 300 landmarks on two cores), and sums whose order depends on the number of cores would make
two machines differ in the last bits. `OMP_NUM_THREADS` and the like take precedence.
"""

from __future__ import annotations

import os
import threading
from typing import Any, ClassVar

LIBRARIES = ("OPENBLAS", "MKL", "OMP")
"""Each has its own variable, e.g. OPENBLAS_NUM_THREADS."""


class OneBlasThread:
    """A context that limits BLAS to one thread in the whole process, until the last one exits.

    Create it after the libraries are loaded: it limits only loaded ones.
    """

    _lock: ClassVar[threading.Lock] = threading.Lock()
    _inside: ClassVar[int] = 0
    _limits: ClassVar[Any] = None

    def __init__(self) -> None:
        self._controller: Any = None
        if not any(f"{library}_NUM_THREADS" in os.environ for library in LIBRARIES):
            from threadpoolctl import ThreadpoolController  # noqa: PLC0415  the command sets one

            self._controller = ThreadpoolController()

    def __enter__(self) -> None:
        if self._controller is None:
            return
        with OneBlasThread._lock:
            if OneBlasThread._inside == 0:
                OneBlasThread._limits = self._controller.limit(limits=1, user_api="blas")
            OneBlasThread._inside += 1

    def __exit__(self, *_: object) -> None:
        if self._controller is None:
            return
        with OneBlasThread._lock:
            OneBlasThread._inside -= 1
            if OneBlasThread._inside == 0:
                OneBlasThread._limits.restore_original_limits()
