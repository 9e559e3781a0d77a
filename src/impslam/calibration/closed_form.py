"""The first estimate, in closed form (Censi, Franchi, Marchionni and Oriolo 2013, Sec. V).

Turns do not depend on the mount, and are linear in how much each reading turns the robot: least squares.
With turns f and ways z of unit scale, the mount m, the scale of ways k and c = exp(i yaw) fulfil

    (exp(i f) - 1) m + k z - c L = 0,    |c| = 1,

for each way L of the lidar: homogeneous and linear, so that c is the eigenvector of the smallest
eigenvalue of a 2x2 matrix once m and k are eliminated. (Censi et al. solve the same problem with a
polynomial of the fourth order.) Each round weighs down what fits badly.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from impslam.calibration.odometry_models import Complex, motion, sums
from impslam.calibration.residuals import Drive
from impslam.types import Array

ROUNDS = 5
LATENCIES = np.linspace(-0.6, 0.6, 61)
"""s, what is tried first: a scan that is stamped on arrival through a slow line is half a second late."""


def first_estimate(drives: Sequence[Drive], latency: float) -> Array | None:
    """Return parameters (p + 6,) as `residuals` takes them; None if the robot has not turned or driven.

    The latency is sought around the given one, s; ranges count as right.
    """
    if not sum(len(drive.motions.begins) for drive in drives):
        return None
    tried = [(_turning(drives, latency + late), latency + late) for late in LATENCIES]
    (turning, _), latency = min(tried, key=lambda one: (one[0][1], abs(one[1] - latency)))
    if not np.all(np.isfinite(turning)) or turning[0] == 0.0:
        return None
    model = drives[0].model
    unit = model.solved(turning, 1.0)
    bases = [motion(d.model, unit, latency, d.motions.begins, d.motions.ends) for d in drives]
    way = np.concatenate([base.way for base in bases])
    turn = np.concatenate([base.turn for base in bases])
    joint = np.concatenate([drive.motions.T_begin_end for drive in drives])
    scale, m, yaw = _mount(way, turn, joint[:, 0] + 1j * joint[:, 1])
    return np.array([*model.solved(turning, scale), m.real, m.imag, yaw, latency, 0.0, 1.0])


def _turning(drives: Sequence[Drive], latency: float) -> tuple[Array, float]:
    """Return what each reading turns the robot by (2,), and the mean error of the turns, rad."""
    A = np.concatenate([
        sums(d.model, d.model.turned(), d.motions.begins - latency, d.motions.ends - latency)
        for d in drives
    ])  # fmt: skip
    b = np.concatenate([drive.motions.T_begin_end[:, 2] for drive in drives])
    weights = np.ones(len(b))
    for _ in range(ROUNDS):
        turning = np.asarray(
            np.linalg.lstsq(A * weights[:, None], b * weights, rcond=1e-9)[0], np.float64
        )
        off = np.abs(A @ turning - b)
        weights = _weights(off)
    return turning, float(np.mean(off))


def _weights(off: Array) -> Array:
    """Return the square roots of the weights (k,) of errors, after Cauchy."""
    scale = 3.0 * np.median(off) + 1e-9
    return 1.0 / np.sqrt(1.0 + (off / scale) ** 2)


def _mount(way: Complex, turn: Array, L: Complex) -> tuple[float, complex, float]:
    """Return the scale of ways (k,), the mount's place, and its yaw, by the lidar's ways (k,)."""
    lever, weights = np.exp(1j * turn) - 1.0, np.ones(len(way))
    for _ in range(ROUNDS):
        A = _real(weights * lever, weights * 1j * lever, weights * way)
        C = _real(-weights * L, -weights * 1j * L)
        rest = C - A @ np.linalg.lstsq(A, C, rcond=1e-9)[0]
        c = np.linalg.eigh(rest.T @ rest)[1][:, 0]
        x = -np.linalg.lstsq(A, C @ c, rcond=1e-9)[0]
        if x[2] < 0.0:
            x, c = -x, -c
        off = np.abs(lever * complex(*x[:2]) + x[2] * way - complex(*c) * L)
        weights = _weights(off)
    return float(x[2]), complex(*x[:2]), float(np.arctan2(c[1], c[0]))


def _real(*columns: Complex) -> Array:
    """Return complex columns (k,) as real ones, (2 k, c)."""
    table = np.column_stack(columns)
    return np.concatenate((table.real, table.imag))
