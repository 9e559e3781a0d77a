"""The search of JCBB: branch and bound over the observations of a scan (Neira & Tardós 2001, Fig. 4).

Pairs are grouped by observation; pair p occupies rows `starts[p]:starts[p + 1]` of the innovation
and of its covariance S. A hypothesis assigns one pair or none to each observation. Its joint
distance is updated pair by pair with the Cholesky factor of its block of S: no matrix is inverted, and
backtracking is free.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints, Mask

NONE = -1
_UNVISITED = -2  # no pair of the observation tried yet


System: TypeAlias = tuple[Array, Array]
"""S (rows, rows) and the innovation nu (rows,) of all pairs at once."""
Pairs: TypeAlias = tuple[Ints, Ints]
"""First row of each pair and the end of the last (pairs + 1,), and its landmark (pairs,)."""
Sums: TypeAlias = tuple[Ints, Ints, Array, Array]
"""Number of rows and pairs, d^2, and d^2 + log det S of the observations before i, each (n + 1,)."""
Factor: TypeAlias = tuple[Ints, Array, Array]
"""Rows of S, the factor L of their block, and y with L y = nu; filled up to some length."""


@kernel
def _append(system: System, factor: Factor, top: int, start: int, stop: int) -> tuple[float, float]:
    """Extend the factor of `rows[:top]` by rows start:stop; return the growth of d^2 and log det."""
    S, nu = system
    rows, L, y = factor
    distance2, log_det = 0.0, 0.0
    for row in range(start, stop):
        index = top + row - start
        rows[index] = row
        value = nu[row]
        for q in range(index + 1):
            entry = S[row, rows[q]]
            for r in range(q):
                entry -= L[index, r] * L[q, r]
            if q == index:
                L[index, q] = math.sqrt(max(entry, 1e-300))
            else:
                L[index, q] = entry / L[q, q]
                value -= L[index, q] * y[q]
        y[index] = value / L[index, index]
        distance2 += y[index] * y[index]
        log_det += 2.0 * math.log(L[index, index])
    return distance2, log_det


@kernel
def _score_pairs(
    system: System,
    factor: Factor,
    top: int,
    pairs: Pairs,
    group: tuple[int, int],
    used: Mask,
    cost: Array,
) -> int:
    """Write the increase of d^2 + log det S by each pair of a group; return the number of pairs tried."""
    starts, landmarks = pairs
    tried = 0
    for p in range(*group):
        cost[p] = np.inf
        if not used[landmarks[p]]:
            distance2, log_det = _append(system, factor, top, starts[p], starts[p + 1])
            cost[p] = distance2 + log_det
            tried += 1
    return tried


@kernel
def _take(system: System, factor: Factor, starts: Ints, p: int, i: int, sums: Sums) -> None:
    """Write the sums after observation i takes pair p, or NONE."""
    top, count, d2, score = sums
    top[i + 1], count[i + 1], d2[i + 1], score[i + 1] = top[i], count[i], d2[i], score[i]
    if p != NONE:
        distance2, log_det = _append(system, factor, top[i], starts[p], starts[p + 1])
        d2[i + 1] += distance2
        score[i + 1] += distance2 + log_det
        top[i + 1] += starts[p + 1] - starts[p]
        count[i + 1] += 1


@kernel
def _cheapest(cost: Array, first: int, last: int) -> int:
    """Return the cheapest pair left in first:last, or NONE if all have been tried."""
    best, best_score = NONE, np.inf
    for p in range(first, last):
        if cost[p] < best_score:
            best, best_score = p, cost[p]
    return best


@kernel
def search(
    system: System, pairs: Pairs, groups: Ints, rest: Ints, floor: Array, limits: Array, budget: int
) -> tuple[Ints, bool]:
    """Return the pair chosen for each of n observations, or NONE, and whether the search was complete.

    The largest number of pairs whose joint d^2 passes the gate wins; then the least d^2 + log det S.
    A branch is pruned if it cannot pass the gate, or cannot win, even if all remaining observations match
    at distance 0. The cheapest pair given those already chosen is tried first, so the
    first descent is the sequential nearest neighbour; every hypothesis on the path is a candidate.

    Parameters
    ----------
    system : S and nu of all pairs
    pairs : (pairs + 1,) first row of each pair, (pairs,) its landmark, numbered from 0
    groups : (n + 1,), first pair of each observation
    rest : (n + 1,), maximum number of rows of observations i, i + 1, ...
    floor : (n + 1,), minimum log det that they add: that of their own R
    limits : (rest[0] + 1,), the gate on d^2 by degrees of freedom
    budget : pairs to try before the best hypothesis so far is returned
    """
    starts, landmarks = pairs
    n, total = len(groups) - 1, len(limits) - 1
    factor = (np.empty(total, np.int64), np.empty((total, total)), np.empty(total))
    choice, best = np.full(n + 1, _UNVISITED), np.full(n, NONE)
    used, cost = np.zeros(len(landmarks), np.bool_), np.empty(len(landmarks))
    top, count = np.zeros(n + 1, np.int64), np.zeros(n + 1, np.int64)
    d2, score = np.zeros(n + 1), np.zeros(n + 1)
    sums = top, count, d2, score
    best_count, best_score, i = 0, np.inf, 0
    while i >= 0:
        if choice[i] >= 0:
            used[landmarks[choice[i]]] = False
        most = count[i] + n - i
        pruned = most < best_count or (most == best_count and score[i] + floor[i] >= best_score)
        pruned = pruned or d2[i] > limits[top[i] + rest[i]]
        if pruned or choice[i] == NONE or i == n or budget < 0:
            choice[i] = _UNVISITED
            i -= 1
            continue
        if choice[i] == _UNVISITED:
            budget -= _score_pairs(
                system, factor, top[i], pairs, (groups[i], groups[i + 1]), used, cost
            )
        p = choice[i] = _cheapest(cost, groups[i], groups[i + 1])
        _take(system, factor, starts, p, i, sums)
        i += 1
        if p != NONE:
            cost[p], used[landmarks[p]] = np.inf, True
        better = count[i] > best_count or (count[i] == best_count and score[i] < best_score)
        if better and d2[i] <= limits[top[i]]:
            best_count, best_score = count[i], score[i]
            best[:i], best[i:] = choice[:i], NONE
    return best, budget >= 0
