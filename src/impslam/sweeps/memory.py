"""The memory of a process."""

from __future__ import annotations

import math
from pathlib import Path

_STATUS = Path("/proc/self/status")


def peak_memory() -> float:
    """Return the most memory in bytes that this process has had in use; NaN where Linux does not tell.

    `getrusage` tells the parent's as well, if that was more when the process began.
    """
    if not _STATUS.is_file():
        return math.nan
    lines = dict(line.split(":", 1) for line in _STATUS.read_text().splitlines() if ":" in line)
    return 1024.0 * float(lines["VmHWM"].split()[0])
