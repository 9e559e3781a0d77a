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
from impslam.calibration.residuals import Drive
from impslam.calibration.scan_pairs import LidarMotions
from impslam.geometry.se2 import exp, log
from impslam.types import Array

MATCHING = ("matching", "matching_yaw", "matching_offset", "jitter")
"""What matches err by beyond what their scans say, m, rad and m; and what their stamps do, s."""
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
    across, way = np.abs(base.way) ** 2 / 12.0, lengths.way
    Q = np.zeros((4, len(way), 4, 4))
    if isinstance(drive.model, DifferentialDrive):
        Q[0] = _of_wheels(lengths, across, parameters[2])
    else:
        Q[0, :, 0, 0] = way
    Q[1, :, 1, 1] = way
    for j, spread in ((2, way), (3, lengths.turn)):
        Q[j, :, 1, 1], Q[j, :, 2, 2] = across * spread, spread
    G = _into_lidar(base.way, base.turn, *_mount(drive, parameters))
    return np.concatenate((_of_matches(drive.motions), G @ Q @ np.swapaxes(G, -1, -2)))


def slopes_of_wheels(drive: Drive, parameters: Array) -> Array:
    """Return (n, k, 4, 4) how the covariance of wheel noise changes with the parameters (n,).

    The noise is in the readings, and is as it is; what it does to a motion depends on the parameters.
    Without these slopes least squares makes what it multiplies too small: a track seems wide by the
    share that noise has of the squared turns (regression dilution; Fuller 1987, Sec. 1.1).
    """
    out = np.zeros((len(parameters), len(drive.motions.begins), 4, 4))
    if not isinstance(drive.model, DifferentialDrive):
        return out
    base, lengths = _driven(drive, parameters)
    (radius, ratio, track), across = parameters[:3], np.abs(base.way) ** 2 / 12.0
    m, yaw = _mount(drive, parameters)
    G, Q = _into_lidar(base.way, base.turn, m, yaw), _of_wheels(lengths, across, track)
    of_right = _of_wheels(lengths._replace(left=np.zeros_like(across)), across, track)
    wider = _of_wheels(lengths, across, track * (1.0 + STEP)) - Q
    for j, change in enumerate((2.0 / radius * Q, 2.0 / ratio * of_right, wider / (track * STEP))):
        out[j] = G @ change @ np.swapaxes(G, -1, -2)
    for j, other in enumerate(((m + STEP, yaw), (m + 1j * STEP, yaw), (m, yaw + STEP))):
        moved = _into_lidar(base.way, base.turn, *other)
        out[3 + j] = (
            moved @ Q @ np.swapaxes(moved, -1, -2) - G @ Q @ np.swapaxes(G, -1, -2)
        ) / STEP
    return out


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
    twist = found.T_begin_end / (found.ends - found.begins)[:, None]
    B[3, :, :3, :3] = 2.0 * np.einsum("ki,kj->kij", twist, twist)
    return B


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
