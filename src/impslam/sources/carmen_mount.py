"""The mount of the laser in CARMEN logs: ROBOTLASER1 lines contain the poses of laser and robot."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path

import numpy as np

from impslam.geometry.angles import wrap
from impslam.geometry.se2 import between
from impslam.sources.text import DAMAGE, LINE_LIMIT, open_text
from impslam.types import Array

LINES, SCANS = 50_000, 2000
"""Lines of a log that are read, and scans among them: some minutes of driving."""
MIN_MOTION = (0.5, 0.5)
"""m, rad that the robot must move: while it stands, the difference of any two poses is constant."""
MAX_SPREAD = (0.005, 0.005)
"""m, rad by which the laser moves on the robot at most: digits of the poses."""
MAX_DISTANCE = 5.0
"""m from the robot to its laser: poses further apart are in different frames."""
_TAIL = 14  # words after the remissions; poses of laser and robot come first
_DIGITS = 4


def laser_mount(path: Path) -> tuple[float, float, float] | None:
    """Return `T_base_laser` (x, y, yaw), or None if the poses do not determine it.

    Poses that are equal say nothing: loggers that know no mount write the robot's pose twice.
    """
    rows = np.array(list(islice(_poses(path), SCANS)), np.float64).reshape(-1, 6)
    rows = rows[np.isfinite(rows).all(axis=1)]
    if not len(rows):
        return None
    lasers, robots = rows[:, :3], rows[:, 3:]
    mounts = between(robots, lasers)
    mount = mounts[0]
    return _rounded(mount) if _moves(robots) and _is_mount(mounts) else None


def _poses(path: Path) -> Iterator[list[float]]:
    """Yield the poses of laser and robot of each readable line."""
    with suppress(*DAMAGE), open_text(path) as (_, text):
        for _ in range(LINES):
            line = text.readline(LINE_LIMIT)
            if not line:
                return
            words = line.rsplit(None, _TAIL)[1:]
            if line.startswith(b"ROBOTLASER1 ") and len(words) == _TAIL:
                with suppress(ValueError):
                    yield [float(word) for word in words[:6]]


def _moves(robots: Array) -> bool:
    travel = np.hypot(*np.ptp(robots[:, :2], axis=0))
    turn = np.abs(wrap(robots[:, 2] - robots[0, 2])).max()
    return bool(travel >= MIN_MOTION[0] and turn >= MIN_MOTION[1])


def _is_mount(mounts: Array) -> bool:
    """Return whether mounts (m, 3) are one, and not where the robot's own pose is."""
    off = mounts - mounts[0]
    distance, turn = np.hypot(off[:, 0], off[:, 1]).max(), np.abs(wrap(off[:, 2])).max()
    away = math.hypot(*mounts[0, :2])
    is_constant = distance <= MAX_SPREAD[0] and turn <= MAX_SPREAD[1]
    is_elsewhere = away > MAX_SPREAD[0] or abs(mounts[0, 2]) > MAX_SPREAD[1]
    return bool(is_constant and is_elsewhere and away <= MAX_DISTANCE)


def _rounded(mount: Array) -> tuple[float, float, float]:
    x, y, yaw = (round(value, _DIGITS) + 0.0 for value in mount.tolist())
    return x, y, yaw
