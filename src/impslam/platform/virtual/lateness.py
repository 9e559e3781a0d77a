"""How late a loop in real time is."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

log = logging.getLogger(__name__)

MAX_LATENESS = 20e-3  # s, then a pass counts as late: two readings of the fastest device
MAX_PASSES = 10_000  # lateness kept: 10 s


class LatenessLog:
    """The lateness of the passes of a loop; many late ones are reported."""

    def __init__(self) -> None:
        self._seconds = np.zeros(MAX_PASSES)
        self._passes = self._late = 0

    def add(self, lateness: float) -> None:
        """Record the lateness of a pass, s."""
        self._seconds[self._passes % MAX_PASSES] = lateness
        self._passes += 1
        if lateness > MAX_LATENESS:
            self._late += 1
            log.log(
                logging.WARNING if self._late in (100, 1000) else logging.DEBUG,
                "the virtual robot was late %d times by now, just now by %.0f ms: this computer is "
                "busy; it catches up",
                self._late,
                1e3 * lateness,
            )

    def summary(self) -> dict[str, Any]:
        """Return the numbers of passes and late ones, and the lateness of the last `MAX_PASSES`, s."""
        kept = self._seconds[: max(1, min(self._passes, MAX_PASSES))]
        p50, p99 = np.percentile(kept, (50, 99)).tolist()
        return {
            "passes": self._passes,
            "late": self._late,
            "lateness": {"p50": p50, "p99": p99, "max": float(kept.max())},
        }
