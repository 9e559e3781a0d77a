"""The search of JCBB: branch and bound over the observations of a scan (Neira & Tardós 2001, Fig. 4).

Pairs are grouped by observation; pair p occupies rows `starts[p]:starts[p + 1]` of the innovation
and of its covariance S. A hypothesis assigns one pair or none to each observation. Its joint
distance is updated pair by pair with the Cholesky factor of its block of S: no matrix is inverted, and
backtracking is free. The rows of the factor are kept for each pair, not for each place in the hypothesis:
after a change of the last pairs, all others are only solved against these, in O(n) for n rows.
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
"""First row of each pair and the end of the last (pairs + 1,), and the id of its landmark (pairs,)."""
Sums: TypeAlias = tuple[Ints, Ints, Array, Array]
"""Number of rows and pairs, d^2, and d^2 + log det S of the observations before i, each (n + 1,)."""
Factor: TypeAlias = tuple[Ints, Ints, Array, Array]
"""Rows of S in the hypothesis (total,), the number of these that the factor's rows of each pair are solved
for (pairs,), the factor L (rows, total), and y (rows,) with L y = nu."""
Growth: TypeAlias = tuple[Array, Array]
"""Increase of d^2, and of d^2 + log det S, by each pair given the hypothesis before it (pairs,)."""


@kernel
def _dot(a: Array, b: Array, n: int) -> float:
    """Return the sum of n products: four sums, as additions that wait for one another take four cycles."""
    s0, s1, s2, s3, whole = 0.0, 0.0, 0.0, 0.0, n - n % 4
    for k in range(0, whole, 4):
        s0 += a[k] * b[k]
        s1 += a[k + 1] * b[k + 1]
        s2 += a[k + 2] * b[k + 2]
        s3 += a[k + 3] * b[k + 3]
    for k in range(whole, n):
        s0 += a[k] * b[k]
    return (s0 + s1) + (s2 + s3)


@kernel
def _append(
    system: System, factor: Factor, top: int, p: int, start: int, stop: int
) -> tuple[float, float]:
    """Extend the factor of `rows[:top]` by a pair, rows start:stop; return the growth of d^2, log det."""
    S, nu = system
    rows, solved, L, y = factor
    distance2, log_det = 0.0, 0.0
    for row in range(start, stop):
        for q in range(min(solved[p], top), top + row - start):
            other = rows[q] if q < top else start + q - top
            L[row, q] = (S[row, other] - _dot(L[row], L[other], q)) / L[other, q]
        end = top + row - start
        L[row, end] = math.sqrt(max(S[row, row] - _dot(L[row], L[row], end), 1e-300))
        value = nu[row]
        for q in range(end):
            value -= L[row, q] * y[rows[q] if q < top else start + q - top]
        y[row] = value / L[row, end]
        distance2 += y[row] * y[row]
        log_det += 2.0 * math.log(L[row, end])
    solved[p] = top
    return distance2, log_det


@kernel
def _score_pairs(
    system: System,
    factor: Factor,
    top: int,
    pairs: Pairs,
    group: tuple[int, int],
    used: Mask,
    growth: Growth,
) -> int:
    """Write the growth of d^2 and d^2 + log det S by each pair of a group; return the number tried."""
    starts, landmarks = pairs
    tried = 0
    for p in range(*group):
        growth[1][p] = np.inf
        if not used[landmarks[p]]:
            distance2, log_det = _append(system, factor, top, p, starts[p], starts[p + 1])
            growth[0][p], growth[1][p] = distance2, distance2 + log_det
            tried += 1
    return tried


@kernel
def _take(
    sums: Sums, factor: Factor, starts: Ints, growth: Growth, p: int, i: int, later: int
) -> None:
    """Write the sums after observation i takes pair p, or NONE, and add the pair's rows to the hypothesis.

    Pairs from `later` on, those of the observations after i, will have to be solved for these rows.
    """
    top, count, d2, score = sums
    top[i + 1], count[i + 1], d2[i + 1], score[i + 1] = top[i], count[i], d2[i], score[i]
    if p == NONE:
        return
    rows, solved, _, _ = factor
    for row in range(starts[p], starts[p + 1]):
        rows[top[i + 1]] = row
        top[i + 1] += 1
    count[i + 1] += 1
    d2[i + 1] += growth[0][p]
    score[i + 1] += growth[1][p]
    for q in range(later, len(solved)):
        solved[q] = min(solved[q], top[i])


@kernel
def _start(starts: Ints, n: int, total: int) -> tuple[Factor, Growth, Sums]:
    """Return the hypothesis without pairs of n observations; it can hold `total` rows."""
    pairs, rows = len(starts) - 1, starts[-1]
    factor = (
        np.empty(total, np.int64),
        np.zeros(pairs, np.int64),
        np.empty((rows, total)),
        np.empty(rows),
    )
    counts, values = np.zeros((2, n + 1), np.int64), np.zeros((2, n + 1))
    growth = np.empty(pairs), np.empty(pairs)
    return factor, growth, (counts[0], counts[1], values[0], values[1])


@kernel
def _cheapest(score: Array, first: int, last: int) -> int:
    """Return the pair of the least score left in first:last, or NONE if all have been tried."""
    best, best_score = NONE, np.inf
    for p in range(first, last):
        if score[p] < best_score:
            best, best_score = p, score[p]
    return best


@kernel
def search(
    system: System,
    pairs: Pairs,
    groups: Ints,
    bounds: tuple[Ints, Array],
    limits: Array,
    budget: int,
    beat: tuple[int, float],
) -> tuple[Ints, float, bool]:
    """Return the pair of each of n observations, or NONE, their score, and whether the search was complete.

    The largest number of pairs whose joint d^2 passes the gate wins; then the least score, which is
    d^2 + log det S. A branch is pruned if it cannot pass the gate, or cannot win, even if all remaining
    observations match at distance 0. The cheapest pair given those already chosen is tried first, and
    no pair before one that is beyond its own gate: the first descent, which no budget cuts short, is the
    sequential nearest neighbour. Every hypothesis on the path is a candidate.

    Parameters
    ----------
    system : S and nu of all pairs
    pairs : (pairs + 1,) first row of each pair, (pairs,) the id of its landmark
    groups : (n + 1,), first pair of each observation
    bounds : (n + 1,) maximum number of rows of observations i, i + 1, ...; (n + 1,) minimum log det that
        they add: that of their own R
    limits : (rows + 1,), the gate on d^2 by degrees of freedom
    budget : pairs to try before the best hypothesis so far is returned
    beat : number of pairs and score; a hypothesis has to be better, or none is returned
    """
    (starts, landmarks), (rest, floor), n = pairs, bounds, len(groups) - 1
    factor, growth, sums = _start(starts, n, len(limits) - 1)
    top, count, d2, score = sums
    choice, best = np.full(n + 1, _UNVISITED), np.full(n, NONE)
    used, omitted = np.zeros(landmarks.max() + 1, np.bool_), np.zeros(n, np.bool_)
    (best_count, best_score), i, descended = beat, 0, False
    while i >= 0:
        if choice[i] >= 0:
            used[landmarks[choice[i]]] = False
        most = count[i] + n - i
        ended = most < best_count or (most == best_count and score[i] + floor[i] >= best_score)
        ended = ended or i == n or d2[i] > limits[top[i] + rest[i]] or (budget < 0 and descended)
        if not ended and choice[i] == _UNVISITED:
            group, omitted[i] = (groups[i], groups[i + 1]), False
            budget -= _score_pairs(system, factor, top[i], pairs, group, used, growth)
        p = NONE if ended else _cheapest(growth[1], groups[i], groups[i + 1])
        if ended or (p == NONE and omitted[i]):
            choice[i], descended = _UNVISITED, True
            i -= 1
            continue
        if p == NONE or (not omitted[i] and growth[0][p] > limits[starts[p + 1] - starts[p]]):
            p, omitted[i] = NONE, True
        _take(sums, factor, starts, growth, p, i, groups[i + 1])
        choice[i], i = p, i + 1
        if p != NONE:
            growth[1][p], used[landmarks[p]] = np.inf, True
        better = count[i] > best_count or (count[i] == best_count and score[i] < best_score)
        if better and d2[i] <= limits[top[i]]:
            best_count, best_score = count[i], score[i]
            best[:i], best[i:] = choice[:i], NONE
    return best, best_score, budget >= 0
