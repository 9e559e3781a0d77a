"""One-to-one assignment by costs, with a reject option; shared by the associations.

Costs are -2 log of odds, like squared Mahalanobis distances. Which of two landmarks was observed is a
decision under uncertainty: if the next best choice is nearly as likely, a wrong match costs more than
an unused observation, and it is best not to decide (Chow 1970, IEEE Trans. Information Theory 16(1)).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations
from operator import attrgetter

import numpy as np

from impslam.association.base import Assignment, Hypotheses, Rivals
from impslam.geometry.scipy_extension import load
from impslam.types import Array, Ints, Mask, Match, Observation

linear_sum_assignment = load("scipy.optimize._lsap", "scipy.optimize").linear_sum_assignment
_FORBIDDEN = 1e9
MIN_ODDS = 10.0
"""A wrong match costs as much as this many unused observations."""
DENSITY = 0.3
"""Objects of a kind in a unit of measurement space: of walls in 1 m and 1 rad in maps of offices."""
_UNMAPPED_SHARE = 0.1
"""Share of observed objects that are not in the map yet."""


def odds_cost(odds: float) -> float:
    """Return odds as a cost."""
    return 2.0 * math.log(odds)


def cost_of_new(density: float, dim: int) -> float:
    """Return what to add to d^2 + log det S of a pair: the cost of it against an object not in the map."""
    return dim * math.log(2.0 * math.pi) + 2.0 * math.log(_UNMAPPED_SHARE * density)


def unambiguous_pairs(
    rows: Ints, columns: Ints, cost: Array, least: float, in_pieces: bool = False
) -> list[int]:
    """Return the pairs (row, column) of the assignment with the least total cost that are unambiguous.

    Each row and column is used at most once; pairs that are not listed are not allowed. Costs are relative
    to leaving a row unassigned. A pair is unambiguous if the least total cost without it is greater by
    `least`. With `in_pieces`, several rows may be observations of one column, so another row is no
    alternative; of two columns the cheaper one is chosen if it costs at most -`least`: walls are side by
    side wherever a door is set back, and using neither would leave a corridor without information.
    """
    a, k = rows.tolist(), columns.tolist()
    if len(set(a)) == len(set(k)) == len(a):  # no conflicts
        return (cost <= -least).nonzero()[0].tolist()
    all_pairs = list(zip(a, k, strict=True))
    chosen: list[int] = []
    margin = 0.0 if in_pieces else least
    for pairs in _conflict_groups(all_pairs):
        if len(pairs) == 1:
            chosen += pairs if cost[pairs[0]] <= -least else []
            continue
        candidates = {p: (int(rows[p]), int(columns[p])) for p in pairs}
        best = _solve(candidates, cost)
        total = sum(cost[p] for p in best)
        for p in best:
            column = candidates[p][1]
            rivals = [q for q in pairs if q != p and not (in_pieces and candidates[q][1] == column)]
            others = _solve({q: candidates[q] for q in rivals}, cost)
            if cost[p] <= -least and sum(cost[q] for q in others) - total >= margin:
                chosen.append(p)
    return sorted(chosen)


def _conflict_groups(candidates: Sequence[tuple[int, int]]) -> Iterable[list[int]]:
    """Return groups of pairs that conflict, directly or through others; each is solved separately."""
    parent, first = list(range(len(candidates))), dict[tuple[int, int], int]()
    for p, (row, column) in enumerate(candidates):
        for key in ((0, row), (1, column)):
            one, other = _find_root(parent, first.setdefault(key, p)), _find_root(parent, p)
            parent[max(one, other)] = min(one, other)
    groups: dict[int, list[int]] = {}
    for p in range(len(candidates)):
        groups.setdefault(_find_root(parent, p), []).append(p)
    return groups.values()


def _find_root(parent: list[int], p: int) -> int:
    while parent[p] != p:
        parent[p] = p = parent[parent[p]]
    return p


def _solve(candidates: Mapping[int, tuple[int, int]], cost: Array) -> list[int]:
    """Return the pairs, as indices of costs, of the least total cost; rows may stay unassigned."""
    if len(candidates) < 2:
        return [p for p in candidates if cost[p] < 0.0]
    in_a, in_k = (
        {key: i for i, key in enumerate(sorted(keys))}
        for keys in map(set, zip(*candidates.values(), strict=True))
    )
    table = np.full((len(in_a), len(in_k) + len(in_a)), _FORBIDDEN)
    table[:, len(in_k) :] = 0.0
    pair_of_cell = {(in_a[row], in_k[column]): p for p, (row, column) in candidates.items()}
    table[tuple(zip(*pair_of_cell, strict=True))] = cost[list(pair_of_cell.values())]
    chosen = zip(*(side.tolist() for side in linear_sum_assignment(table)), strict=True)
    return [pair_of_cell[pair] for pair in chosen if pair in pair_of_cell]


def rivals(group: Hypotheses, inside: Mask) -> list[Rivals]:
    """Return pairs of landmarks that one observation could match; `inside` (p,) are pairs in the gate.

    Kinds observed in pieces have none: no scan can show that two of them are not one.
    """
    observed, known = group.observations[inside].tolist(), group.landmarks[inside].tolist()
    if group.in_pieces or len(set(observed)) == len(observed):
        return []
    options: dict[int, list[int]] = {}
    for i, landmark in zip(observed, known, strict=True):
        options.setdefault(i, []).append(landmark)
    times = Counter(pair for some in options.values() for pair in combinations(sorted(some), 2))
    return [Rivals(pair, count > 1) for pair, count in times.items()]


def unclaimed_pairs(group: Hypotheses, near: Mask, chosen: Sequence[int]) -> list[int]:
    """Return the near pairs (p,) whose landmark is not in a chosen pair.

    For kinds observed in pieces, and if none is chosen, return all near pairs.
    """
    pairs: list[int] = near.nonzero()[0].tolist()
    if group.in_pieces or not chosen:
        return pairs
    known = group.landmarks.tolist()
    taken = {known[p] for p in chosen}
    return [p for p in pairs if known[p] not in taken]


def ambiguous(
    matches: Iterable[Match], hypotheses: Iterable[Hypotheses], inside: Iterable[Mask]
) -> tuple[int, ...]:
    """Return the unmatched observations with a pair inside the gate, `inside` (p,)."""
    matched = {match.observation for match in matches}
    compatible = (
        i for g, here in zip(hypotheses, inside, strict=True) for i in g.observations[here].tolist()
    )
    return tuple(sorted(set(compatible) - matched))


def make_assignment(
    observations: tuple[Observation, ...],
    chosen: Iterable[tuple[Hypotheses, Sequence[int], Sequence[int]]],
) -> Assignment:
    """Make an assignment of the chosen pairs; observations of `near` pairs are not new."""
    matches: list[Match] = []
    taken: set[int] = set()
    for group, pairs, near in chosen:
        matches += group.matches(pairs)
        indices = group.observations.tolist()
        taken.update([indices[p] for p in near])
    taken.update([match.observation for match in matches])
    new = tuple([i for i in range(len(observations)) if i not in taken])
    matches.sort(key=attrgetter("observation"))
    return Assignment(tuple(matches), new)
