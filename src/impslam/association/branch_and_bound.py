"""The search of JCBB: branch and bound over the observations of a scan (Neira & Tardós 2001, Fig. 4).

Pairs stand grouped by observation; pair p occupies rows `starts[p]:starts[p + 1]` of the innovation
and of its covariance S. A hypothesis gives each observation one of its pairs or none. Its joint
distance grows pair by pair with the Cholesky factor of its block of S: nothing is ever inverted, and
stepping back costs nothing.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints, Mask

NONE = -1
_FRESH = -2  # not looked at yet


System: TypeAlias = tuple[Array, Array]
"""S (rows, rows) and the innovation nu (rows,) of all pairs at once."""
Pairs: TypeAlias = tuple[Ints, Ints]
"""First row of each pair and the end of the last (pairs + 1,), and its landmark (pairs,)."""
Sums: TypeAlias = tuple[Ints, Ints, Array, Array]
"""Rows, pairs, d^2, and d^2 + log det S of the pairs of the observations before i, each (n + 1,)."""
Factor: TypeAlias = tuple[Ints, Array, Array]
"""Rows of S, the factor L of their block, and y with L y = nu; filled up to some length."""


@kernel
def _append(system: System, factor: Factor, top: int, start: int, stop: int) -> tuple[float, float]:
    """Extend the factor of `rows[:top]` by rows start:stop; return the growth of d^2 and log det."""
    S, nu = system
    rows, L, y = factor
    distance2, log_det = 0.0, 0.0
    for row in range(start, stop):
        here = top + row - start
        rows[here] = row
        value = nu[row]
        for q in range(here + 1):
            entry = S[row, rows[q]]
            for r in range(q):
                entry -= L[here, r] * L[q, r]
            if q == here:
                L[here, q] = math.sqrt(max(entry, 1e-300))
            else:
                L[here, q] = entry / L[q, q]
                value -= L[here, q] * y[q]
        y[here] = value / L[here, here]
        distance2 += y[here] * y[here]
        log_det += 2.0 * math.log(L[here, here])
    return distance2, log_det


@kernel
def _price(
    system: System,
    factor: Factor,
    top: int,
    pairs: Pairs,
    group: tuple[int, int],
    used: Mask,
    cost: Array,
) -> int:
    """Write what each pair of a group would add to d^2 + log det S; return how many were looked at."""
    starts, landmarks = pairs
    looked = 0
    for p in range(*group):
        cost[p] = np.inf
        if not used[landmarks[p]]:
            distance2, log_det = _append(system, factor, top, starts[p], starts[p + 1])
            cost[p] = distance2 + log_det
            looked += 1
    return looked


@kernel
def _follow(system: System, factor: Factor, starts: Ints, p: int, i: int, sums: Sums) -> None:
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
    """Return the cheapest pair left in first:last, NONE when all have been tried."""
    best, least = NONE, np.inf
    for p in range(first, last):
        if cost[p] < least:
            best, least = p, cost[p]
    return best


@kernel
def search(
    system: System,
    pairs: Pairs,
    groups: Ints,
    rest: Ints,
    floor: Array,
    limits: Array,
    budget: int,
) -> tuple[Ints, bool]:
    """Return the pair chosen for each of n observations, or NONE, and whether the search was full.

    The most pairs win whose joint d^2 passes the gate; among as many, the least d^2 + log det S.
    A branch is left when it cannot pass the gate even if all the rest match at no distance, and when
    it cannot win even if they do. The cheapest pair given those already chosen goes first, so the
    first descent is the sequential nearest neighbour; every hypothesis on the way is a candidate.

    Parameters
    ----------
    system : S and nu of all pairs
    pairs : (pairs + 1,) first row of each pair, (pairs,) its landmark, numbered from 0
    groups : (n + 1,), first pair of each observation
    rest : (n + 1,), most rows that observations i, i + 1, ... can fill
    floor : (n + 1,), least log det they can add: that of their own R
    limits : (rest[0] + 1,), the gate on d^2 by degrees of freedom
    budget : pairs to look at before the best hypothesis so far is returned
    """
    starts, landmarks = pairs
    n, total = len(groups) - 1, len(limits) - 1
    factor = (np.empty(total, np.int64), np.empty((total, total)), np.empty(total))
    choice, best = np.full(n + 1, _FRESH), np.full(n, NONE)
    used, cost = np.zeros(len(landmarks), np.bool_), np.empty(len(landmarks))
    top, count = np.zeros(n + 1, np.int64), np.zeros(n + 1, np.int64)
    d2, score = np.zeros(n + 1), np.zeros(n + 1)
    sums = top, count, d2, score
    most, least, i = 0, np.inf, 0
    while i >= 0:
        if choice[i] >= 0:
            used[landmarks[choice[i]]] = False
        reach = count[i] + n - i
        beaten = reach < most or (reach == most and score[i] + floor[i] >= least)
        beaten = beaten or d2[i] > limits[top[i] + rest[i]]
        if beaten or choice[i] == NONE or i == n or budget < 0:
            choice[i] = _FRESH
            i -= 1
            continue
        if choice[i] == _FRESH:
            budget -= _price(system, factor, top[i], pairs, (groups[i], groups[i + 1]), used, cost)
        p = choice[i] = _cheapest(cost, groups[i], groups[i + 1])
        _follow(system, factor, starts, p, i, sums)
        i += 1
        if p != NONE:
            cost[p], used[landmarks[p]] = np.inf, True
        better = count[i] > most or (count[i] == most and score[i] < least)
        if better and d2[i] <= limits[top[i]]:
            most, least = count[i], score[i]
            best[:i], best[i:] = choice[:i], NONE
    return best, budget >= 0
