"""What odometry gets wrong of ways and turns: scale, track, unsigned, standing still, late."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from impslam.diagnosis.agreement import Agreement
from impslam.diagnosis.evidence import LATE, Evidence
from impslam.diagnosis.finding import SIGMAS, Finding, certainty, is_off
from impslam.diagnosis.handedness import handedness
from impslam.noise import MotionNoise
from impslam.odometry.encoders import Encoders

COPES = 3.0
"""Times its declared noise that odometry may be off by where scans are matched: it is then a guess only."""
GROSS = 3.0
"""Times the way beyond which a reading is no turn of another wheel, but another unit."""
FEWEST_BACK = 5
"""Stretches backward from which on odometry without a sign shows."""
MOST_OTHER = 0.2
"""Share of stretches that may contradict: slips."""


def odometry(e: Evidence) -> list[Finding]:
    """Find what odometry gets wrong."""
    if e.agreement is None:
        return []
    if still := _stands_still(e):
        return [still]
    return [*_unsigned(e), *_lag(e), *([] if handedness(e) else _shape(e))]


def _stands_still(e: Evidence) -> Finding | None:
    if np.abs(e.gone[:, [0, 2]]).max() > 1e-6:
        return None
    way, turn = np.abs(e.axle).sum(axis=0)
    return Finding(
        "odometry stands still",
        f"odometry stands still while the laser goes {way:.1f} m and turns {math.degrees(turn):.0f} deg",
        ("odometry.kind=lidar_only",),
    )


def _unsigned(e: Evidence) -> Iterator[Finding]:
    """Find odometry that logs ways backward as forward; slips are rare, and go either way."""
    far = np.abs(e.axle[:, 0]) > 0.5 * np.abs(e.axle).max(initial=0.0)
    far &= np.abs(e.gone[:, 0]) > 0.5 * np.abs(e.axle[:, 0])
    back, ahead = far & (e.axle[:, 0] < 0.0), far & (e.axle[:, 0] > 0.0)
    if min(back.sum(), ahead.sum()) < FEWEST_BACK:
        return
    wrong, right = (e.gone[back, 0] > 0.0).mean(), (e.gone[ahead, 0] > 0.0).mean()
    if min(wrong, right) >= 1.0 - MOST_OTHER:
        way = -float(e.axle[back, 0].sum())
        yield Finding(
            "odometry unsigned",
            f"odometry cannot tell backward from forward: {back.sum()} stretches backward, {way:.1f} m, "
            "are logged as forward",
            () if e.config.tracker["kind"] == "scan_to_map" else ("tracker.kind=scan_to_map",),
            advice="a run follows the scans there",
            harmful=not matches_scans(e),
        )


def _lag(e: Evidence) -> Iterator[Finding]:
    if e.lag is not None and e.is_late:
        how = "late" if e.lag.seconds > 0.0 else "early"
        said = f"; sensors.{e.name}.latency says {e.lidar.latency:g} s" if e.lidar.latency else ""
        yield Finding(
            "stamps late",
            f"scans are stamped {abs(e.lag.seconds):.3f} ± {max(e.lag.sigma, 1e-3):.3f} s {how} on the "
            f"clock of odometry{said}",
            (f"{e.place}.latency={e.lag.seconds:.3f}",),
            certainty(e.lag.seconds - e.lidar.latency, e.lag.sigma, LATE),
            harmful=not matches_scans(e),
        )


def matches_scans(e: Evidence) -> bool:
    """Tell whether a run follows scans, and odometry is a guess only."""
    return e.config.make_tracker().matches_scans


def _shape(e: Evidence) -> Iterator[Finding]:
    """Find wheels that differ, and what then is left of errors of scale."""
    assert e.agreement is not None
    unequal = list(_unequal(e))
    yield from unequal
    a, left = float(e.agreement.way.p[0]), 1.0
    if unequal and isinstance(
        e.odometry, Encoders
    ):  # with the right wheel as large as the left one
        left = (a - 0.5 * e.odometry.track * float(e.agreement.turn.p[0])) / a
    scaled = Agreement(e.agreement.way.times(left), e.agreement.turn.times(left))
    yield from _scales(e, scaled)


def _scales(e: Evidence, agreed: Agreement) -> Iterator[Finding]:
    """Compare scales of ways and turns with what odometry's noise over a metre or a radian allows."""
    way, turn = agreed.way, agreed.turn
    a, d = float(way.p[0]), float(turn.p[1])
    allowed = _allowed(e)
    tests = ((a - 1.0, way.sigma[0], allowed[0]), (d - 1.0, turn.sigma[1], allowed[1]))
    if not any(is_off(*test) for test in tests):
        return
    kind, fix, advice = _mended(e, agreed)
    copes = COPES if matches_scans(e) else 1.0
    yield Finding(
        kind,
        f"odometry logs {a:.3f} ± {max(way.sigma[0], 1e-3):.3f} times the way and {d:.3f} ± "
        f"{max(turn.sigma[1], 1e-3):.3f} times the turns of the laser",
        fix,
        max(certainty(*test) for test in tests),
        advice,
        any(abs(off) > copes * limit for off, _, limit in tests),
    )


def _noise(e: Evidence) -> MotionNoise:
    noise = getattr(e.odometry, "slip", getattr(e.odometry, "noise", MotionNoise()))
    assert isinstance(noise, MotionNoise)
    return noise


def _allowed(e: Evidence) -> tuple[float, float]:
    """Return what odometry is said to stray by over a metre, and over a radian, as shares."""
    noise, wheel = _noise(e), getattr(e.odometry, "wheel_noise", 0.0)
    return math.hypot(noise.forward, wheel), noise.turn_per_turn


def _mended(e: Evidence, agreed: Agreement) -> tuple[str, tuple[str, ...], str]:
    """Return the kind of what is off, its settings, and what else it may be.

    One thing wrong is likelier than two: the track alone (a = 1), the wheels' radius alone (a = d), or the
    ranges alone (d = 1, for turns do not depend on ranges).
    """
    way, turn = agreed.way, agreed.turn
    a, d = float(way.p[0]), float(turn.p[1])
    both = math.hypot(way.sigma[0], turn.sigma[1])
    misfits = {
        "track": abs(a - 1.0) / way.sigma[0],
        "wheel radius": abs(a - d) / both,
        "ranges scale": abs(d - 1.0) / turn.sigma[1],
    }
    kind = min(misfits, key=misfits.__getitem__)
    ranges = f"{e.place}.range_scale={e.lidar.range_scale * a:.4f}"
    if not isinstance(e.odometry, Encoders):
        short = kind == "ranges scale"
        other = f"; or, if ranges are off, --set {ranges}" if short else ""
        return "odometry scale", (), f"no setting mends it; calibrate the odometry{other}"
    track = e.odometry.track * d / a
    wheels = _way_setting(e.odometry, a), f"odometry.track={track:.4g}"
    if kind == "ranges scale":
        return kind, (ranges,), f"or --set {wheels[0]} --set {wheels[1]}"
    if kind == "track":
        return kind, (f"odometry.track={e.odometry.track * d:.4g}",), ""
    return kind, wheels[:1] if misfits[kind] < SIGMAS else wheels, ""


def _way_setting(odometry: Encoders, scale: float) -> str:
    """Return what mends a scale of ways: the radius, or where no wheel is so large or small, the ticks."""
    if 1.0 / GROSS < scale < GROSS:
        return f"odometry.wheel_radius={odometry.wheel_radius / scale:.4g}"
    return f"odometry.per_turn={odometry.per_turn * scale:.6g}"


def _unequal(e: Evidence) -> Iterator[Finding]:
    """Find a turn per metre of way: one wheel is larger than the other, or the drive pulls to a side."""
    assert e.agreement is not None
    pull, sigma = float(e.agreement.turn.p[0]), float(e.agreement.turn.sigma[0])
    noise = _noise(e).turn_per_distance  # over a metre
    if not is_off(pull, sigma, noise):
        return
    fix: tuple[str, ...] = ()
    if isinstance(e.odometry, Encoders):
        half, a = 0.5 * e.odometry.track * pull, float(e.agreement.way.p[0])
        ratio = e.odometry.right_left_ratio * (a - half) / (a + half)
        fix = (f"odometry.right_left_ratio={ratio:.4f}",)
    yield Finding(
        "wheels unequal",
        f"odometry turns by {pull:+.3f} ± {max(sigma, 1e-3):.3f} rad per metre of straight way",
        fix,
        certainty(pull, sigma, noise),
        "" if fix else "no setting mends it; calibrate the odometry",
        abs(pull) > (COPES if matches_scans(e) else 1.0) * noise,
    )
