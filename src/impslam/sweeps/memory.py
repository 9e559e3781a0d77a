"""Memory usage of the process."""

from __future__ import annotations

import math
from pathlib import Path

_STATUS = Path("/proc/self/status")


def peak_memory() -> float:
    """Return the peak memory of this process in bytes; NaN on systems other than Linux.

    `getrusage` is not used: it includes the parent's memory at the time of the fork.
    """
    if not _STATUS.is_file():
        return math.nan
    lines = dict(line.split(":", 1) for line in _STATUS.read_text().splitlines() if ":" in line)
    return 1024.0 * float(lines["VmHWM"].split()[0])
