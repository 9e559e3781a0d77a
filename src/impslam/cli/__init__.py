"""The command `imp`."""

from __future__ import annotations

import atexit
import gc
import os
import sys

try:
    from impslam.cli.app import main
except KeyboardInterrupt:  # `main` handles it from here on; nothing has been written yet
    sys.stderr.write("imp: interrupted\n")
    raise SystemExit(130) from None

__all__ = ["main"]

# Set the thread counts before any command imports numpy. The matrices are too small to gain from
# threads, and a summation order that depends on the number of cores would make results differ between
# machines in the last bits. OMP_NUM_THREADS, if set, applies to all libraries.
_threads = os.environ.get("OMP_NUM_THREADS", "1")
for _library in ("OPENBLAS", "MKL", "OMP"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", _threads)

# Imported modules are never garbage; collecting took a fifth of a short run, half of it at exit.
gc.set_threshold(1_000_000, 20, 20)
atexit.register(gc.freeze)
