"""Scores of pairings: innovations, their covariances, and whether extents allow the pairing."""

from __future__ import annotations

import math
from functools import cache
from typing import TypeAlias

import numpy as np

from impslam.association.base import Hypotheses
from impslam.filters.atlas import Table
from impslam.filters.belief import POSE, Belief, GaussianBelief, innovation_blocks
from impslam.filters.columns import ObservationColumns
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel, plain
from impslam.landmarks.base import LandmarkModel
from impslam.types import Array, Ints, Mask

Known: TypeAlias = tuple[Array, Array, Array]
"""z (k, dz), z_D_pose (k, dz, 3) and z_D_m (k, dz, dim) of all landmarks."""
_NONE: Ints = np.empty(0, np.int64)


@kernel
def _variance_bound(P: Array, offsets: Ints, z_D_pose: Array, z_D_m: Array) -> Array:
    """Return a bound (k, dz) on the diagonal of each landmark's H P H^T, from few entries of P.

    With a row h = [h_pose, h_m] and any positive semidefinite P, h P h^T is at most twice
    h_pose P_pose h_pose^T + h_m P_m h_m^T, and the latter at most |h_m|^2 tr P_m.
    """
    k, dz, dim = z_D_m.shape
    out = np.empty((k, dz))
    for i in range(k):
        trace = 0.0
        for p in range(dim):
            trace += P[offsets[i] + p, offsets[i] + p]
        for a in range(dz):
            of_pose, square = 0.0, 0.0
            for p in range(POSE):
                of_pose += z_D_pose[i, a, p] ** 2 * P[p, p]
                for q in range(p):
                    of_pose += 2.0 * z_D_pose[i, a, p] * z_D_pose[i, a, q] * P[p, q]
            for p in range(dim):
                square += z_D_m[i, a, p] ** 2
            out[i, a] = 2.0 * (of_pose + square * trace)
    return out


@kernel
def _near(
    z: Array, known: Array, bound: Array, R: Array, angles: Mask, gate: float
) -> tuple[Ints, Ints, Ints]:
    """Return the pairs that may be in the gate: observations (p,), landmarks (p,), and distinct landmarks.

    The landmarks of pairs are indices into the distinct ones (u,). nu^T S^-1 nu is at least nu_p^2 / S_pp
    for every p, so pairs with any nu_p^2 beyond gate S_pp are excluded.
    """
    (a, dz), k = z.shape, len(known)
    first, second = np.empty(a * k, np.int64), np.empty(a * k, np.int64)
    number, count = np.full(k, -1), 0
    for i in range(a):
        for j in range(k):
            inside = True
            for p in range(dz):
                value = z[i, p] - known[j, p]
                if angles[p]:
                    value = wrap_in_kernel(value)
                if value * value > gate * (bound[j, p] + R[i, p, p]):
                    inside = False
                    break
            if inside or gate == math.inf:
                first[count], second[count] = i, j
                number[j] = 0
                count += 1
    places = np.flatnonzero(number == 0)
    for used in range(len(places)):
        number[places[used]] = used
    for n in range(count):
        second[n] = number[second[n]]
    return first[:count].copy(), second[:count].copy(), places


@kernel
def _error_covariance(
    P: Array, offset: int, error: int, z_D_pose: Array, z_D_m: Array, out: Array
) -> None:
    """Fill out (dz,) with the covariance of a landmark's predicted observation and a common error."""
    for a in range(len(out)):
        out[a] = 0.0
        for p in range(POSE):
            out[a] += z_D_pose[a, p] * P[error, p]
        for p in range(z_D_m.shape[1]):
            entry = offset + p
            out[a] += z_D_m[a, p] * P[max(entry, error), min(entry, error)]


@kernel
def _innovations(
    pairs: tuple[Ints, Ints], z: Array, known: Array, HPH: Array, R: Array, angles: Mask
) -> tuple[Array, Array]:
    """Return nu (p, dz) and S = H P H^T + R (p, dz, dz) of pairs."""
    count, dz = len(pairs[0]), z.shape[1]
    nu, S = np.empty((count, dz)), np.empty((count, dz, dz))
    for n in range(count):
        i, j = pairs[0][n], pairs[1][n]
        for p in range(dz):
            value = z[i, p] - known[j, p]
            nu[n, p] = wrap_in_kernel(value) if angles[p] else value
            for q in range(p + 1):
                S[n, p, q] = S[n, q, p] = HPH[j, p, q] + R[i, p, q]
    return nu, S


@kernel
def _distances(nu: Array, S: Array) -> tuple[Array, Array]:
    """Return nu^T S^-1 nu (p,) and log det S (p,) of pairs, by Cholesky."""
    count, dz = nu.shape
    distance2, log_det = np.empty(count), np.empty(count)
    L, y = np.zeros((dz, dz)), np.empty(dz)
    for n in range(count):
        total, root = 0.0, 1.0  # root of det S
        for p in range(dz):
            value = nu[n, p]
            for q in range(p + 1):
                entry = S[n, p, q]
                for r in range(q):
                    entry -= L[p, r] * L[q, r]
                L[p, q] = math.sqrt(max(entry, 1e-300)) if p == q else entry / L[q, q]
            for q in range(p):
                value -= L[p, q] * y[q]
            y[p] = value / L[p, p]
            total += y[p] * y[p]
            root *= L[p, p]
        distance2[n], log_det[n] = total, 2.0 * math.log(root)
    return distance2, log_det


@kernel
def _inside(
    pairs: tuple[Ints, Ints], nu: Array, S: Array, gate: float
) -> tuple[Ints, Ints, tuple[Array, Array, Array, Array]]:
    """Return the pairs in the gate and their scores."""
    distance2, log_det = _distances(nu, S)
    inside = ~(distance2 > gate)
    scores = nu[inside], S[inside], distance2[inside], log_det[inside]
    return pairs[0][inside], pairs[1][inside], scores


@kernel
def _scored(
    P: Array,
    offsets: Ints,
    seen: tuple[Array, Array, Array, Ints],
    known: Known,
    angles: Mask,
    gate: float,
) -> tuple[Ints, Ints, tuple[Array, Array, Array, Array]]:
    """Return observations (p,) and landmarks (p,) of the pairs in the gate, and their scores.

    `seen` are z, R, the error of z per unit of the sensor's common error, and the index (a,) of that in the
    state: -1 if it is not in the state, (0,) if none is.
    """
    (z, R, shared, errors), (predicted, z_D_pose, z_D_m) = seen, known
    bound, R_bound = _variance_bound(P, offsets, z_D_pose, z_D_m), R
    if len(errors):  # cov(a + b) is at most 2 cov(a) + 2 cov(b)
        bound, R_bound = 2.0 * bound, 2.0 * R
    a, k, places = _near(z, predicted, bound, R_bound, angles, gate)
    HPH = innovation_blocks(P, offsets[places], z_D_pose[places], z_D_m[places])
    nu, S = _innovations((a, k), z, predicted[places], HPH, R, angles)
    cross = np.empty(z.shape[1])
    for n in range(len(a) if len(errors) else 0):
        i, j = a[n], places[k[n]]
        if errors[i] >= 0:
            _error_covariance(P, offsets[j], errors[i], z_D_pose[j], z_D_m[j], cross)
            for p in range(len(cross)):
                for q in range(len(cross)):
                    S[n, p, q] += cross[p] * shared[i, q] + cross[q] * shared[i, p]
    return _inside((a, places[k]), nu, S, gate)


@kernel
def _compared(
    seen: tuple[Array, Array], known: tuple[Array, Array], angles: Mask, gate: float
) -> tuple[Ints, Ints, tuple[Array, Array, Array, Array]]:
    """Return the same as `_scored`, given H P H^T (k, dz, dz) of all landmarks."""
    (z, R), (predicted, HPH) = seen, known
    variances = np.empty_like(predicted)
    for i, row in enumerate(HPH):
        for p in range(len(row)):
            variances[i, p] = row[p, p]
    a, k, places = _near(z, predicted, variances, R, angles, gate)
    nu, S = _innovations((a, k), z, predicted[places], HPH[places], R, angles)
    return _inside((a, places[k]), nu, S, gate)


def score(
    belief: GaussianBelief, table: Table, seen: ObservationColumns, gate: float
) -> Hypotheses:
    """Return the pairings of the observations of a kind with its landmarks in a gate.

    All landmarks are predicted, which is cheap; P is only read for nearby ones.
    """
    model, errors = table.model, _NONE
    z, z_D_pose, z_D_m = model.predict(belief.mean[:POSE].copy(), table.states(belief.mean))
    if belief.errors:
        errors = np.array([belief.errors.get(sensor, -1) for sensor in seen.sensors])
    observed = seen.z, seen.R, seen.shared, errors
    known, angles = (plain(z), plain(z_D_pose), plain(z_D_m)), angle_mask(type(model))
    scored = _scored(belief.P, table.offsets, observed, known, angles, gate)
    return _hypotheses(belief, table, seen, z, scored)


def score_predicted(
    belief: Belief, table: Table, seen: ObservationColumns, gate: float, known: tuple[Array, Array]
) -> Hypotheses:
    """Return the same as `score`, given predicted z (k, dz) with covariances (k, dz, dz) without R."""
    angles = angle_mask(type(table.model))
    scored = _compared((seen.z, seen.R), known, angles, gate)
    return _hypotheses(belief, table, seen, known[0], scored)


def _hypotheses(
    belief: Belief,
    table: Table,
    seen: ObservationColumns,
    predicted: Array,
    scored: tuple[Ints, Ints, tuple[Array, Array, Array, Array]],
) -> Hypotheses:
    """Return scored pairs as `Hypotheses`."""
    (indices, z, _, ends, _, _), (a, rows, scores) = seen, scored
    model, mean = table.model, belief.mean

    def apart(from_robot: bool) -> tuple[Array, Array]:
        if not from_robot:
            return model.distance(table.states(mean, rows), model.invert(mean[:POSE], z)[a])
        base = np.zeros(POSE)
        return model.distance(model.invert(base, predicted[rows]), model.invert(base, z)[a])

    possible = np.ones(len(a), np.bool_)
    if model.has_extent and len(a):
        possible = _possible(belief, table, ends[a], rows)
    ids = indices.take(a), table.ids.take(rows), table.labels.take(rows)
    kind_flags = model.unique, model.has_extent
    return Hypotheses(table.kind, *ids, *scores, apart, possible, *kind_flags)


@cache
def angle_mask(model: type[LandmarkModel]) -> Mask:
    """Return which components (dim_z,) of a kind's z are angles."""
    mask = np.zeros(model.dim_z, np.bool_)
    mask[list(model.z_angles)] = True
    return mask


def _possible(belief: Belief, table: Table, ends: Array, rows: Ints) -> Mask:
    """Return (p,) which pairings the extents allow, within two standard deviations along them.

    `ends` (p, 2, 2) are the observations' end points, `rows` (p,) are the landmarks.
    """
    model, pose, m = table.model, belief.mean[:POSE], table.states(belief.mean, rows)
    overlap = model.overlap(pose, m, table.extents[rows], model.extents(pose, m, ends))
    possible: Mask = overlap.gap <= overlap.allowed
    far = (~possible).nonzero()[0]
    if len(far):
        variance = belief.innovation_blocks(
            table.offsets[rows[far]], overlap.gap_D_pose[far, None], overlap.gap_D_m[far, None]
        )[:, 0, 0]
        slack = 2.0 * np.sqrt(np.maximum(variance, 0.0))
        possible[far] = overlap.gap[far] <= overlap.allowed + slack
    return possible
