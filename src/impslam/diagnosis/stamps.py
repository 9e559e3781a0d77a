"""What is wrong with the stamps of scans: late, jittering, and sweeps that overlap."""

from __future__ import annotations

from collections.abc import Iterator

from impslam.diagnosis.evidence import Evidence
from impslam.diagnosis.finding import Finding, certainty, is_off
from impslam.diagnosis.timing import LATE
from impslam.health import MISTIMED, Standing

OVERLAP = 1.1
"""Times the median time between scans that a sweep takes at most; drivers round."""
QUEUED = 0.2
"""s: where scans are matched the path is right but for the moment that it is stamped with. Drivers stamp a
sweep or two late; more is a queue or another clock, and 10 cm at half a metre per second."""


def overlap(e: Evidence) -> Iterator[Finding]:
    """Find sweeps that are said to take longer than there is time for."""
    sweep = max((float(c["time_offsets"].max(initial=0.0)) for c in e.recording.scans), default=0.0)
    period = e.timing.period
    if e.lidar.deskew and period and sweep > OVERLAP * period:
        yield Finding(
            "sweep too long",
            f"a sweep takes {sweep:.3f} s by its beams' times, but scans come every {period:.3f} s",
            (f"{e.place}.deskew=false",),
            advice="time_increment in the log is wrong",
        )


def stamps(e: Evidence) -> Iterator[Finding]:
    """Find stamps that jitter, or that are late or early by a constant time."""
    if e.timing.jitters:
        yield _jitter(e)
    elif e.timing.is_late:
        yield _late(e)


def _jitter(e: Evidence) -> Finding:
    raw, smooth, period = e.timing.lag, e.timing.smooth, e.timing.period
    assert raw is not None
    assert smooth is not None
    return Finding(
        "stamps jitter",
        f"scans are stamped {1000.0 * e.timing.jitter:.0f} ms (rms) early or late: with one every "
        f"{period:.4g} s turns fit odometry {raw.rms / smooth.rms:.1f} times as well",
        (f"{e.place}.period={period:.4g}", f"{e.place}.latency={smooth.seconds:.3f}"),
        harmful=not e.matches_scans,
        health=Standing(MISTIMED, e.timing.jitter),
    )


def _late(e: Evidence) -> Finding:
    late, said = e.timing.lag, ""
    assert late is not None
    off = late.seconds - e.lidar.latency
    if e.lidar.latency:
        said = f"; {e.place}.latency says {e.lidar.latency:g} s"
    return Finding(
        "stamps late",
        f"scans are stamped {abs(late.seconds):.3f} ± {max(late.sigma, 1e-3):.3f} s "
        f"{'late' if late.seconds > 0.0 else 'early'} on the clock of odometry{said}",
        (f"{e.place}.latency={late.seconds:.3f}",),
        certainty(off, late.sigma, LATE),
        harmful=not e.matches_scans or is_off(off, late.sigma, QUEUED),
        health=Standing(MISTIMED, abs(off)),
    )
