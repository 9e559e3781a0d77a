"""The best parameters of all drives at once, what they are worth, and how much is noise.

Gauss-Newton on the residuals, each weighed by the noise found so far, in turns with that noise
(`noise`). Motions that fit no such noise (a wheel that sticks, scans of different places) are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from impslam.calibration.noise import (
    MATCHING,
    TYPICAL,
    Noise,
    fitted,
    of_scans,
    slopes,
    spreads,
)
from impslam.calibration.residuals import SENSOR, Drive, residuals
from impslam.types import Array, Mask

ROUNDS, STEPS = 8, 4
"""Of noise and parameters in turns, and steps of the parameters in each."""
HALVED = 6
"""How often a step is halved that does not help; then it is left out."""
ALIKE = 0.02
"""Standard deviations by which parameters change in the last round at most."""
GATE = 13.3
"""Chi-square of 4 degrees of freedom that one motion in 100 exceeds."""
TAIL, NINTH = 0.9, 7.8
"""A share of the motions, and the chi-square that it stays below."""
SHAPES = 0.0015
"""m: what normals that err with their points, and corners, leave in a range offset, in any drive: 0.1 to
0.4 mm in simulations, 2 mm with another simulator's lidar."""
HEAVY = 1.5
"""Tails so much heavier than that are an accident of few motions; beyond, variances grow with them."""
MEDIAN = 3.36
"""The median of that chi-square."""


class Solution(NamedTuple):
    """What is best, and how sure.

    Attributes
    ----------
    parameters : (n,) as `residuals` takes them
    covariance : (n, n); 0 for those that are not free. Larger where many motions do not fit
    noise : of the motions that fit, as in `noise.names`; the covariance rests on it
    slip : of odometry over all motions, wheels that stick and stamps that jitter included: what it
        strays by to a filter that knows no more than the scans' noise
    kept : by drive, (k,) the motions that fit
    chi2 : by drive, (k,) of 4 degrees of freedom each
    """

    parameters: Array
    covariance: Array
    noise: Noise
    slip: Noise
    kept: list[Mask]
    chi2: list[Array]


class _Weighed(NamedTuple):
    """Residuals e (k, 4), their derivatives J (k, 4, n), information (k, 4, 4) and chi-square (k,)."""

    e: Array
    J: Array
    W: Array
    chi2: Array


class Prior(NamedTuple):
    """What is known without the drives: values (n,) and their standard deviations (n,)."""

    values: Array
    sigmas: Array


def solve(drives: Sequence[Drive], start: Array, free: Mask, prior: Prior) -> Solution:
    """Return the best parameters, from a start (n,); those that are not `free` (n,) stay.

    The prior keeps what the drives do not tell.
    """
    parameters, variances = start.copy(), TYPICAL**2
    C = np.concatenate([of_scans(drive) for drive in drives])
    B, S_D = _spreads(drives, start), _slopes(drives, start, variances)
    for k in range(ROUNDS):
        before, S = parameters, C + np.tensordot(variances, B, axes=1)
        for _ in range(STEPS):
            now = _weighed(drives, parameters, S)
            scale = max(float(np.median(now.chi2)) / MEDIAN, 1.0)
            near = now.chi2 < GATE * scale
            weights = np.where(near, 1.0, 0.0) if k else 1.0 / (1.0 + now.chi2 / scale / MEDIAN)
            pull = _pull(now, weights, S_D)
            step, covariance = _step(now, weights, free, parameters, prior, pull)
            parameters = parameters + _shortened(step, drives, parameters, S, now, weights)
        now = _weighed(drives, parameters, S)
        B = _spreads(drives, parameters)
        noise = fitted(now.e[near], C[near], B[:, near], np.maximum(variances, 1e-3 * TYPICAL**2))
        variances = noise.variances
        S_D = _slopes(drives, parameters, variances)
        changed = np.abs(parameters - before) > ALIKE * np.sqrt(np.diag(covariance))
        if k > 1 and not changed.any():
            break
    m = len(MATCHING)
    slip = fitted(now.e, C, B[m:], np.maximum(variances[m:], TYPICAL[m:] ** 2))
    ends = np.cumsum([len(drive.motions.begins) for drive in drives])[:-1]
    heavy = float(np.quantile(now.chi2, TAIL)) / NINTH
    covariance = covariance * max(1.0, heavy / HEAVY)
    offset = len(start) - len(SENSOR) + SENSOR.index("range_offset")
    covariance[offset, offset] += SHAPES**2 * free[offset]
    return Solution(
        parameters, covariance, noise, slip, np.split(near, ends), np.split(now.chi2, ends)
    )


def _spreads(drives: Sequence[Drive], parameters: Array) -> Array:
    """Return the covariances (c, k, 4, 4) of all drives for variances of 1."""
    return np.concatenate([spreads(drive, parameters) for drive in drives], axis=1)


def _slopes(drives: Sequence[Drive], parameters: Array, variances: Array) -> Array:
    """Return the slopes (n, k, 4, 4) of the noise in all drives' readings."""
    return np.concatenate([slopes(drive, parameters, variances) for drive in drives], axis=1)


def _pull(now: _Weighed, weights: Array, S_D: Array) -> Array:
    """Return (n,) half of w' (dS/dp) w over all motions."""
    w = np.einsum("kij,kj->ki", now.W, now.e)
    pull: Array = 0.5 * np.einsum("k,ki,nkij,kj->n", weights, w, S_D, w)
    return pull


def _shortened(  # what the misfit is made of
    step: Array,
    drives: Sequence[Drive],
    parameters: Array,
    S: Array,
    now: _Weighed,
    weights: Array,
) -> Array:
    """Return the step (n,), shortened until the misfit does not grow.

    Stamps that jitter make it jagged in the latency, which is the first to stay.
    """
    still = np.arange(len(step)) == len(step) - len(SENSOR) + SENSOR.index("latency")
    for _ in range(HALVED):
        then = _weighed(drives, parameters + step, S)
        if weights @ then.chi2 <= weights @ now.chi2 + 1.0:
            return step
        step = np.where(still, 0.0, step) if step[still].any() else 0.5 * step
    return np.zeros_like(step)


def _weighed(drives: Sequence[Drive], parameters: Array, S: Array) -> _Weighed:
    found = [residuals(drive, parameters) for drive in drives]
    e, J = (
        np.concatenate([one.values for one in found]),
        np.concatenate([one.by_all for one in found]),
    )
    W = np.asarray(np.linalg.inv(S), np.float64)
    return _Weighed(e, J, W, np.einsum("ki,kij,kj->k", e, W, e))


def _step(
    now: _Weighed, weights: Array, free: Mask, parameters: Array, prior: Prior, pull: Array
) -> tuple[Array, Array]:
    """Return the step (n,) to the minimum, and the covariance (n, n) there; `pull` (n,) is `_pull`'s."""
    WJ = np.einsum("k,kij,kjn->kin", weights, now.W, now.J)
    H = np.einsum("kim,kin->mn", now.J, WJ) + np.diag(prior.sigmas**-2.0)
    g = pull + (prior.values - parameters) / prior.sigmas**2 - np.einsum("kin,ki->n", WJ, now.e)
    inside = np.ix_(free, free)
    step, covariance = np.zeros(len(free)), np.zeros((len(free), len(free)))
    covariance[inside] = np.linalg.inv(H[inside])
    step[free] = covariance[inside] @ g[free]
    return step, covariance
