"""Initial estimate in closed form (Censi, Franchi, Marchionni and Oriolo 2013, Sec. V).

Turns do not depend on the mount and are linear in the readings, so they follow from linear least squares.
With turns f and translations z of unit scale, the mount m, the distance scale k and c = exp(i yaw) satisfy

    (exp(i f) - 1) m + k z - c L = 0,    |c| = 1,

for each translation L of the lidar. This is homogeneous and linear: with m and k eliminated, c is the
eigenvector of the smallest eigenvalue of a 2x2 matrix. (Censi et al. solve the same problem with a
polynomial of the fourth order.) Each iteration reduces the weight of motions that fit badly.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from impslam.calibration.odometry_models import Complex, motion, sum_between
from impslam.calibration.residuals import CalibrationDrive
from impslam.types import Array

ITERATIONS = 5
LATENCIES = np.linspace(-0.6, 0.6, 61)
"""s, grid of the search: a scan stamped on arrival over a slow link is half a second late."""


def initial_estimate(drives: Sequence[CalibrationDrive], latency: float) -> Array | None:
    """Return parameters (p + 6,) for `residuals`; None if the robot has not turned or driven.

    The latency is searched around the given one, s; ranges are assumed to be correct.
    """
    if not sum(len(drive.motions.begins) for drive in drives):
        return None
    candidates = [(_turning(drives, latency + late), latency + late) for late in LATENCIES]
    (turning, _), latency = min(candidates, key=lambda one: (one[0][1], abs(one[1] - latency)))
    if not np.all(np.isfinite(turning)) or turning[0] == 0.0:
        return None
    model = drives[0].model
    unit = model.parameters(turning, 1.0)
    bases = [motion(d.model, unit, latency, d.motions.begins, d.motions.ends) for d in drives]
    translation = np.concatenate([base.translation for base in bases])
    turn = np.concatenate([base.turn for base in bases])
    joint = np.concatenate([drive.motions.T_begin_end for drive in drives])
    scale, m, yaw = _mount(translation, turn, joint[:, 0] + 1j * joint[:, 1])
    return np.array([*model.parameters(turning, scale), m.real, m.imag, yaw, latency, 0.0, 1.0])


def _turning(drives: Sequence[CalibrationDrive], latency: float) -> tuple[Array, float]:
    """Return the factors (2,) from readings to turns, and the mean error of the turns, rad."""
    A = np.concatenate([
        sum_between(d.model, d.model.turn_inputs(), d.motions.begins - latency, d.motions.ends - latency)
        for d in drives
    ])  # fmt: skip
    b = np.concatenate([drive.motions.T_begin_end[:, 2] for drive in drives])
    weights = np.ones(len(b))
    for _ in range(ITERATIONS):
        turning = np.asarray(
            np.linalg.lstsq(A * weights[:, None], b * weights, rcond=1e-9)[0], np.float64
        )
        off = np.abs(A @ turning - b)
        weights = _weights(off)
    return turning, float(np.mean(off))


def _weights(off: Array) -> Array:
    """Return the square roots of the Cauchy weights (k,) of errors."""
    scale = 3.0 * np.median(off) + 1e-9
    return 1.0 / np.sqrt(1.0 + (off / scale) ** 2)


def _mount(translation: Complex, turn: Array, L: Complex) -> tuple[float, complex, float]:
    """Return the distance scale, and position and yaw of the mount, from translations (k,)."""
    lever, weights = np.exp(1j * turn) - 1.0, np.ones(len(translation))
    for _ in range(ITERATIONS):
        A = _real(weights * lever, weights * 1j * lever, weights * translation)
        C = _real(-weights * L, -weights * 1j * L)
        rest = C - A @ np.linalg.lstsq(A, C, rcond=1e-9)[0]
        c = np.linalg.eigh(rest.T @ rest)[1][:, 0]
        x = -np.linalg.lstsq(A, C @ c, rcond=1e-9)[0]
        if x[2] < 0.0:
            x, c = -x, -c
        off = np.abs(lever * complex(*x[:2]) + x[2] * translation - complex(*c) * L)
        weights = _weights(off)
    return float(x[2]), complex(*x[:2]), float(np.arctan2(c[1], c[0]))


def _real(*columns: Complex) -> Array:
    """Return c complex columns (k,) as a real matrix (2 k, c)."""
    table = np.column_stack(columns)
    return np.concatenate((table.real, table.imag))
