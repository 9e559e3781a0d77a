"""Bias and scale of a gyro, from the turns of a lidar.

A lidar turns with the robot, wherever it is mounted: its turn is f = k g + b t, with g the integral of the
gyro's rate over a time t.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.calibration.scan_pairs import LidarMotions
from impslam.geometry.angles import wrap
from impslam.types import Array

MIN_MOTIONS = 10
"""Motions needed for an estimate."""
MAX_CONDITION = 1e4
"""Condition number beyond which bias and scale cannot be told apart: the rate varies by 1e-4 rad/s."""
ITERATIONS, GATE = 5, 4.0
"""Number of fits, and the standard deviations beyond which a motion is left out of the next one."""


class GyroCalibration(NamedTuple):
    """Bias and scale of a gyro: true = scale * (rate - bias).

    Attributes
    ----------
    bias, bias_sigma : rad/s
    scale, scale_sigma : 1
    """

    bias: float
    bias_sigma: float
    scale: float
    scale_sigma: float


def calibrate_gyro(
    readings: Array, motions: LidarMotions, latency: float
) -> GyroCalibration | None:
    """Return bias and scale of the gyro of a log; None if it has none, or its rate hardly changed.

    `readings` (g, 2) are stamps, s, and yaw rates, rad/s; `latency` is that of the lidar, s.
    """
    stamps, rates = readings.T
    if len(stamps) < 2:
        return None
    begins, ends = motions.begins - latency, motions.ends - latency
    inside = (begins >= stamps[0]) & (ends <= stamps[-1])
    if inside.sum() < MIN_MOTIONS:
        return None
    seconds = (ends - begins)[inside]
    by_gyro = _integrate(stamps, rates, begins[inside], ends[inside])
    by_lidar = by_gyro + wrap(motions.T_begin_end[inside, 2] - by_gyro)
    return _fit(np.column_stack((by_gyro, seconds)), by_lidar)


def _integrate(stamps: Array, rates: Array, begins: Array, ends: Array) -> Array:
    """Return the integrals (k,) rad of the rates between times (k,)."""
    steps = 0.5 * (rates[1:] + rates[:-1]) * np.maximum(np.diff(stamps), 0.0)
    angle, at = np.concatenate(([0.0], np.cumsum(steps))), np.maximum.accumulate(stamps)
    difference: Array = np.interp(ends, at, angle) - np.interp(begins, at, angle)
    return difference


def _fit(A: Array, turns: Array) -> GyroCalibration | None:
    near = np.ones(len(A), np.bool_)
    for _ in range(ITERATIONS):
        k, b = np.linalg.lstsq(A[near], turns[near], rcond=None)[0]
        off = np.abs(A @ [k, b] - turns)
        near = off <= GATE * 1.4826 * np.median(off) + 1e-9
    if np.linalg.cond(A[near]) > MAX_CONDITION:
        return None
    variance = float(off[near] @ off[near]) / max(int(near.sum()) - 2, 1)
    sigmas = np.sqrt(np.diag(np.linalg.inv(A[near].T @ A[near])) * variance)
    return GyroCalibration(float(-b / k), float(sigmas[1] / abs(k)), float(k), float(sigmas[0]))
