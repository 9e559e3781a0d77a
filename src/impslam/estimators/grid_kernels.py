"""Compiled loops of `grid_particles`: a scan is laid on the map of each of P particles."""

from __future__ import annotations

import math

import numpy as np

from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.surfaces.features import Features
from impslam.surfaces.surface_map import Alignment, Evidence, solve_3x3
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
    """Lay a scan on the map of each particle, from poses (P, 3) as moved, unsure by roots (P, 3, 3).

    `maps` are each particle's map (P,), the tables (M, rows, columns) and their origin (2,).

    Returns
    -------
    u, information, cost : (P, 3), (P, 3, 3), (P,) the likeliest u of guess + root u, its information,
        and -2 log of the posterior's density there, up to a constant that all particles share
    """
    which, tables, origin = maps
    count = len(guesses)
    u, information, cost = np.zeros((count, 3)), np.zeros((count, 3, 3)), np.zeros(count)
    out = Evidence(np.empty((3, 3)), np.empty(3), np.empty(4))
    for p in range(count):
        seen = sort(tables[which[p]], origin, features, guesses[p])
        if len(seen.features) < len(features):
            cost[p] = how.information * how.narrow**2 * (len(features) - len(seen.features))
        cost[p] += _lay(pool, seen, (guesses[p], roots[p]), how, out, (u[p], information[p]))
    return u, information, cost


@kernel
def _lay(
    pool: Tiles,
    seen: Sorted,
    prior: tuple[Array, Array],
    how: Alignment,
    out: Evidence,
    found: tuple[Array, Array],
) -> float:
    """Move u (3,) to the optimum, fill its information (3, 3), and return the cost there.

    These two are what is `found`; `prior` is where the motion leads (3,), and the root (3, 3).
    """
    (guess, root), (u, information) = prior, found
    pose, b, step = guess.copy(), np.empty(3), np.empty(3)
    for i in range(how.iterations):
        narrowing = min(1.0, i / (0.5 * how.iterations))
        scale = how.wide * (how.narrow / how.wide) ** narrowing
        evidence(pool, seen, pose, scale, out)
        w = _in_root(out, root, u, how, information, b)
        step[0], step[1], step[2] = solve_3x3(information, b)
        u -= step
        _place(guess, root, u, pose)
        if scale == how.narrow and np.abs(root @ step).max() < 1e-4:
            break
    evidence(pool, seen, pose, how.narrow, out)
    w = _in_root(out, root, u, how, information, b)
    off = len(seen.features) - out.sums[_INLIERS]
    by_motion = (u * u).sum() if w == 1.0 else -how.slack2 * math.log(w)
    return float(how.information * how.narrow**2 * off + by_motion)


@kernel
def _in_root(
    out: Evidence, root: Array, u: Array, how: Alignment, information: Array, b: Array
) -> float:
    """Fill information (3, 3) and slope b (3,) by u, the prior's included; return the prior's weight."""
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
def _place(guess: Array, root: Array, u: Array, pose: Array) -> None:
    """Fill a pose (3,) with guess + root u."""
    for i in range(3):
        pose[i] = guess[i] + root[i, 0] * u[0] + root[i, 1] * u[1] + root[i, 2] * u[2]
    pose[2] = wrap_in_kernel(pose[2])


@kernel
def ancestors(parents: Ints, rows: Ints, steps: int) -> Ints:
    """Return who the particles in some rows (r,) of the newest keyframe were, so many keyframes before.

    `parents` (n, P) tells for each keyframe whose place at the one before each particle took up.
    """
    out = rows.copy()
    for k in range(len(parents) - 1, len(parents) - 1 - steps, -1):
        for i in range(len(out)):
            out[i] = parents[k, out[i]]
    return out


@kernel
def lineage(parents: Ints, row: int) -> Ints:
    """Return the rows (n,) at all keyframes of the particle in a row of the newest one."""
    out = np.empty(len(parents), np.int64)
    for k in range(len(parents) - 1, -1, -1):
        out[k] = row
        row = parents[k, row]
    return out
