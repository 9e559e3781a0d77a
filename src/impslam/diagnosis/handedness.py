"""Which way laser and wheels say that a robot goes: mirrored scans, exchanged and reversed wheels.

With unit scales the fits of `agreement`, S = a F + b T and R = c F + d T, show which signs are wrong:

    a > 0, d > 0     all is well                       b, c large, a, d ~ 0   one wheel counts backward
    a > 0, d < 0     turns are opposite: the scan is mirrored, or the wheels are exchanged
    a < 0, d > 0     ways are opposite: the laser looks astern (see `mount`)
    a < 0, d < 0     both: both wheels count backward, or the laser hangs head over heels

Mirrored scans are scans of the mirrored world, so that laser and wheels alone do not tell which of them is
wrong. A gyro does.
"""

from __future__ import annotations

import math

import numpy as np

from impslam.diagnosis.evidence import Evidence
from impslam.diagnosis.finding import SUREST, Finding
from impslam.diagnosis.robust import CLEAR
from impslam.geometry.angles import wrap
from impslam.health import OPPOSED, Standing
from impslam.odometry.encoders import Encoders
from impslam.types import Array

HALF = 0.5
WRONG = Standing(OPPOSED)
"""What follows for every pose of such a run."""


def handedness(e: Evidence) -> list[Finding]:
    """Find what is mirrored, exchanged or reversed."""
    if e.agreement is None:
        return []
    if finding := _one_wheel(e):
        return [finding]
    if not e.agreement.turn.is_negative(1):
        return []
    return _all_opposite(e) if e.agreement.way.is_negative(0) else _opposite_turns(e)


def _one_wheel(e: Evidence) -> Finding | None:
    """Find a wheel that counts backward: then ways show as turns, and turns as ways."""
    assert e.agreement is not None
    if not isinstance(e.odometry, Encoders):
        return None
    way, turn, half = e.agreement.way, e.agreement.turn, 0.5 * e.odometry.track
    b, c = way.p[1] / half, turn.p[0] * half
    crossed = abs(c) > CLEAR * turn.sigma[0] * half and abs(b) > CLEAR * way.sigma[1] / half
    if not crossed or min(abs(b), abs(c)) < HALF or max(abs(way.p[0]), abs(turn.p[1])) > HALF:
        return None
    side = "left" if c > 0.0 else "right"
    return Finding(
        "wheel reversed",
        f"the {side} wheel counts backward: on straight ways the robot seems to turn by "
        f"{abs(turn.p[0]):.2g} rad/m",
        (f"odometry.reversed={side}",),
        health=WRONG,
    )


def _opposite_turns(e: Evidence) -> list[Finding]:
    what = "scans and odometry turn opposite ways"
    voice = _gyro(e)
    mirrored = Finding(
        "scan mirrored",
        f"{what}: the scan is mirrored, or the laser hangs upside down",
        unmirrored(e),
        SUREST if voice > 0 else HALF,
        "" if voice > 0 else f"or {_exchange_words(e)}, which a gyro would tell",
        health=WRONG,
    )
    exchanged = Finding(
        "wheels exchanged",
        f"{what}, and the gyro turns as the scans do: {_exchange_words(e)}",
        ("odometry.exchanged=true",) if isinstance(e.odometry, Encoders) else (),
        health=WRONG,
    )
    return [exchanged if voice < 0 else mirrored]


def _exchange_words(e: Evidence) -> str:
    if isinstance(e.odometry, Encoders):
        return "left and right wheel are exchanged (--set odometry.exchanged=true)"
    return "odometry turns the wrong way"


def _all_opposite(e: Evidence) -> list[Finding]:
    what = "scans and odometry go and turn opposite ways"
    hangs = unmirrored(e, turned=True)
    if not isinstance(e.odometry, Encoders):
        words = f"{what}: the laser hangs head over heels"
        return [Finding("scan mirrored", words, hangs, health=WRONG)]
    other = " ".join(f"--set '{one}'" for one in hangs)
    return [
        Finding(
            "wheels reversed",
            f"{what}: both wheels count backward",
            ("odometry.reversed=both",),
            HALF,
            f"or the laser hangs head over heels ({other})",
            health=WRONG,
        )
    ]


def unmirrored(e: Evidence, *, turned: bool = False) -> tuple[str, ...]:
    """Return the settings that mirror the scan, and turn it where its axis needs that."""
    assert e.axis is not None
    fix = f"{e.place}.upside_down={str(not e.lidar.upside_down).lower()}"
    yaw = wrap(e.axis.angle + (math.pi if turned else 0.0))
    x, y, given = e.lidar.mount
    if abs(wrap(yaw - given)) < math.radians(3.0):
        return (fix,)
    return fix, f"{e.place}.mount=[{x:.3f},{y:.3f},{yaw:.3f}]"


def _gyro(e: Evidence) -> int:
    """Return 1 if a gyro turns as odometry does, -1 if as the scans do, 0 if neither is clear."""
    gyro = e.recording.gyro
    if len(gyro) < 2 or not len(e.times):
        return 0
    turned = _integrated(gyro, e.times)
    alike = [_correlation(turned, other) for other in (e.gone[:, 2], e.moved[:, 2])]
    best = int(np.argmax(np.abs(alike)))
    if abs(alike[best]) < 0.9 or alike[0] * alike[1] > 0.0:
        return 0
    return 1 if alike[0] > 0.0 else -1


def _integrated(gyro: Array, times: Array) -> Array:
    steps = np.diff(gyro[:, 0], prepend=gyro[0, 0]) * gyro[:, 1]
    angle = np.cumsum(steps)
    begin, end = (np.interp(column, gyro[:, 0], angle) for column in times.T)
    return np.asarray(end - begin)


def _correlation(a: Array, b: Array) -> float:
    spread = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / spread if spread > 0.0 else 0.0
