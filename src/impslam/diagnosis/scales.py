"""Check the scales of odometry's distances and turns, and attribute errors to wheels, track or ranges."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from pydantic import ValidationError

from impslam.diagnosis.agreement import MIN_SCALE, Agreement, fit_agreement
from impslam.diagnosis.evidence import Evidence
from impslam.diagnosis.finding import SIGMAS, Finding, is_off, probability_off
from impslam.diagnosis.handedness import check_handedness
from impslam.diagnosis.odometry import find_unsigned
from impslam.health import MISSCALED, NO_FAULT, LogFault
from impslam.noise import MotionNoise
from impslam.odometry.base import Odometry
from impslam.odometry.encoders import Encoders
from impslam.odometry.odometry_pose import OdometryPoses

MATCHING_FACTOR = 3.0
"""Tolerated error of odometry, in multiples of its noise, if scans are matched: it is then only a guess."""
MAX_WHEEL_SCALE = 3.0
"""Distance scale beyond which not the wheel's radius is wrong, but the unit of the readings."""
MIN_SIGMA = 1e-9
"""Lower bound of the standard deviation of a scale: if odometry hardly moves, its errors are as small."""
RANGES, HALF = "range scale", 0.5
"""A kind that wrong lengths of odometry explain equally well, and its probability."""
NO_FIX = "no setting fixes it"


def check_scales(e: Evidence) -> Iterator[Finding]:
    """Find unequal wheels, and scale errors that remain without them."""
    if e.agreement is None or not (e.odometry_moves and e.drives_ahead) or check_handedness(e):
        return
    agreed = e.agreement
    if any(find_unsigned(e)):
        ahead = e.axle_motion[:, 0] > 0.0
        agreed = fit_agreement(e.axle_motion[ahead], e.odometry_motion[ahead], e.resolution)
    unequal = list(_unequal(e, agreed))
    yield from unequal
    left = _left_scale(e, agreed) if unequal else 1.0
    yield from _scales(e, Agreement(agreed.distance.scaled(left), agreed.turn.scaled(left)))


def _left_scale(e: Evidence, agreed: Agreement) -> float:
    """Return the factor on distances that corrects the right wheel to the size of the left one."""
    if not isinstance(e.odometry, Encoders):
        return 1.0
    a, c = float(agreed.distance.p[0]), float(agreed.turn.p[0])
    return (a - 0.5 * e.odometry.track * c) / a


def _scales(e: Evidence, agreed: Agreement) -> Iterator[Finding]:
    """Compare the distance and turn scales with odometry's noise over a metre or a radian."""
    distance, turn = agreed.distance, agreed.turn
    a, d = float(distance.p[0]), float(turn.p[1])
    allowed = _allowed(e)
    tests = ((a - 1.0, distance.sigma[0], allowed[0]), (d - 1.0, turn.sigma[1], allowed[1]))
    if not any(is_off(*test) for test in tests):
        return
    kind, fix, advice = _attribute_error(e, agreed)
    if not _are_possible(e.odometry, fix):
        fix, advice = (), NO_FIX
    factor = MATCHING_FACTOR if e.matches_scans else 1.0
    by_distance, by_turn = (abs(o) if abs(o) > factor * limit else 0.0 for o, _, limit in tests)
    # Matched scans measure turns, and distances in the scale of the ranges.
    amount = by_distance if e.matches_scans else max(by_distance, by_turn)
    yield Finding(
        kind,
        f"odometry reports {a:.3f} ± {max(distance.sigma[0], 1e-3):.3f} times the distance and {d:.3f} ± "
        f"{max(turn.sigma[1], 1e-3):.3f} times the turns of the laser",
        fix,
        HALF if kind == RANGES else max(probability_off(*test) for test in tests),
        advice,
        by_distance > 0.0 or by_turn > 0.0,
        LogFault(MISSCALED, amount) if amount else NO_FAULT,
        e.name if kind == RANGES else "",
    )


def _noise(e: Evidence) -> MotionNoise:
    noise = getattr(e.odometry, "slip", getattr(e.odometry, "noise", MotionNoise()))
    assert isinstance(noise, MotionNoise)
    return noise


def _allowed(e: Evidence) -> tuple[float, float]:
    """Return the noise of odometry over a metre, and over a radian, as shares."""
    noise, wheel = _noise(e), getattr(e.odometry, "wheel_noise", 0.0)
    return math.hypot(noise.forward, wheel), noise.turn_per_turn


def _attribute_error(e: Evidence, agreed: Agreement) -> tuple[str, tuple[str, ...], str]:
    """Return the kind of the error, the settings that fix it, and another possible cause.

    A single error is likelier than two: the track alone (a = 1), the wheels' radius alone (a = d), or the
    ranges alone (d = 1, because turns do not depend on ranges).
    """
    distance, turn = agreed.distance, agreed.turn
    a, d = float(distance.p[0]), float(turn.p[1])
    if min(a, d) < MIN_SCALE:
        return "odometry scale", (), NO_FIX
    sigma_a, sigma_d = np.fmax((distance.sigma[0], turn.sigma[1]), MIN_SIGMA).tolist()
    misfits = {
        "track": abs(a - 1.0) / sigma_a,
        "wheel radius": abs(a - d) / math.hypot(sigma_a, sigma_d),
        RANGES: abs(d - 1.0) / sigma_d,
    }
    kind = min(misfits, key=misfits.__getitem__)
    ranges = f"{e.lidar_key}.range_scale={e.lidar.range_scale * a:.4f}"
    if not isinstance(e.odometry, Encoders):
        distance_fix, turn_fix = _pose_settings(e.odometry, a, d)
        if kind == RANGES:
            return (
                kind,
                (ranges,),
                _alternative(distance_fix, "odometry's distances are off by as much"),
            )
        fix = turn_fix if kind == "track" else distance_fix + turn_fix
        return "odometry scale", fix, "" if fix else NO_FIX
    track = e.odometry.track * d / a
    wheels = _distance_setting(e.odometry, a), f"odometry.track={track:.4g}"
    if kind == RANGES:
        return kind, (ranges,), _alternative(wheels, "")
    if kind == "track":
        return kind, (f"odometry.track={e.odometry.track * d:.4g}",), ""
    return kind, wheels[:1] if misfits[kind] < SIGMAS else wheels, ""


def _are_possible(odometry: Odometry, fix: tuple[str, ...]) -> bool:
    """Return whether the settings of odometry are within the limits of its parameters."""
    pairs = (one.removeprefix("odometry.").split("=") for one in fix if one.startswith("odometry."))
    changes = {name: float(value) for name, value in pairs}
    try:
        type(odometry).model_validate({**odometry.model_dump(), **changes})
    except ValidationError:
        return False
    return True


def _alternative(settings: tuple[str, ...], otherwise: str) -> str:
    """Return the words for other settings that may be meant."""
    return f"or {' '.join(f'--set {one}' for one in settings) or otherwise}"


def _pose_settings(
    odometry: Odometry, a: float, d: float
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the settings for distance and turn scales of odometry without wheels, if it has any."""
    names = type(odometry).model_fields
    distances = [name for name in ("distance_scale", "speed_scale") if name in names]
    turns = [name for name in ("turn_scale",) if name in names]
    return (
        tuple(f"odometry.{name}={getattr(odometry, name) / a:.4g}" for name in distances),
        tuple(f"odometry.{name}={getattr(odometry, name) / d:.4g}" for name in turns),
    )


def _distance_setting(odometry: Encoders, scale: float) -> str:
    """Return the setting that fixes a distance scale: the wheel radius or, for a gross error, the ticks."""
    if 1.0 / MAX_WHEEL_SCALE < scale < MAX_WHEEL_SCALE:
        return f"odometry.wheel_radius={odometry.wheel_radius / scale:.4g}"
    return f"odometry.per_turn={odometry.per_turn * scale:.6g}"


def _unequal(e: Evidence, agreed: Agreement) -> Iterator[Finding]:
    """Find a turn per metre: one wheel is larger than the other, or the drive pulls to one side."""
    pull, sigma = float(agreed.turn.p[0]), float(agreed.turn.sigma[0])
    noise = _noise(e).turn_per_distance  # over a metre
    if not is_off(pull, sigma, noise):
        return
    fix: tuple[str, ...] = ()
    if isinstance(e.odometry, Encoders):
        half, a = 0.5 * e.odometry.track * pull, float(agreed.distance.p[0])
        ratio = e.odometry.right_left_ratio * (a - half) / (a + half)
        fix = (f"odometry.right_left_ratio={ratio:.4f}",)
        fix = fix if _are_possible(e.odometry, fix) else ()
    elif isinstance(e.odometry, OdometryPoses):
        turn = e.odometry.turn_per_metre - pull * e.odometry.distance_scale
        fix = (f"odometry.turn_per_metre={turn:.4f}",)
    yield Finding(
        "wheels unequal",
        f"odometry turns by {pull:+.3f} ± {max(sigma, 1e-3):.3f} rad per metre of straight driving",
        fix,
        probability_off(pull, sigma, noise),
        "" if fix else NO_FIX,
        abs(pull) > (MATCHING_FACTOR if e.matches_scans else 1.0) * noise,
    )
