"""The command `imp`."""

from __future__ import annotations

import atexit
import gc
import os

from impslam.cli.app import main

__all__ = ["main"]

# Commands are imported when they are called, and numpy with them, after this. The matrices of a scan
# are small, so threads cost more than they give, and sums whose order depends on the number of cores
# would make two machines differ in the last bits.
# OMP_NUM_THREADS, where it is set, is meant for all of them.
_threads = os.environ.get("OMP_NUM_THREADS", "1")
for _library in ("OPENBLAS", "MKL", "OMP"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", _threads)

# Nothing that is imported is garbage: looking for some took a fifth of a short run, half of it at exit.
gc.set_threshold(1_000_000, 20, 20)
atexit.register(gc.freeze)
