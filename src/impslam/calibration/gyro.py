"""Bias and scale of a gyro, by the turns of a lidar.

A lidar turns as the robot does, wherever it is mounted: f = k g + b t, for the gyro's sum g over a time t.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from impslam.calibration.scan_pairs import LidarMotions
from impslam.geometry.angles import wrap
from impslam.types import Array

FEWEST = 10
"""Motions at least."""
ROUNDS, GATE = 5, 4.0
"""Rounds in which motions that are off by more standard deviations are left out."""


class Gyro(NamedTuple):
    """What to add to a gyro's rate and what to scale it by: true = scale * (rate - bias).

    Attributes
    ----------
    bias, bias_sigma : rad/s
    scale, scale_sigma : 1
    """

    bias: float
    bias_sigma: float
    scale: float
    scale_sigma: float


def gyro_of(readings: Array, motions: LidarMotions, latency: float) -> Gyro | None:
    """Return what is off with the gyro of a log; None without one, or if the robot hardly moved.

    `readings` (g, 2) are stamps, s, and yaw rates, rad/s; `latency` is that of the lidar, s.
    """
    stamps, rates = readings.T
    if len(stamps) < 2:
        return None
    begins, ends = motions.begins - latency, motions.ends - latency
    inside = (begins >= stamps[0]) & (ends <= stamps[-1])
    if inside.sum() < FEWEST:
        return None
    seconds = (ends - begins)[inside]
    turned = _turned(stamps, rates, begins[inside], ends[inside])
    told = turned + wrap(motions.T_begin_end[inside, 2] - turned)
    return _fitted(np.column_stack((turned, seconds)), told)


def _turned(stamps: Array, rates: Array, begins: Array, ends: Array) -> Array:
    """Return the integrals (k,) rad of the rates between times (k,)."""
    steps = 0.5 * (rates[1:] + rates[:-1]) * np.maximum(np.diff(stamps), 0.0)
    angle, at = np.concatenate(([0.0], np.cumsum(steps))), np.maximum.accumulate(stamps)
    difference: Array = np.interp(ends, at, angle) - np.interp(begins, at, angle)
    return difference


def _fitted(A: Array, told: Array) -> Gyro:
    near = np.ones(len(A), np.bool_)
    for _ in range(ROUNDS):
        k, b = np.linalg.lstsq(A[near], told[near], rcond=None)[0]
        off = np.abs(A @ [k, b] - told)
        near = off <= GATE * 1.4826 * np.median(off) + 1e-9
    variance = float(off[near] @ off[near]) / max(int(near.sum()) - 2, 1)
    sigmas = np.sqrt(np.diag(np.linalg.inv(A[near].T @ A[near])) * variance)
    return Gyro(float(-b / k), float(sigmas[1] / k), float(k), float(sigmas[0]))
