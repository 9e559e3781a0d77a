"""Scores of pairings: innovations, their covariances, and whether extents allow the pairing."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from impslam.association.base import Hypotheses
from impslam.filters.atlas import Table
from impslam.filters.belief import GaussianBelief
from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints, Mask, Observation


@kernel
def _distances(innovation: Array, HPH: Array, R: Array) -> tuple[Array, Array, Array]:
    """Return S (a, k, dz, dz), nu^T S^-1 nu (a, k) and log det S (a, k) by Cholesky."""
    a, k, dz = innovation.shape
    S = np.empty((a, k, dz, dz))
    distance2, log_det = np.empty((a, k)), np.empty((a, k))
    L, y = np.zeros((dz, dz)), np.empty(dz)
    for i in range(a):
        for j in range(k):
            total, root = 0.0, 1.0  # root: that of det S
            for p in range(dz):
                value = innovation[i, j, p]
                for q in range(p + 1):
                    entry = HPH[j, p, q] + R[i, p, q]
                    S[i, j, p, q] = S[i, j, q, p] = entry
                    for r in range(q):
                        entry -= L[p, r] * L[q, r]
                    L[p, q] = math.sqrt(max(entry, 1e-300)) if p == q else entry / L[q, q]
                for q in range(p):
                    value -= L[p, q] * y[q]
                y[p] = value / L[p, p]
                total += y[p] * y[p]
                root *= L[p, p]
            distance2[i, j], log_det[i, j] = total, 2.0 * math.log(root)
    return S, distance2, log_det


def score(
    belief: GaussianBelief, table: Table, observations: Sequence[Observation], indices: Ints
) -> Hypotheses:
    """Return all pairings of the observations at `indices` with the landmarks of a table."""
    model, pose = table.model, belief.mean[:3].copy()
    states = table.states(belief.mean)
    asked = [observations[i] for i in indices]
    prediction = model.predict(pose, states)
    z, R = np.array([o.z for o in asked]), np.array([o.R for o in asked])
    innovation = model.residual(z[:, None], prediction.z[None])
    HPH = belief.innovation_blocks(table.offsets, prediction.z_D_pose, prediction.z_D_m)
    S, distance2, log_det = _distances(innovation, HPH, R)

    def apart() -> tuple[Array, Array]:
        metres, radians = zip(*(model.distance(pose, states, o) for o in asked), strict=True)
        return np.array(metres), np.array(radians)

    return Hypotheses(
        asked[0].kind,
        indices,
        table.ids,
        table.labels,
        innovation,
        S,
        distance2,
        log_det,
        apart,
        _possible(belief, table, asked, states),
    )


def _possible(
    belief: GaussianBelief, table: Table, asked: list[Observation], states: Array
) -> Mask:
    """Tell (a, k) which pairings the extents allow, within two standard deviations along them."""
    pose = belief.mean[:3]
    seen = table.model.extents(pose, states, asked)
    overlap = table.model.overlap(pose, states, table.extents, seen)
    if overlap is None:
        return np.ones(seen.shape[:2], np.bool_)
    variance = belief.innovation_blocks(
        table.offsets, overlap.gap_D_pose[:, None], overlap.gap_D_m[:, None]
    )[:, 0, 0]
    limit = overlap.allowed + 2.0 * np.sqrt(np.maximum(variance, 0.0))
    return np.asarray(overlap.gap <= limit, dtype=np.bool_)
