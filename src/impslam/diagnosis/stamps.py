"""What is wrong with the stamps of scans by themselves: jitter, and sweeps that overlap."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from impslam.diagnosis.evidence import Evidence
from impslam.diagnosis.finding import SUREST, Finding
from impslam.diagnosis.lag import lag
from impslam.sensors.clock import SweepClock

BETTER = 0.8
"""Ratio of the turns' residuals with smoothed stamps to those with the log's, below which the log's jitter:
with a hundred turns chance does not reach it (F-test, 1e-3)."""
OVERLAP = 1.1
"""Times the median time between scans that a sweep takes at most; drivers round."""


def stamps(e: Evidence) -> list[Finding]:
    """Find stamps that jitter, and sweeps that are said to take longer than there is time for."""
    return [*_overlap(e), *_jitter(e)]


def _period(e: Evidence) -> float:
    steps = np.diff(e.laser.stamps)
    return float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0


def _overlap(e: Evidence) -> Iterator[Finding]:
    sweep = max((float(c["time_offsets"].max(initial=0.0)) for c in e.recording.scans), default=0.0)
    period = _period(e)
    if e.lidar.deskew and period and sweep > OVERLAP * period:
        yield Finding(
            "sweep too long",
            f"a sweep takes {sweep:.3f} s by its beams' times, but scans come every {period:.3f} s",
            (f"{e.place}.deskew=false",),
            SUREST,
            "time_increment in the log is wrong",
        )


def _jitter(e: Evidence) -> Iterator[Finding]:
    period = _period(e)
    if e.lidar.period or e.lag is None or not period:
        return
    smooth = SweepClock(period).smooth(np.ascontiguousarray(e.laser.stamps))
    better = lag(e.laser._replace(stamps=smooth), e.odometer)
    if better is None or better.scale > BETTER * e.lag.scale:
        return
    rms = 1000.0 * float(np.std(e.laser.stamps - smooth))
    yield Finding(
        "stamps jitter",
        f"scans are stamped {rms:.0f} ms (rms) early or late: with one every {period:.4g} s turns fit "
        f"odometry {e.lag.scale / better.scale:.1f} times as well",
        (f"{e.place}.period={period:.4g}", f"{e.place}.latency={better.seconds:.3f}"),
    )
