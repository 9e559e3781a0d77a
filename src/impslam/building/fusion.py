"""Fuse the sightings of each landmark into one estimate with a consistent covariance.

The estimate is weighted least squares: sighting i has the weight W_i = L^-1 L_i, with L_i its information
relative to the others and L their sum. Its error is the sum of W_i e_i. The errors e_i have unknown
correlations: keyframes share the error of the path, and sightings the shape of the surface and the bias of
the sensor. For any correlation, and any w_i > 0 with a sum of 1,

    cov(sum a_i) <= sum cov(a_i) / w_i

(covariance intersection; Julier and Uhlmann 1997). The trace of the bound is minimal for w_i proportional
to the square root of the trace of cov(a_i). Many sightings thus never seem to average out an error.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from impslam.building.groups import local
from impslam.building.sightings import PlacedSightings
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints

_STEPS = 3  # of Gauss-Newton; sightings of a line differ by a few degrees
_MIN_ARM = 0.25  # m, minimum half length of a line to weight its direction


class Fused(NamedTuple):
    """L landmarks.

    Attributes
    ----------
    states : (L, 3) x, y, phi of the frame: position of a point, or middle and normal of a line
    covariances : (L, 3) distinct entries, of x, y of points, of offset and direction of lines
    extents : (L, 2) m, begin and end along the line, from its frame
    """

    states: Array
    covariances: Array
    extents: Array


@kernel
def _inverse(matrix: Array, out: Array) -> None:
    """Write the inverse of a symmetric matrix by its three distinct entries."""
    det = matrix[0] * matrix[2] - matrix[1] * matrix[1]
    out[0], out[1], out[2] = matrix[2] / det, -matrix[1] / det, matrix[0] / det


@kernel
def _step(placed: PlacedSightings, index: Ints, is_line: bool, states: Array, sums: Array) -> None:
    """Move states (L, 3) by a Gauss-Newton step, and write their covariances (L, 3) to sums."""
    value, cov, info = np.empty(2), np.empty(3), np.empty(3)
    right = np.zeros((len(states), 2))
    sums[:] = 0.0
    for i in range(len(index)):
        g = index[i]
        local(states[g], placed.frames[i], placed.relative[i], is_line, value, cov)
        _inverse(cov, info)
        sums[g] += info
        right[g, 0] += info[0] * value[0] + info[1] * value[1]
        right[g, 1] += info[1] * value[0] + info[2] * value[1]
    for g in range(len(states)):
        _inverse(sums[g].copy(), sums[g])
        u = sums[g, 0] * right[g, 0] + sums[g, 1] * right[g, 1]
        v = sums[g, 1] * right[g, 0] + sums[g, 2] * right[g, 1]
        if is_line:
            states[g, 0] += u * math.cos(states[g, 2])
            states[g, 1] += u * math.sin(states[g, 2])
            states[g, 2] = wrap_in_kernel(states[g, 2] + v)
        else:
            states[g, 0] += u
            states[g, 1] += v


@kernel
def _extents(placed: PlacedSightings, index: Ints, is_line: bool, states: Array) -> Array:
    """Move the frames (L, 3) of lines to their middles, and return the extents (L, 2)."""
    out = np.zeros((len(states), 2))
    out[:, 0], out[:, 1] = np.inf, -np.inf
    value, cov = np.empty(2), np.empty(3)
    for i in range(len(index)):
        g = index[i]
        low, high = local(states[g], placed.frames[i], placed.relative[i], is_line, value, cov)
        out[g, 0], out[g, 1] = min(out[g, 0], low), max(out[g, 1], high)
    if is_line:  # a point has no direction
        for g in range(len(states)):
            middle = 0.5 * (out[g, 0] + out[g, 1])
            states[g, 0] -= middle * math.sin(states[g, 2])
            states[g, 1] += middle * math.cos(states[g, 2])
            out[g] -= middle
    return out


@kernel
def _shares(
    placed: PlacedSightings,
    index: Ints,
    is_line: bool,
    fused: Fused,
    covariances: Array,
    shares: Array,
) -> None:
    """Write the distinct entries of cov(W_i e_i) of each sighting to shares (n, 3)."""
    value, cov, info = np.empty(2), np.empty(3), np.empty(3)
    W, C = np.empty((2, 2)), np.empty((2, 2))
    for i in range(len(index)):
        g = index[i]
        local(fused.states[g], placed.frames[i], placed.relative[i], is_line, value, cov)
        _inverse(cov, info)
        L = covariances[g]
        W[0, 0], W[0, 1] = L[0] * info[0] + L[1] * info[1], L[0] * info[1] + L[1] * info[2]
        W[1, 0], W[1, 1] = L[1] * info[0] + L[2] * info[1], L[1] * info[1] + L[2] * info[2]
        local(fused.states[g], placed.frames[i], placed.whole[i], is_line, value, cov)
        C[0, 0], C[0, 1], C[1, 0], C[1, 1] = cov[0], cov[1], cov[1], cov[2]
        shares[i] = 0.0
        for a in range(2):
            for b in range(2):
                shares[i, 0] += W[0, a] * C[a, b] * W[0, b]
                shares[i, 1] += W[0, a] * C[a, b] * W[1, b]
                shares[i, 2] += W[1, a] * C[a, b] * W[1, b]


@kernel
def fuse(placed: PlacedSightings, index: Ints, first: Ints, is_line: bool) -> Fused:
    """Return the landmarks of sightings; see the module.

    `index` (n,) is the landmark of each sighting and `first` (L,) the first sighting of each.
    """
    count = len(first)
    states, covariances = placed.frames[first, :3].copy(), np.empty((count, 3))
    for _ in range(_STEPS):
        _step(placed, index, is_line, states, covariances)
    fused = Fused(states, np.zeros((count, 3)), _extents(placed, index, is_line, states))
    _step(placed, index, is_line, states, covariances)
    shares, total = np.empty((len(index), 3)), np.zeros(count)
    _shares(placed, index, is_line, fused, covariances, shares)
    for is_first_pass in (True, False):
        for i in range(len(index)):
            g, share = index[i], shares[i]
            arm = (
                max(0.5 * (fused.extents[g, 1] - fused.extents[g, 0]), _MIN_ARM) if is_line else 1.0
            )
            root = math.sqrt(max(share[0] + arm * arm * share[2], 1e-300))
            if is_first_pass:
                total[g] += root
            else:
                fused.covariances[g] += total[g] / root * share
    return fused
