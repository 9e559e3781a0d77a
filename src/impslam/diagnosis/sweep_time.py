"""Estimate the duration of a sweep from pairs of scans at different turn rates.

Let the beams of a sweep be measured s u seconds after its middle, with s the duration of the sweep and u
from -1/2 for the first beam to 1/2 for the last. De-skewed, a point p moves by s u (v + omega x p), to
first order. So the distances of the points of scan b from the surfaces of scan a are linear in the
correction of s and in those of the pose of b: each pair gives an s by least squares. It is negative if the
last beam is measured first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from impslam.calibration.lidar_path import LidarPath, deskewed
from impslam.calibration.scan_pairs import (
    MIN_POINTS,
    Surface,
    align,
    facing_partners,
    sweep_surface,
)
from impslam.columns import Columns, Scans
from impslam.diagnosis.robust import fit
from impslam.geometry.se2 import between, rotation
from impslam.sensors.lidar2d import Lidar2D
from impslam.types import Array, Ints

NEAR, LIKELY = 0.3, 0.05
"""m between points of one surface, and m from its line at which a point has half of the weight: it is
likely on another surface."""
MAX_STEPS = 3
"""Linear steps; the second one is already for a change of turns of 0.1 rad per sweep."""
MIN_PAIRS = 6
"""Pairs that must match, for a standard deviation."""


class Swept(NamedTuple):
    """The surface of a sweep; `shift` (n, 2) m/s is the motion of its points per duration of the sweep."""

    surface: Surface
    shift: Array


def sweep_time(
    lidar: Lidar2D,
    scans: Sequence[Columns],
    path: LidarPath,
    pairs: Ints,
    given: float,
    period: float,
) -> tuple[float, float] | None:
    """Return the duration of the sweeps and its standard deviation, s; None if too few pairs match.

    `pairs` (k, 2) are rows of the path, `given` is the duration to begin with, `period` its upper bound.
    """
    seconds = given if abs(given) <= period else 0.0
    for _ in range(MAX_STEPS):
        before = seconds
        swept = _swept(lidar, scans, path, np.unique(pairs), seconds)
        steps = [_step(swept[a], swept[b], _guess(path, a, b), lidar) for a, b in pairs.tolist()]
        found = np.array([step for step in steps if step is not None])
        if len(found) < MIN_PAIRS:
            return None
        root = np.sqrt(found[:, 1])
        mean = fit(root[:, None], root * found[:, 0])
        seconds = float(np.clip(before + mean.p[0], -period, period))
        if abs(seconds - before) < mean.sigma[0]:
            break
    return seconds, float(mean.sigma[0])


def _guess(path: LidarPath, a: int, b: int) -> Array:
    return between(path.poses[a], path.poses[b])


def _swept(
    lidar: Lidar2D, scans: Sequence[Columns], path: LidarPath, rows: Ints, seconds: float
) -> dict[int, Swept]:
    """Return the sweeps in these rows, de-skewed for a duration."""
    timed = [_with_times(piece, seconds) for piece in scans]
    found = [
        (some, k) for some in deskewed(lidar, timed, path, rows) for k in range(len(some.stamps))
    ]
    return {
        row: _one(some, k, path.twists[row])
        for row, (some, k) in zip(rows.tolist(), found, strict=True)
    }


def _with_times(scans: Columns, seconds: float) -> Columns:
    """Return scans whose sweeps take a time, s; negative if the last beam is first."""
    offsets = np.linspace(max(-seconds, 0.0), max(seconds, 0.0), len(scans["angles"]))
    return replace(scans, layout={**scans.layout, "time_offsets": offsets})


def _one(scans: Scans, k: int, twist: Array) -> Swept:
    surface, share = sweep_surface(scans, k), np.linspace(-0.5, 0.5, len(scans.angles))
    x, y = surface.points.T
    u = np.interp(np.arctan2(y, x), scans.angles, share, period=math.tau)
    velocity = twist[:2] + twist[2] * np.column_stack((-y, x))
    return Swept(surface, u[:, None] * velocity)


def _step(a: Swept, b: Swept, guess: Array, lidar: Lidar2D) -> tuple[float, float] | None:
    """Return the correction of the duration, s, by which two sweeps fit best, and its information.

    The information is without the noise of the points, 1/s^2 per m^2; None if they do not match.
    """
    found = align(a.surface, b.surface, guess, (lidar.sigma, lidar.sigma_per_m))
    if found is None:
        return None
    turn = rotation(float(found.T_a_b[2])).T  # of rows
    j, i, points = facing_partners(a.surface, b.surface, found.T_a_b, NEAR)
    if len(i) < MIN_POINTS:
        return None
    n, arm = a.surface.normals[j], points - found.T_a_b[:2]
    lever = arm[:, 0] * n[:, 1] - arm[:, 1] * n[:, 0]
    J = np.column_stack((n, lever, (n * (b.shift[i] @ turn - a.shift[j])).sum(axis=1)))
    off = (n * (points - a.surface.points[j])).sum(axis=1)
    WJ = J.T / (1.0 + (off / LIKELY) ** 2)
    covariance = np.linalg.pinv(WJ @ J, hermitian=True)
    if covariance[3, 3] <= 0.0:  # the motion during the sweeps does not show
        return None
    return float(-(covariance @ (WJ @ off))[3]), 1.0 / float(covariance[3, 3])
