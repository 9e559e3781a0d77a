"""Check the signs of scans and odometry: mirrored scans, swapped and reversed wheels.

With unit scales, the fits S = a F + b T and R = c F + d T (see `agreement`) show which signs are wrong:

    a > 0, d > 0     correct                           b, c large, a, d ~ 0   one wheel counts backward
    a > 0, d < 0     turns are opposite: the scan is mirrored, or the wheels are swapped
    a < 0, d > 0     distances are opposite: the laser faces backward (see `mount`)
    a < 0, d < 0     both: both wheels count backward, or the lidar is upside down and faces backward

Mirrored scans are consistent with a mirrored world, so laser and wheels alone cannot show which of them is
wrong. A gyro can.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.diagnosis.agreement import axis_by_odometry
from impslam.diagnosis.evidence import Evidence
from impslam.diagnosis.finding import MAX_PROBABILITY, Finding
from impslam.diagnosis.robust import CLEAR
from impslam.geometry.angles import wrap
from impslam.health import OPPOSED, LogFault
from impslam.odometry.encoders import Encoders
from impslam.types import Array

HALF = 0.5
MIRROR = np.array([1.0, -1.0, -1.0])
"""Factors on a motion as a mirrored scan shows it."""
OPPOSED_LOG = LogFault(OPPOSED)
"""Why no pose of a run with such a log can be trusted."""


def check_handedness(e: Evidence) -> list[Finding]:
    """Find mirrored scans, swapped wheels and reversed wheels."""
    if e.agreement is None:
        return []
    if finding := _one_wheel(e):
        return [finding]
    if not e.agreement.opposes_turn:
        return []
    return _all_opposite(e) if e.agreement.opposes_distance else _opposite_turns(e)


def _one_wheel(e: Evidence) -> Finding | None:
    """Find a wheel that counts backward: odometry then reports distances as turns and vice versa."""
    assert e.agreement is not None
    if not isinstance(e.odometry, Encoders):
        return None
    distance, turn, half = e.agreement.distance, e.agreement.turn, 0.5 * e.odometry.track
    b, c = distance.p[1] / half, turn.p[0] * half
    crossed = abs(c) > CLEAR * turn.sigma[0] * half and abs(b) > CLEAR * distance.sigma[1] / half
    if not crossed or min(abs(b), abs(c)) < HALF or max(abs(distance.p[0]), abs(turn.p[1])) > HALF:
        return None
    side = "left" if c > 0.0 else "right"
    return Finding(
        "wheel reversed",
        f"the {side} wheel counts backward: while driving straight the robot seems to turn by "
        f"{abs(turn.p[0]):.2g} rad/m",
        (f"odometry.reversed={side}",),
        fault=OPPOSED_LOG,
    )


def _opposite_turns(e: Evidence) -> list[Finding]:
    what = "scans and odometry turn in opposite directions"
    vote = 1 if e.is_odometry_confirmed else _gyro_vote(e)
    mirrored = Finding(
        "scan mirrored",
        f"{what}: the scan is mirrored, or the lidar is mounted upside down",
        _unmirror_settings(e),
        MAX_PROBABILITY if vote > 0 else HALF,
        "" if vote > 0 else f"or {_swapped_words(e)}; a gyro would decide",
        lidar=e.name,
        fault=OPPOSED_LOG,
    )
    swapped = Finding(
        "wheels swapped",
        f"{what}, and the gyro turns as the scans do: {_swapped_words(e)}",
        ("odometry.swapped=true",) if isinstance(e.odometry, Encoders) else (),
        fault=OPPOSED_LOG,
    )
    return [swapped if vote < 0 else mirrored]


def _swapped_words(e: Evidence) -> str:
    if isinstance(e.odometry, Encoders):
        return "left and right wheel are swapped (--set odometry.swapped=true)"
    return "odometry turns the wrong way"


def _all_opposite(e: Evidence) -> list[Finding]:
    what = "scans and odometry drive and turn in opposite directions"
    inverted = _unmirror_settings(e, turned=True)
    if not isinstance(e.odometry, Encoders) or e.is_odometry_confirmed:
        words = f"{what}: the lidar is upside down and faces backward"
        return [Finding("scan mirrored", words, inverted, lidar=e.name, fault=OPPOSED_LOG)]
    other = " ".join(f"--set '{one}'" for one in inverted)
    return [
        Finding(
            "wheels reversed",
            f"{what}: both wheels count backward",
            ("odometry.reversed=both",),
            HALF,
            f"or the lidar is upside down and faces backward ({other})",
            fault=OPPOSED_LOG,
        )
    ]


def _unmirror_settings(e: Evidence, *, turned: bool = False) -> tuple[str, ...]:
    """Return the settings that mirror the scan, and that turn it if its axis requires it."""
    assert e.axis is not None
    fix = f"{e.lidar_key}.upside_down={str(not e.lidar.upside_down).lower()}"
    if e.axis.has_axle:
        yaw = wrap(e.axis.angle + (math.pi if turned else 0.0))
    else:
        yaw = -axis_by_odometry(e.lidar_motion * MIRROR, e.odometry_motion).angle
    x, y, given = e.lidar.mount
    if abs(wrap(yaw - given)) < math.radians(3.0):
        return (fix,)
    return fix, f"{e.lidar_key}.mount=[{x:.3f},{y:.3f},{yaw:.3f}]"


def _gyro_vote(e: Evidence) -> int:
    """Return 1 if the gyro agrees with odometry, -1 if it agrees with the scans, 0 if unclear."""
    gyro = e.recording.gyro
    if len(gyro) < 2 or not len(e.times):
        return 0
    turned = _integrated(gyro, e.times)
    correlations = [
        _correlation(turned, other) for other in (e.odometry_motion[:, 2], e.lidar_motion[:, 2])
    ]
    best = int(np.argmax(np.abs(correlations)))
    if abs(correlations[best]) < 0.9 or correlations[0] * correlations[1] > 0.0:
        return 0
    return 1 if correlations[0] > 0.0 else -1


def _integrated(gyro: Array, times: Array) -> Array:
    steps = np.diff(gyro[:, 0], prepend=gyro[0, 0]) * gyro[:, 1]
    angle = np.cumsum(steps)
    begin, end = (np.interp(column, gyro[:, 0], angle) for column in times.T)
    return np.asarray(end - begin)


def _correlation(a: Array, b: Array) -> float:
    norms = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / norms if norms > 0.0 else 0.0
