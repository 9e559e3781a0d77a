"""Variances of the random errors of odometry and matches, by maximum likelihood.

A residual has the covariance S = C + sum of v_j B_j, with C from the scans and a B_j for each error source
of odometry or matches. The v_j >= 0 minimise the sum of log|S| + e' S^-1 e.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize

from impslam.calibration.odometry_models import (
    Complex,
    DifferentialDrive,
    Motion,
    motion,
    sum_between,
)
from impslam.calibration.residuals import LIDAR_PARAMETERS, CalibrationDrive, residuals
from impslam.calibration.scan_pairs import UNDETERMINED, LidarMotions
from impslam.geometry.se2 import exp, log
from impslam.types import Array

MATCHING = ("matching", "matching_yaw", "matching_offset", "jitter")
"""Errors of matches in addition to the noise of their scans, m, rad and m; and of their stamps, s."""
_JITTER = MATCHING.index("jitter")
MIN_INFORMATION = UNDETERMINED * np.eye(4)
"""Added to that of every motion, so that it is invertible along a corridor."""
UNITS = {
    "matching": "m",
    "matching_yaw": "rad",
    "matching_offset": "m",
    "jitter": "s",
    "wheel_noise": "m/sqrt(m)",
    "forward": "m/sqrt(m)",
    "sideways": "m/sqrt(m)",
    "turn_per_distance": "rad/sqrt(m)",
    "turn_per_turn": "rad/sqrt(rad)",
}
TYPICAL = np.array([0.002, 0.001, 0.002, 0.002, 0.01, 0.01, 0.01, 0.03])
"""Start of the search, in the order of `noise_names`."""
MAX_RATIO = 100.0
"""Upper bound, as a multiple of `TYPICAL`: 0.2 m, 0.1 rad, 0.2 s. Beyond, everything would be noise."""


STEP = 1e-6
"""m and rad, of finite differences."""


class ErrorVariances(NamedTuple):
    """Variances (c,) of the error sources, and their information (c, c)."""

    variances: Array
    information: Array


def noise_names(drive: CalibrationDrive) -> tuple[str, ...]:
    """Return the names of the error sources: of matches, then keys of the config's odometry."""
    table = "slip" if isinstance(drive.model, DifferentialDrive) else "noise"
    along = "wheel_noise" if table == "slip" else "noise.forward"
    rest = ("sideways", "turn_per_distance", "turn_per_turn")
    return (*MATCHING, along, *(f"{table}.{one}" for one in rest))


def scan_covariances(drive: CalibrationDrive) -> Array:
    """Return the covariances C (k, 4, 4) of the motions, from the noise of their scans."""
    return np.asarray(np.linalg.inv(drive.motions.information + MIN_INFORMATION), np.float64)


class _Lengths(NamedTuple):
    """Distances and absolute turns (k,) of k motions, and the distances of both wheels, m."""

    distance: Array
    turn: Array
    left: Array
    right: Array


def unit_covariances(drive: CalibrationDrive, parameters: Array) -> Array:
    """Return B (c, k, 4, 4), the covariances for variances of 1, in the order of `noise_names`.

    Errors of odometry accumulate along the motion and are expressed at its middle: there, a heading
    variance of q per metre causes a variance of q d^3 / 12 of the position across a distance d.
    """
    base, lengths = _driven(drive, parameters)
    Q = _twist_covariances(lengths, base)
    if isinstance(drive.model, DifferentialDrive):
        Q[0] = _wheel_covariance(lengths, np.abs(base.translation) ** 2 / 12.0, parameters[2])
    G = _into_lidar(base.translation, base.turn, *_mount(drive, parameters))
    return np.concatenate((_match_covariances(drive.motions), G @ Q @ np.swapaxes(G, -1, -2)))


def covariance_slopes(drive: CalibrationDrive, parameters: Array, variances: Array) -> Array:
    """Return the derivatives (n, k, 4, 4) of the covariance of reading noise by the parameters (n,).

    Noise of odometry and jitter of stamps are properties of the readings; their effect on a motion depends
    on the parameters. Without these derivatives, least squares underestimates factors of the readings: a
    scale is too small, and a track too wide, by the ratio of noise to squared motions (regression dilution;
    Fuller 1987, Sec. 1.1). `variances` (c,) are in the order of `noise_names`.
    """
    base, lengths = _driven(drive, parameters)
    p, (m, yaw) = len(drive.model.names), _mount(drive, parameters)
    G = _into_lidar(base.translation, base.turn, m, yaw)
    odometry_variances = variances[len(MATCHING) :]
    if isinstance(drive.model, DifferentialDrive):
        Q, Q_D = _wheel_slopes(lengths, base, parameters[:3])
        Q, Q_D = odometry_variances[0] * Q, odometry_variances[0] * Q_D
    else:
        Q, Q_D = _twist_slopes(lengths, base, parameters[:p], odometry_variances)
    out: Array = variances[_JITTER] * _jitter_slopes(drive, parameters)
    out[:p] += G @ Q_D @ np.swapaxes(G, -1, -2)
    for j, other in enumerate(((m + STEP, yaw), (m + 1j * STEP, yaw), (m, yaw + STEP))):
        shifted = _into_lidar(base.translation, base.turn, *other)
        out[p + j] += (
            shifted @ Q @ np.swapaxes(shifted, -1, -2) - G @ Q @ np.swapaxes(G, -1, -2)
        ) / STEP
    return out


def _wheel_slopes(lengths: _Lengths, base: Motion, values: Array) -> tuple[Array, Array]:
    """Return the covariance (k, 4, 4) of wheel noise of unit variance, and its slopes (3, k, 4, 4)."""
    (radius, ratio, track), across = values, np.abs(base.translation) ** 2 / 12.0
    Q = _wheel_covariance(lengths, across, track)
    by_right = _wheel_covariance(lengths._replace(left=np.zeros_like(across)), across, track)
    wider = _wheel_covariance(lengths, across, track * (1.0 + STEP)) - Q
    return Q, np.array([2.0 / radius * Q, 2.0 / ratio * by_right, wider / (track * STEP)])


def _twist_slopes(
    lengths: _Lengths, base: Motion, values: Array, variances: Array
) -> tuple[Array, Array]:
    """Return the covariance (k, 4, 4) of the noise of poses or speeds, and its slopes (p, k, 4, 4).

    Distance errors grow with the distance scale and turn errors with the turn scale; by the turn per metre,
    a distance error also turns the robot.
    """
    Q = np.tensordot(variances, _twist_covariances(lengths, base), axes=1)
    E = np.zeros((len(values), 4, 4))
    E[0, 0, 0] = E[0, 1, 1] = 1.0 / values[0]
    E[1, 2, 2] = 1.0 / values[1]
    E[2:, 2, 0] = 1.0 / values[0]
    half = E[:, None] @ Q
    return Q, half + np.swapaxes(half, -1, -2)


def _jitter_slopes(drive: CalibrationDrive, parameters: Array) -> Array:
    """Return the slopes (n, k, 4, 4) of the covariance by jitter of 1 s: speeds grow with the scales."""
    motions, p = drive.motions, len(drive.model.names)
    unaffected = p + np.array(
        [LIDAR_PARAMETERS.index("latency"), LIDAR_PARAMETERS.index("range_offset")]
    )
    speeds = residuals(drive, parameters).by_all / (motions.ends - motions.begins)[:, None, None]
    speeds[:, :, unaffected] = 0.0
    half: Array = 2.0 * np.einsum("kin,kj->nkij", speeds, _speeds(motions))
    return half + np.swapaxes(half, -1, -2)


def _mount(drive: CalibrationDrive, parameters: Array) -> tuple[complex, float]:
    x, y, yaw = parameters[len(drive.model.names) :][:3]
    return complex(x, y), float(yaw)


def _driven(drive: CalibrationDrive, parameters: Array) -> tuple[Motion, _Lengths]:
    """Return the motions of base_link, and their lengths."""
    model, motions, p = drive.model, drive.motions, len(drive.model.names)
    latency, steps = parameters[p + 3], model.steps(parameters[:p])
    base = motion(model, parameters[:p], latency, motions.begins, motions.ends)
    left, right = (np.abs(turns) * parameters[0] for turns in model.wheel_turns())
    table = np.column_stack((np.abs(steps.path), np.abs(steps.turn), left, right))
    begins, ends = motions.begins - latency, motions.ends - latency
    return base, _Lengths(*sum_between(model, table, begins, ends).T)


def _twist_covariances(lengths: _Lengths, base: Motion) -> Array:
    """Return the covariances (4, k, 4, 4) of errors forward, sideways and of the heading, mid-motion."""
    across, distance = np.abs(base.translation) ** 2 / 12.0, lengths.distance
    Q = np.zeros((4, len(distance), 4, 4))
    Q[0, :, 0, 0] = Q[1, :, 1, 1] = distance
    for j, variance in ((2, distance), (3, lengths.turn)):
        Q[j, :, 1, 1], Q[j, :, 2, 2] = across * variance, variance
    return Q


def _wheel_covariance(lengths: _Lengths, across: Array, track: float) -> Array:
    """Return the covariance (k, 4, 4) of wheel noise of unit variance per metre, mid-motion."""
    both, difference = lengths.left + lengths.right, lengths.right - lengths.left
    Q = np.zeros((len(both), 4, 4))
    Q[:, 0, 0], Q[:, 2, 2] = 0.25 * both, both / track**2
    Q[:, 0, 2] = Q[:, 2, 0] = 0.5 * difference / track
    Q[:, 1, 1] = across * Q[:, 2, 2]
    return Q


def _match_covariances(motions: LidarMotions) -> Array:
    """Return the covariances (4, k, 4, 4) of the errors in `MATCHING`.

    An apparent range offset caused by shapes also affects the pose; a wrong stamp scales the whole motion.
    """
    B = np.zeros((4, len(motions.begins), 4, 4))
    B[0, :, 0, 0] = B[0, :, 1, 1] = B[1, :, 2, 2] = 1.0
    offset = np.linalg.inv(motions.information + MIN_INFORMATION)[:, 3]
    offset /= offset[:, 3:]
    B[2] = np.einsum("ki,kj->kij", offset, offset)
    speeds = _speeds(motions)
    B[_JITTER] = 2.0 * np.einsum("ki,kj->kij", speeds, speeds)
    return B


def _speeds(motions: LidarMotions) -> Array:
    """Return the motions per second (k, 4), with 0 for the constant range offset."""
    zero = np.zeros(len(motions.begins))
    return np.column_stack((motions.T_begin_end, zero)) / (motions.ends - motions.begins)[:, None]


def _into_lidar(translation: Complex, turn: Array, m: complex, yaw: float) -> Array:
    """Return the Jacobian (k, 4, 4) of the lidar's motion by an error in the middle of base_link's."""
    half = exp(0.5 * log(np.column_stack((translation.real, translation.imag, turn))))
    heading, middle = np.exp(1j * half[:, 2]), half[:, 0] + 1j * half[:, 1]
    into = np.exp(-1j * yaw)
    along, lever = into * heading, into * 1j * (heading * middle + np.exp(1j * turn) * m)
    G = np.zeros((len(translation), 4, 4))
    G[:, 0, 0], G[:, 1, 0] = along.real, along.imag
    G[:, 0, 1], G[:, 1, 1] = -along.imag, along.real
    G[:, 0, 2], G[:, 1, 2], G[:, 2, 2] = lever.real, lever.imag, 1.0
    return G


def fit_variances(e: Array, C: Array, B: Array, start: Array) -> ErrorVariances:
    """Return the variances that explain residuals e (k, 4) best; the search begins at `start` (c,)."""

    def scaled(factors: Array) -> tuple[float, Array]:
        value, slope = cost(factors * start, e, C, B)
        return value, slope * start

    bounds = [(0.0, float(high)) for high in (MAX_RATIO * TYPICAL[-len(start) :]) ** 2 / start]
    best = minimize(scaled, np.ones(len(start)), jac=True, method="L-BFGS-B", bounds=bounds)
    variances = best.x * start
    S_inv = np.linalg.inv(C + np.tensordot(variances, B, axes=1))
    SB = S_inv @ B
    return ErrorVariances(variances, 0.5 * np.einsum("ckij,dkji->cd", SB, SB))


def cost(variances: Array, e: Array, C: Array, B: Array) -> tuple[float, Array]:
    """Return the mean of log|S| + e' S^-1 e over k residuals, and its gradient (c,)."""
    S = C + np.tensordot(variances, B, axes=1)
    S_inv = np.linalg.inv(S)
    w = np.einsum("kij,kj->ki", S_inv, e)
    value = float(np.linalg.slogdet(S)[1].sum() + np.einsum("ki,ki->", e, w))
    slope = np.einsum("kij,ckji->c", S_inv, B) - np.einsum("ki,ckij,kj->c", w, B, w)
    return value / len(e), np.asarray(slope / len(e), np.float64)
