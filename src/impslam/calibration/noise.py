"""How much odometry and matches err at random: variances by maximum likelihood.

A residual has the covariance C + sum of v_j B_j, with C from the scans and a B_j for each way in which
odometry or matches may err. The v_j >= 0 minimise the sum of log|S| + e' S^-1 e.
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
    sums,
)
from impslam.calibration.residuals import SENSOR, Drive, residuals
from impslam.calibration.scan_pairs import LidarMotions
from impslam.geometry.se2 import exp, log
from impslam.types import Array

MATCHING = ("matching", "matching_yaw", "matching_offset", "jitter")
"""What matches err by beyond what their scans say, m, rad and m; and what their stamps do, s."""
_JITTER = MATCHING.index("jitter")
WEAKEST = np.diag([1.0, 1.0, 1.0, 1.0])
"""Information that every motion has: of 1 m and 1 rad, so that it has an inverse along a corridor."""
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
"""Where the search begins: units as in `names`."""
MOST = 100.0
"""How many times as large they are at most: 0.2 m, 0.1 rad, 0.2 s. Beyond, all would be noise."""


STEP = 1e-6
"""m and rad, of differences."""


class Noise(NamedTuple):
    """Variances (c,) of the ways to err, and their information (c, c)."""

    variances: Array
    information: Array


def names(drive: Drive) -> tuple[str, ...]:
    """Return the names of the ways to err: of matches, then keys of the config's odometry."""
    table = "slip" if isinstance(drive.model, DifferentialDrive) else "noise"
    along = "wheel_noise" if table == "slip" else "noise.forward"
    rest = ("sideways", "turn_per_distance", "turn_per_turn")
    return (*MATCHING, along, *(f"{table}.{one}" for one in rest))


def of_scans(drive: Drive) -> Array:
    """Return the covariances C (k, 4, 4) of the motions that the scans tell."""
    return np.asarray(np.linalg.inv(drive.motions.information + WEAKEST), np.float64)


class _Lengths(NamedTuple):
    """Ways and turns (k,) of k motions, all counted positive, and the travels of both wheels, m."""

    way: Array
    turn: Array
    left: Array
    right: Array


def spreads(drive: Drive, parameters: Array) -> Array:
    """Return B (c, k, 4, 4), the covariances for variances of 1, in the order of `names`.

    Errors of odometry arise along the whole way, and are told in the middle of it: there a heading
    that strays by q per metre leaves the place off by q d^3 / 12 across a way d.
    """
    base, lengths = _driven(drive, parameters)
    Q = _of_twists(lengths, base)
    if isinstance(drive.model, DifferentialDrive):
        Q[0] = _of_wheels(lengths, np.abs(base.way) ** 2 / 12.0, parameters[2])
    G = _into_lidar(base.way, base.turn, *_mount(drive, parameters))
    return np.concatenate((_of_matches(drive.motions), G @ Q @ np.swapaxes(G, -1, -2)))


def slopes(drive: Drive, parameters: Array, variances: Array) -> Array:
    """Return (n, k, 4, 4) how the covariance of noise in the readings changes with the parameters (n,).

    The noise of odometry, and stamps that jitter, are in the readings, and are as they are; what they do
    to a motion depends on the parameters. Without these slopes least squares makes what it multiplies
    too small: a scale is too small, and a track seems wide, by the share that noise has of the squared
    motions (regression dilution; Fuller 1987, Sec. 1.1). `variances` (c,) are in the order of `names`.
    """
    base, lengths = _driven(drive, parameters)
    p, (m, yaw) = len(drive.model.names), _mount(drive, parameters)
    G, of_odometry = _into_lidar(base.way, base.turn, m, yaw), variances[len(MATCHING) :]
    if isinstance(drive.model, DifferentialDrive):
        Q, Q_D = _slopes_of_wheels(lengths, base, parameters[:3])
        Q, Q_D = of_odometry[0] * Q, of_odometry[0] * Q_D
    else:
        Q, Q_D = _slopes_of_twists(lengths, base, parameters[:p], of_odometry)
    out: Array = variances[_JITTER] * _slopes_of_jitter(drive, parameters)
    out[:p] += G @ Q_D @ np.swapaxes(G, -1, -2)
    for j, other in enumerate(((m + STEP, yaw), (m + 1j * STEP, yaw), (m, yaw + STEP))):
        moved = _into_lidar(base.way, base.turn, *other)
        out[p + j] += (
            moved @ Q @ np.swapaxes(moved, -1, -2) - G @ Q @ np.swapaxes(G, -1, -2)
        ) / STEP
    return out


def _slopes_of_wheels(lengths: _Lengths, base: Motion, values: Array) -> tuple[Array, Array]:
    """Return the covariance (k, 4, 4) of wheel noise of unit variance, and (3, k, 4, 4) its slopes."""
    (radius, ratio, track), across = values, np.abs(base.way) ** 2 / 12.0
    Q = _of_wheels(lengths, across, track)
    of_right = _of_wheels(lengths._replace(left=np.zeros_like(across)), across, track)
    wider = _of_wheels(lengths, across, track * (1.0 + STEP)) - Q
    return Q, np.array([2.0 / radius * Q, 2.0 / ratio * of_right, wider / (track * STEP)])


def _slopes_of_twists(
    lengths: _Lengths, base: Motion, values: Array, variances: Array
) -> tuple[Array, Array]:
    """Return the covariance (k, 4, 4) of the noise of poses or speeds, and (p, k, 4, 4) its slopes.

    An error of a way grows with the scale of ways, that of a turn with the one of turns; a way that is
    read wrong turns the robot by so much per metre.
    """
    Q = np.tensordot(variances, _of_twists(lengths, base), axes=1)
    E = np.zeros((len(values), 4, 4))
    E[0, 0, 0] = E[0, 1, 1] = 1.0 / values[0]
    E[1, 2, 2] = 1.0 / values[1]
    E[2:, 2, 0] = 1.0 / values[0]
    half = E[:, None] @ Q
    return Q, half + np.swapaxes(half, -1, -2)


def _slopes_of_jitter(drive: Drive, parameters: Array) -> Array:
    """Return (n, k, 4, 4) the slopes of what stamps that jitter by 1 s do: speeds grow with the scales."""
    found, p = drive.motions, len(drive.model.names)
    still = p + np.array([SENSOR.index("latency"), SENSOR.index("range_offset")])
    speeds = residuals(drive, parameters).by_all / (found.ends - found.begins)[:, None, None]
    speeds[:, :, still] = 0.0
    half: Array = 2.0 * np.einsum("kin,kj->nkij", speeds, _speeds(found))
    return half + np.swapaxes(half, -1, -2)


def _mount(drive: Drive, parameters: Array) -> tuple[complex, float]:
    x, y, yaw = parameters[len(drive.model.names) :][:3]
    return complex(x, y), float(yaw)


def _driven(drive: Drive, parameters: Array) -> tuple[Motion, _Lengths]:
    """Return the motions of base_link, and how long they are."""
    model, found, p = drive.model, drive.motions, len(drive.model.names)
    latency, steps = parameters[p + 3], model.steps(parameters[:p])
    base = motion(model, parameters[:p], latency, found.begins, found.ends)
    left, right = (np.abs(turned) * parameters[0] for turned in model.travels())
    table = np.column_stack((np.abs(steps.way), np.abs(steps.turn), left, right))
    return base, _Lengths(*sums(model, table, found.begins - latency, found.ends - latency).T)


def _of_twists(lengths: _Lengths, base: Motion) -> Array:
    """Return (4, k, 4, 4) what errors of ways, sideways and of the heading do in the middle of a motion."""
    across, way = np.abs(base.way) ** 2 / 12.0, lengths.way
    Q = np.zeros((4, len(way), 4, 4))
    Q[0, :, 0, 0] = Q[1, :, 1, 1] = way
    for j, spread in ((2, way), (3, lengths.turn)):
        Q[j, :, 1, 1], Q[j, :, 2, 2] = across * spread, spread
    return Q


def _of_wheels(lengths: _Lengths, across: Array, track: float) -> Array:
    """Return (k, 4, 4) what wheel noise of unit variance per metre does in the middle of a motion."""
    both, difference = lengths.left + lengths.right, lengths.right - lengths.left
    Q = np.zeros((len(both), 4, 4))
    Q[:, 0, 0], Q[:, 2, 2] = 0.25 * both, both / track**2
    Q[:, 0, 2] = Q[:, 2, 0] = 0.5 * difference / track
    Q[:, 1, 1] = across * Q[:, 2, 2]
    return Q


def _of_matches(found: LidarMotions) -> Array:
    """Return (4, k, 4, 4) of `MATCHING`.

    What seems an error of the ranges, and is the shape of things, takes the pose along; a stamp that is
    wrong shifts the motion as a whole.
    """
    B = np.zeros((4, len(found.begins), 4, 4))
    B[0, :, 0, 0] = B[0, :, 1, 1] = B[1, :, 2, 2] = 1.0
    offset = np.linalg.inv(found.information + WEAKEST)[:, 3]
    offset /= offset[:, 3:]
    B[2] = np.einsum("ki,kj->kij", offset, offset)
    speeds = _speeds(found)
    B[_JITTER] = 2.0 * np.einsum("ki,kj->kij", speeds, speeds)
    return B


def _speeds(found: LidarMotions) -> Array:
    """Return (k, 4) the motions per second; 0 last, as the range offset stays."""
    still = np.zeros(len(found.begins))
    return np.column_stack((found.T_begin_end, still)) / (found.ends - found.begins)[:, None]


def _into_lidar(way: Complex, turn: Array, m: complex, yaw: float) -> Array:
    """Return (k, 4, 4) what an error in the middle of base_link's motion does to the lidar's."""
    half = exp(0.5 * log(np.column_stack((way.real, way.imag, turn))))
    facing, rest = np.exp(1j * half[:, 2]), half[:, 0] + 1j * half[:, 1]
    into = np.exp(-1j * yaw)
    along, lever = into * facing, into * 1j * (facing * rest + np.exp(1j * turn) * m)
    G = np.zeros((len(way), 4, 4))
    G[:, 0, 0], G[:, 1, 0] = along.real, along.imag
    G[:, 0, 1], G[:, 1, 1] = -along.imag, along.real
    G[:, 0, 2], G[:, 1, 2], G[:, 2, 2] = lever.real, lever.imag, 1.0
    return G


def fitted(e: Array, C: Array, B: Array, start: Array) -> Noise:
    """Return the variances that explain residuals e (k, 4) best, sought from some (c,)."""

    def scaled(factors: Array) -> tuple[float, Array]:
        value, slope = cost(factors * start, e, C, B)
        return value, slope * start

    largest = (MOST * TYPICAL[-len(start) :]) ** 2 / start
    bounds = [(0.0, float(most)) for most in largest]
    best = minimize(scaled, np.ones(len(start)), jac=True, method="L-BFGS-B", bounds=bounds)
    variances = best.x * start
    S_inv = np.linalg.inv(C + np.tensordot(variances, B, axes=1))
    SB = S_inv @ B
    return Noise(variances, 0.5 * np.einsum("ckij,dkji->cd", SB, SB))


def cost(variances: Array, e: Array, C: Array, B: Array) -> tuple[float, Array]:
    """Return the mean of log|S| + e' S^-1 e over k residuals, and its slope (c,)."""
    S = C + np.tensordot(variances, B, axes=1)
    S_inv = np.linalg.inv(S)
    w = np.einsum("kij,kj->ki", S_inv, e)
    value = float(np.linalg.slogdet(S)[1].sum() + np.einsum("ki,ki->", e, w))
    slope = np.einsum("kij,ckji->c", S_inv, B) - np.einsum("ki,ckij,kj->c", w, B, w)
    return value / len(e), np.asarray(slope / len(e), np.float64)
