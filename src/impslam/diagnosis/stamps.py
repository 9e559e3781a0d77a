"""Check the stamps of scans: their lag and jitter, and whether they share their clock with odometry."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from impslam.diagnosis.evidence import Evidence
from impslam.diagnosis.file_order import without_repeats
from impslam.diagnosis.finding import Finding, is_off, probability_off
from impslam.diagnosis.lag import Lag
from impslam.health import MISTIMED, LogFault

MAX_SHARED = 0.5
"""Share of scans with the stamp of the scan before, beyond which stamps do not tell their times."""
QUEUE_LAG = 0.2
"""s: if scans are matched, only the stamps of the path are wrong. Drivers stamp a sweep or two late; more
is a queue or another clock, and 10 cm at half a metre per second."""


def check_clocks(e: Evidence) -> Iterator[Finding]:
    """Find scans whose stamps are of another clock than those of odometry: they share no time."""
    scans, readings = e.recording.scans, e.recording.odometry
    if e.untimed or not scans or not readings:
        return
    # The first row of a stream with earlier stamps than the log so far is placed by order.
    taken, known = (np.concatenate([c.stamps for c in one])[1:] for one in (scans, readings))
    if not len(taken) or not len(known):
        return
    off = taken - e.lidar.latency
    if off.max() >= known.min() and off.min() <= known.max():
        return
    orders, others = (np.concatenate([c.order for c in one])[1:] for one in (scans, readings))
    before = np.maximum(np.searchsorted(others, orders) - 1, 0)
    late = float(np.median(taken - known[before]))
    yield Finding(
        "clocks differ",
        f"scans are stamped {taken.min():.3f} to {taken.max():.3f} s, odometry {known.min():.3f} to "
        f"{known.max():.3f} s",
        (f"{e.lidar_key}.latency={late:.3f}",),
        advice="the difference is that by the order of the log; inspect it again with this setting",
        fault=LogFault(MISTIMED, abs(late - e.lidar.latency)),
        lidar=e.name,
    )


def check_repeats(e: Evidence) -> Iterator[Finding]:
    """Find stamps that most scans share with the scan before, e.g. those in whole seconds."""
    if e.untimed or not e.recording.scans:
        return
    scans = without_repeats(e.recording).scans
    steps = np.diff(np.concatenate([c.stamps for c in scans]))
    shared = int((steps == 0.0).sum())
    if shared > MAX_SHARED * len(steps):
        interval = float(np.median(steps[steps > 0.0])) if steps.any() else 0.0
        steps_of = f": stamps come in steps of {interval:.3g} s" if interval else ""
        yield Finding(
            "stamps repeat",
            f"{shared} of {len(steps) + 1} scans have the stamp of the scan before{steps_of}, so lags and "
            "speeds are unknown, and odometry was not checked",
            certainty=1.0,
            advice="record or export the log with stamps in ms or finer",
            lidar=e.name,
        )


def check_stamps(e: Evidence) -> Iterator[Finding]:
    """Find stamps that jitter, or that are late or early by a constant time."""
    if e.timing.jitters:
        yield _jitter(e)
    elif e.timing.is_late:
        yield _late(e)


def _jitter(e: Evidence) -> Finding:
    raw, smooth, period = e.timing.lag, e.timing.smooth, e.timing.period
    assert raw is not None
    assert smooth is not None
    off = smooth.seconds - e.lidar.latency
    return Finding(
        "stamps jitter",
        f"scans are stamped {1000.0 * e.timing.jitter:.0f} ms (rms) early or late: with a steady period of "
        f"{period:.4g} s, turns fit odometry {raw.rms / smooth.rms:.1f} times as well",
        (f"{e.lidar_key}.period={period:.4g}", f"{e.lidar_key}.latency={smooth.seconds:.3f}"),
        harmful=_is_harmful(e, smooth),
        fault=LogFault(MISTIMED, max(e.timing.jitter, abs(off))),
        lidar=e.name,
    )


def _late(e: Evidence) -> Finding:
    late, configured = e.timing.lag, ""
    assert late is not None
    off = late.seconds - e.lidar.latency
    if e.lidar.latency:
        configured = f"; {e.lidar_key}.latency is {e.lidar.latency:g} s"
    return Finding(
        "stamps late",
        f"scans are stamped {abs(late.seconds):.3f} ± {max(late.sigma, 1e-3):.3f} s "
        f"{'late' if late.seconds > 0.0 else 'early'} on the clock of odometry{configured}",
        (f"{e.lidar_key}.latency={late.seconds:.3f}",),
        probability_off(off, late.sigma, e.timing.tolerance),
        harmful=_is_harmful(e, late),
        fault=LogFault(MISTIMED, abs(off)),
        lidar=e.name,
    )


def _is_harmful(e: Evidence, lag: Lag) -> bool:
    """Return whether a lag harms a run.

    One that follows the scans, and no other lidar's, does so at whatever times they were taken. Then only a
    queue's lag does harm.
    """
    tolerates_times = e.matches_scans and e.is_alone
    return not tolerates_times or is_off(lag.seconds - e.lidar.latency, lag.sigma, QUEUE_LAG)
