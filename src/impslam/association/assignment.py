"""One-to-one choice among costs, shared by the associations, and the odds of what is chosen.

Costs are -2 log of odds, as squared Mahalanobis distances are. Which of two landmarks was seen is a
decision under uncertainty: where the next best choice is nearly as likely, a wrong match costs more than
an observation less, and it is best not to decide (Chow 1970, IEEE Trans. Information Theory 16(1)).
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
ODDS = 10.0
"""A wrong match costs as much as so many observations that are not used."""


def log_odds(odds: float) -> float:
    """Return what odds are worth as a cost."""
    return 2.0 * math.log(odds)


def decided(
    rows: Ints, columns: Ints, cost: Array, least: float, in_pieces: bool = False
) -> list[int]:
    """Return which pairs (row, column) to take: those of the least total cost that are beyond doubt.

    Each row and column is taken once at most; pairs that are not listed are not allowed. Costs are against
    that of leaving a row alone. A pair is beyond doubt if the least total cost without it is greater by
    `least`. With `in_pieces` several rows may show one column: that another row does is no alternative. Of
    two columns the cheaper one is taken then: walls lie side by side wherever a door is set back, and a
    corridor in which neither is used tells nothing.
    """
    a, k = rows.tolist(), columns.tolist()
    if len(set(a)) == len(set(k)) == len(a):  # nobody competes
        return (cost <= -least).nonzero()[0].tolist()
    every = list(zip(a, k, strict=True))
    chosen: list[int] = []
    margin = 0.0 if in_pieces else least
    for pairs in _competitions(every):
        if len(pairs) == 1:
            chosen += pairs if cost[pairs[0]] <= -least else []
            continue
        wanted = {p: (int(rows[p]), int(columns[p])) for p in pairs}
        best = _solve(wanted, cost)
        total = sum(cost[p] for p in best)
        for p in best:
            column = wanted[p][1]
            rivals = [q for q in pairs if q != p and not (in_pieces and wanted[q][1] == column)]
            others = _solve({q: wanted[q] for q in rivals}, cost)
            if sum(cost[q] for q in others) - total >= margin:
                chosen.append(p)
    return sorted(chosen)


def _competitions(wanted: Sequence[tuple[int, int]]) -> Iterable[list[int]]:
    """Return the pairs by who competes with whom, be it through others: each solved by itself."""
    leader, first = list(range(len(wanted))), dict[tuple[int, int], int]()
    for p, (row, column) in enumerate(wanted):
        for key in ((0, row), (1, column)):
            one, other = _leader(leader, first.setdefault(key, p)), _leader(leader, p)
            leader[max(one, other)] = min(one, other)
    groups: dict[int, list[int]] = {}
    for p in range(len(wanted)):
        groups.setdefault(_leader(leader, p), []).append(p)
    return groups.values()


def _leader(leader: list[int], p: int) -> int:
    while leader[p] != p:
        leader[p] = p = leader[leader[p]]
    return p


def _solve(wanted: Mapping[int, tuple[int, int]], cost: Array) -> list[int]:
    """Return the pairs, numbered as their costs, of the least total cost; a row may be left alone."""
    if len(wanted) < 2:
        return [p for p in wanted if cost[p] < 0.0]
    in_a, in_k = (
        {key: i for i, key in enumerate(sorted(keys))}
        for keys in map(set, zip(*wanted.values(), strict=True))
    )
    table = np.full((len(in_a), len(in_k) + len(in_a)), _FORBIDDEN)
    table[:, len(in_k) :] = 0.0
    place = {(in_a[row], in_k[column]): p for p, (row, column) in wanted.items()}
    table[tuple(zip(*place, strict=True))] = cost[list(place.values())]
    chosen = zip(*(side.tolist() for side in linear_sum_assignment(table)), strict=True)
    return [place[pair] for pair in chosen if pair in place]


def rivals(group: Hypotheses, inside: Mask) -> list[Rivals]:
    """Return the landmarks that one observation could be either of; `inside` (p,) are pairs in the gate.

    None of kinds that are seen in pieces: no scan can show that two of them are not one.
    """
    seen, known = group.observations[inside].tolist(), group.landmarks[inside].tolist()
    if group.in_pieces or len(set(seen)) == len(seen):
        return []
    options: dict[int, list[int]] = {}
    for i, landmark in zip(seen, known, strict=True):
        options.setdefault(i, []).append(landmark)
    times = Counter(pair for some in options.values() for pair in combinations(sorted(some), 2))
    return [Rivals(pair, count > 1) for pair, count in times.items()]


def unseen(group: Hypotheses, near: Mask, chosen: Sequence[int]) -> list[int]:
    """Return the pairs, of those near enough (p,), whose landmark can still be what is seen.

    It can unless it is in one of those chosen; of kinds that are seen in pieces always.
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
    """Return the observations that are not matched but have a pair inside the gate, `inside` (p,)."""
    matched = {match.observation for match in matches}
    compatible = (
        i for g, here in zip(hypotheses, inside, strict=True) for i in g.observations[here].tolist()
    )
    return tuple(sorted(set(compatible) - matched))


def collect(
    observations: tuple[Observation, ...],
    chosen: Iterable[tuple[Hypotheses, Sequence[int], Sequence[int]]],
) -> Assignment:
    """Assemble matches from chosen pairs; others are `near`, so that the seen is not new."""
    matches: list[Match] = []
    taken: set[int] = set()
    for group, pairs, near in chosen:
        matches += group.matches(pairs)
        asked = group.observations.tolist()
        taken.update([asked[p] for p in near])
    taken.update([match.observation for match in matches])
    new = tuple([i for i in range(len(observations)) if i not in taken])
    matches.sort(key=attrgetter("observation"))
    return Assignment(tuple(matches), new)
