"""The usual time between the scans of a log, and gaps, which are much longer.

Some logs keep a scan every few seconds, so a fixed limit does not tell a gap.
"""

from __future__ import annotations

from impslam.geometry.kernels import kernel

GAP_FACTOR = 3.0
"""Times the usual interval that a gap exceeds."""
MEMORY = 0.1
"""Weight of the newest interval in the usual one: ten scans."""


@kernel
def is_gap(seconds: float, usual: float, least: float) -> bool:
    """Return whether an interval is a gap: longer than `least` s, and than the usual one by far."""
    return seconds > max(least, GAP_FACTOR * usual)


@kernel
def updated_interval(usual: float, seconds: float) -> float:
    """Return the usual interval, s, after one of `seconds`; it is 0 before the first."""
    return usual + (MEMORY if usual > 0.0 else 1.0) * (seconds - usual)
