"""Compiled loops of `grid_particles`: align a scan with the map of each of P particles."""

from __future__ import annotations

import math

import numpy as np

from impslam.geometry.algebra import solve
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.surfaces.features import Features
from impslam.surfaces.surface_map import Alignment, FitSums
from impslam.surfaces.tiles import Sorted, Tiles, evidence, sort
from impslam.types import Array, Ints

_INLIERS = 1  # of `Evidence.sums`


@kernel
def propose(
    pool: Tiles,
    maps: tuple[Ints, Ints, Ints],
    features: Features,
    guesses: Array,
    roots: Array,
    how: Alignment,
) -> tuple[Array, Array, Array]:
    """Align a scan with the map of each particle, from predicted poses (P, 3) with roots (P, 3, 3).

    `maps` are the map index (P,) of each particle, the tables (M, rows, columns) and their origin (2,).

    Returns
    -------
    u, information, cost : (P, 3), (P, 3, 3), (P,) the optimum u of guess + root u, its information,
        and -2 log of the posterior density there, up to a common constant
    """
    indices, tables, origin = maps
    count = len(guesses)
    u, information, cost = np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros(count)
    out = FitSums(np.empty((3, 3)), np.empty(3), np.empty(4))
    for p in range(count):
        seen = sort(tables[indices[p]], origin, features, guesses[p])
        if len(seen.features) < len(features):
            cost[p] = how.information * how.narrow**2 * (len(features) - len(seen.features))
        cost[p] += _align(pool, seen, (guesses[p], roots[p]), how, out, (u[p], information[p]))
    return u, information, cost


@kernel
def _align(
    pool: Tiles,
    seen: Sorted,
    prior: tuple[Array, Array],
    how: Alignment,
    out: FitSums,
    found: tuple[Array, Array],
) -> float:
    """Move u (3,) to the optimum, fill its information (3, 3), and return the cost there.

    `found` are these two outputs; `prior` is the predicted pose (3,) and its root (3, 3).
    """
    (guess, root), (u, information) = prior, found
    pose, b = guess.copy(), np.empty(3)
    for i in range(how.iterations):
        narrowing = min(1.0, i / (0.5 * how.iterations))
        scale = how.wide * (how.narrow / how.wide) ** narrowing
        evidence(pool, seen, pose, scale, out)
        w = _normal_equations(out, root, u, how, information, b)
        if not solve(information, b):
            b[:] = 0.0
        u -= b
        _add_to(guess, root, u, pose)
        if scale == how.narrow and np.abs(root @ b).max() < 1e-4:
            break
    evidence(pool, seen, pose, how.narrow, out)
    w = _normal_equations(out, root, u, how, information, b)
    outliers = len(seen.features) - out.sums[_INLIERS]
    prior_cost = (u * u).sum() if w == 1.0 else -how.slack2 * math.log(w)
    return float(how.information * how.narrow**2 * outliers + prior_cost)


@kernel
def _normal_equations(
    out: FitSums, root: Array, u: Array, how: Alignment, information: Array, b: Array
) -> float:
    """Fill information (3, 3) and gradient b (3,) at u, including the prior; return the prior's weight."""
    w = 1.0 / (1.0 + (u * u).sum() / how.slack2)
    for i in range(3):
        b[i] = w * u[i]
        for k in range(3):
            b[i] += how.information * root[k, i] * out.g[k]
        for j in range(3):
            information[i, j] = w if i == j else 0.0
            for k in range(3):
                for m in range(3):
                    information[i, j] += how.information * root[k, i] * out.H[k, m] * root[m, j]
    return float(w)


@kernel
def _add_to(guess: Array, root: Array, u: Array, pose: Array) -> None:
    """Fill a pose (3,) with guess + root u."""
    for i in range(3):
        pose[i] = guess[i] + root[i, 0] * u[0] + root[i, 1] * u[1] + root[i, 2] * u[2]
    pose[2] = wrap_in_kernel(pose[2])


@kernel
def ancestors(parents: Ints, rows: Ints, steps: int) -> Ints:
    """Return the ancestors (r,) of the particles in some rows of the newest keyframe, `steps` earlier.

    `parents` (n, P) is the row, at the previous keyframe, of the parent of each particle.
    """
    out = rows.copy()
    for k in range(len(parents) - 1, len(parents) - 1 - steps, -1):
        for i in range(len(out)):
            out[i] = parents[k, out[i]]
    return out


@kernel
def lineage(parents: Ints, row: int) -> Ints:
    """Return the rows (n,) at all keyframes of the ancestors of a particle of the newest one."""
    out = np.empty(len(parents), np.int64)
    for k in range(len(parents) - 1, -1, -1):
        out[k] = row
        row = parents[k, row]
    return out
