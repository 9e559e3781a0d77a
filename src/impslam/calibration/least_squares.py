"""Joint estimation of the parameters of all drives, their covariance, and the noise.

Gauss-Newton steps on the residuals, weighted by the current noise, alternate with estimates of that noise
(see `noise`). Outliers (a wheel that sticks, scans of different places) are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from impslam.calibration.noise import (
    MATCHING,
    TYPICAL,
    ErrorVariances,
    covariance_slopes,
    fit_variances,
    scan_covariances,
    unit_covariances,
)
from impslam.calibration.residuals import LIDAR_PARAMETERS, CalibrationDrive, residuals
from impslam.calibration.scan_pairs import SHAPE_SIGMA
from impslam.types import Array, Mask

MAX_ROUNDS, STEPS = 8, 4
"""Alternations of noise and parameters, and steps of the parameters in each."""
MAX_HALVINGS = 6
"""How often a step that increases the misfit is halved before it is dropped."""
CONVERGENCE = 0.02
"""Change of the parameters in the last round, in standard deviations."""
GATE = 13.3
"""Chi-square of 4 degrees of freedom that one motion in 100 exceeds."""
TAIL_SHARE, TAIL_CHI2 = 0.9, 7.8
"""A share of the motions, and the quantile of that chi-square at it."""
MAX_TAIL = 1.5
"""Ratio up to which heavier tails may be due to few motions; beyond it, variances grow with them."""
MEDIAN_CHI2 = 3.36
"""The median of that chi-square."""


class LeastSquaresSolution(NamedTuple):
    """Estimated parameters and noise, with their uncertainty.

    Attributes
    ----------
    parameters : (n,) for `residuals`
    covariance : (n, n); 0 for parameters that are not free. Increased if many motions do not fit
    noise : noise of the motions that fit, in the order of `noise.noise_names`; basis of the covariance
    slip : noise of odometry over all motions, including outliers and jitter: the error that odometry has
        for a filter that models only the scans' noise
    kept : by drive, (k,) the motions that fit
    chi2 : by drive, (k,) of 4 degrees of freedom each
    """

    parameters: Array
    covariance: Array
    noise: ErrorVariances
    slip: ErrorVariances
    kept: list[Mask]
    chi2: list[Array]


class _Weighted(NamedTuple):
    """Residuals e (k, 4), their derivatives J (k, 4, n), information (k, 4, 4) and chi-square (k,)."""

    e: Array
    J: Array
    W: Array
    chi2: Array


class Prior(NamedTuple):
    """Prior values (n,) and their standard deviations (n,)."""

    values: Array
    sigmas: Array


def solve(
    drives: Sequence[CalibrationDrive], start: Array, free: Mask, prior: Prior
) -> LeastSquaresSolution:
    """Return the best parameters, from a start (n,); those that are not `free` (n,) stay fixed.

    The prior constrains parameters that the drives do not determine.
    """
    parameters, variances = start.copy(), TYPICAL**2
    C = np.concatenate([scan_covariances(drive) for drive in drives])
    B, S_D = _unit_covariances(drives, start), _covariance_slopes(drives, start, variances)
    for k in range(MAX_ROUNDS):
        before, S = parameters, C + np.tensordot(variances, B, axes=1)
        for _ in range(STEPS):
            now = _weighted(drives, parameters, S)
            scale = max(float(np.median(now.chi2)) / MEDIAN_CHI2, 1.0)
            near = now.chi2 < GATE * scale
            weights = (
                np.where(near, 1.0, 0.0) if k else 1.0 / (1.0 + now.chi2 / scale / MEDIAN_CHI2)
            )
            pull = _pull(now, weights, S_D)
            step, covariance = _step(now, weights, free, parameters, prior, pull)
            parameters = parameters + _shortened(step, drives, parameters, S, now, weights)
        now = _weighted(drives, parameters, S)
        B = _unit_covariances(drives, parameters)
        noise = fit_variances(
            now.e[near], C[near], B[:, near], np.maximum(variances, 1e-3 * TYPICAL**2)
        )
        variances = noise.variances
        S_D = _covariance_slopes(drives, parameters, variances)
        changed = np.abs(parameters - before) > CONVERGENCE * np.sqrt(np.diag(covariance))
        if k > 1 and not changed.any():
            break
    m = len(MATCHING)
    slip = fit_variances(now.e, C, B[m:], np.maximum(variances[m:], TYPICAL[m:] ** 2))
    ends = np.cumsum([len(drive.motions.begins) for drive in drives])[:-1]
    tail = float(np.quantile(now.chi2, TAIL_SHARE)) / TAIL_CHI2
    covariance = covariance * max(1.0, tail / MAX_TAIL)
    offset = len(start) - len(LIDAR_PARAMETERS) + LIDAR_PARAMETERS.index("range_offset")
    covariance[offset, offset] += SHAPE_SIGMA**2 * free[offset]
    return LeastSquaresSolution(
        parameters, covariance, noise, slip, np.split(near, ends), np.split(now.chi2, ends)
    )


def _unit_covariances(drives: Sequence[CalibrationDrive], parameters: Array) -> Array:
    """Return the covariances (c, k, 4, 4) of all drives for variances of 1."""
    return np.concatenate([unit_covariances(drive, parameters) for drive in drives], axis=1)


def _covariance_slopes(
    drives: Sequence[CalibrationDrive], parameters: Array, variances: Array
) -> Array:
    """Return the derivatives (n, k, 4, 4) of the covariance of noise in all drives' readings."""
    return np.concatenate(
        [covariance_slopes(drive, parameters, variances) for drive in drives], axis=1
    )


def _pull(now: _Weighted, weights: Array, S_D: Array) -> Array:
    """Return (n,) half of w' (dS/dp) w over all motions."""
    w = np.einsum("kij,kj->ki", now.W, now.e)
    pull: Array = 0.5 * np.einsum("k,ki,nkij,kj->n", weights, w, S_D, w)
    return pull


def _shortened(
    step: Array,
    drives: Sequence[CalibrationDrive],
    parameters: Array,
    S: Array,
    now: _Weighted,
    weights: Array,
) -> Array:
    """Return the step (n,), shortened until the misfit does not grow.

    Jittering stamps make the misfit jagged in the latency, so its part of the step is dropped first.
    """
    is_latency = np.arange(len(step)) == len(step) - len(LIDAR_PARAMETERS) + LIDAR_PARAMETERS.index(
        "latency"
    )
    for _ in range(MAX_HALVINGS):
        then = _weighted(drives, parameters + step, S)
        if weights @ then.chi2 <= weights @ now.chi2 + 1.0:
            return step
        step = np.where(is_latency, 0.0, step) if step[is_latency].any() else 0.5 * step
    return np.zeros_like(step)


def _weighted(drives: Sequence[CalibrationDrive], parameters: Array, S: Array) -> _Weighted:
    found = [residuals(drive, parameters) for drive in drives]
    e = np.concatenate([one.values for one in found])
    J = np.concatenate([one.by_all for one in found])
    W = np.asarray(np.linalg.inv(S), np.float64)
    return _Weighted(e, J, W, np.einsum("ki,kij,kj->k", e, W, e))


def _step(
    now: _Weighted, weights: Array, free: Mask, parameters: Array, prior: Prior, pull: Array
) -> tuple[Array, Array]:
    """Return the step (n,) to the minimum, and the covariance (n, n) there; `pull` (n,) is from `_pull`."""
    WJ = np.einsum("k,kij,kjn->kin", weights, now.W, now.J)
    H = np.einsum("kim,kin->mn", now.J, WJ) + np.diag(prior.sigmas**-2.0)
    g = pull + (prior.values - parameters) / prior.sigmas**2 - np.einsum("kin,ki->n", WJ, now.e)
    inside = np.ix_(free, free)
    step, covariance = np.zeros(len(free)), np.zeros((len(free), len(free)))
    covariance[inside] = np.linalg.inv(H[inside])
    step[free] = covariance[inside] @ g[free]
    return step, covariance
