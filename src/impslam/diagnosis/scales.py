"""By how much odometry's ways and turns are off, and which wheel, track or range that comes from."""

from __future__ import annotations

import math
from collections.abc import Iterator

from impslam.diagnosis.agreement import Agreement, agreement
from impslam.diagnosis.evidence import Evidence
from impslam.diagnosis.finding import SIGMAS, Finding, certainty, is_off
from impslam.diagnosis.handedness import handedness
from impslam.diagnosis.odometry import unsigned
from impslam.health import MISSCALED, Standing
from impslam.noise import MotionNoise
from impslam.odometry.base import Odometry
from impslam.odometry.encoders import Encoders
from impslam.odometry.odometry_pose import OdometryPoses

COPES = 3.0
"""Times its declared noise that odometry may be off by where scans are matched: it is then a guess only."""
GROSS = 3.0
"""Times the way beyond which a reading is no turn of another wheel, but another unit."""
RANGES, HALF = "ranges scale", 0.5
"""A kind that odometry's own lengths explain as well."""
UNMENDED = "no setting fixes it"


def scales(e: Evidence) -> Iterator[Finding]:
    """Find wheels that differ, and what then is left of errors of scale."""
    if e.agreement is None or not e.goes or handedness(e):
        return
    agreed = e.agreement
    if any(unsigned(e)):
        ahead = e.axle[:, 0] > 0.0
        agreed = agreement(e.axle[ahead], e.gone[ahead])
    unequal = list(_unequal(e, agreed))
    yield from unequal
    left = _left_scale(e, agreed) if unequal else 1.0
    yield from _scales(e, Agreement(agreed.way.times(left), agreed.turn.times(left)))


def _left_scale(e: Evidence, agreed: Agreement) -> float:
    """Return what ways are scaled by once the right wheel is as large as the left one."""
    if not isinstance(e.odometry, Encoders):
        return 1.0
    a, c = float(agreed.way.p[0]), float(agreed.turn.p[0])
    return (a - 0.5 * e.odometry.track * c) / a


def _scales(e: Evidence, agreed: Agreement) -> Iterator[Finding]:
    """Compare scales of ways and turns with what odometry's noise over a metre or a radian allows."""
    way, turn = agreed.way, agreed.turn
    a, d = float(way.p[0]), float(turn.p[1])
    allowed = _allowed(e)
    tests = ((a - 1.0, way.sigma[0], allowed[0]), (d - 1.0, turn.sigma[1], allowed[1]))
    if not any(is_off(*test) for test in tests):
        return
    kind, fix, advice = _mended(e, agreed)
    copes = COPES if e.matches_scans else 1.0
    yield Finding(
        kind,
        f"odometry logs {a:.3f} ± {max(way.sigma[0], 1e-3):.3f} times the way and {d:.3f} ± "
        f"{max(turn.sigma[1], 1e-3):.3f} times the turns of the laser",
        fix,
        HALF if kind == RANGES else max(certainty(*test) for test in tests),
        advice,
        any(abs(off) > copes * limit for off, _, limit in tests),
        Standing(MISSCALED, max(abs(off) for off, *_ in tests)),
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
        RANGES: abs(d - 1.0) / turn.sigma[1],
    }
    kind = min(misfits, key=misfits.__getitem__)
    ranges = f"{e.place}.range_scale={e.lidar.range_scale * a:.4f}"
    if not isinstance(e.odometry, Encoders):
        way_fix, turn_fix = _pose_settings(e.odometry, a, d)
        if kind == RANGES:
            return kind, (ranges,), _or(way_fix, "odometry's ways are off by as much")
        fix = turn_fix if kind == "track" else way_fix + turn_fix
        return "odometry scale", fix, "" if fix else UNMENDED
    track = e.odometry.track * d / a
    wheels = _way_setting(e.odometry, a), f"odometry.track={track:.4g}"
    if kind == RANGES:
        return kind, (ranges,), _or(wheels, "")
    if kind == "track":
        return kind, (f"odometry.track={e.odometry.track * d:.4g}",), ""
    return kind, wheels[:1] if misfits[kind] < SIGMAS else wheels, ""


def _or(settings: tuple[str, ...], otherwise: str) -> str:
    """Return the words for other settings that may be meant."""
    return f"or {' '.join(f'--set {one}' for one in settings) or otherwise}"


def _pose_settings(
    odometry: Odometry, a: float, d: float
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the settings for scales of ways and of turns of odometry without wheels, if it has any."""
    names = type(odometry).model_fields
    ways = [name for name in ("distance_scale", "speed_scale") if name in names]
    turns = [name for name in ("turn_scale",) if name in names]
    return (
        tuple(f"odometry.{name}={getattr(odometry, name) / a:.4g}" for name in ways),
        tuple(f"odometry.{name}={getattr(odometry, name) / d:.4g}" for name in turns),
    )


def _way_setting(odometry: Encoders, scale: float) -> str:
    """Return what mends a scale of ways: the radius, or where no wheel is so large or small, the ticks."""
    if 1.0 / GROSS < scale < GROSS:
        return f"odometry.wheel_radius={odometry.wheel_radius / scale:.4g}"
    return f"odometry.per_turn={odometry.per_turn * scale:.6g}"


def _unequal(e: Evidence, agreed: Agreement) -> Iterator[Finding]:
    """Find a turn per metre of way: one wheel is larger than the other, or the drive pulls to a side."""
    pull, sigma = float(agreed.turn.p[0]), float(agreed.turn.sigma[0])
    noise = _noise(e).turn_per_distance  # over a metre
    if not is_off(pull, sigma, noise):
        return
    fix: tuple[str, ...] = ()
    if isinstance(e.odometry, Encoders):
        half, a = 0.5 * e.odometry.track * pull, float(agreed.way.p[0])
        ratio = e.odometry.right_left_ratio * (a - half) / (a + half)
        fix = (f"odometry.right_left_ratio={ratio:.4f}",)
    elif isinstance(e.odometry, OdometryPoses):
        turn = e.odometry.turn_per_metre - pull * e.odometry.distance_scale
        fix = (f"odometry.turn_per_metre={turn:.4f}",)
    yield Finding(
        "wheels unequal",
        f"odometry turns by {pull:+.3f} ± {max(sigma, 1e-3):.3f} rad per metre of straight way",
        fix,
        certainty(pull, sigma, noise),
        "" if fix else UNMENDED,
        abs(pull) > (COPES if e.matches_scans else 1.0) * noise,
    )
