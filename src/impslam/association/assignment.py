"""One-to-one choice among costs, shared by the associations."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from operator import attrgetter

import numpy as np

from impslam.association.base import Assignment, Hypotheses
from impslam.geometry.scipy_extension import load
from impslam.types import Array, Ints, Mask, Match, Observation

linear_sum_assignment = load("scipy.optimize._lsap", "scipy.optimize").linear_sum_assignment
_FORBIDDEN = 1e9


def one_to_one(rows: Ints, columns: Ints, cost: Array) -> list[int]:
    """Return which pairs (row, column) to take: each row and column once, as many as possible.

    Of as many, those of least total cost; pairs that are not listed are not allowed.
    """
    wanted = list(zip(rows.tolist(), columns.tolist(), strict=True))
    a, k = {row for row, _ in wanted}, {column for _, column in wanted}
    if len(a) == len(k) == len(wanted):  # nobody competes
        return list(range(len(wanted)))
    chosen: list[int] = []
    for pairs in _competitions(wanted):
        chosen += pairs if len(pairs) == 1 else _solve([wanted[p] for p in pairs], pairs, cost)
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


def _solve(wanted: list[tuple[int, int]], pairs: list[int], cost: Array) -> list[int]:
    in_a, in_k = (
        {key: i for i, key in enumerate(sorted(keys))}
        for keys in map(set, zip(*wanted, strict=True))
    )
    table = np.full((len(in_a), len(in_k)), _FORBIDDEN)
    place = {(in_a[row], in_k[column]): p for p, (row, column) in zip(pairs, wanted, strict=True)}
    table[tuple(zip(*place, strict=True))] = cost[pairs]
    chosen = zip(*(side.tolist() for side in linear_sum_assignment(table)), strict=True)
    return [place[pair] for pair in chosen if pair in place]


def collect(
    observations: tuple[Observation, ...],
    chosen: Iterable[tuple[Hypotheses, Sequence[int], Mask]],
) -> Assignment:
    """Assemble matches from chosen pairs; `near` (p,) marks pairs too close for the seen to be new."""
    matches: list[Match] = []
    taken: set[int] = set()
    for group, pairs, near in chosen:
        if pairs:
            matches += group.matches(pairs)
        taken.update(group.observations[near].tolist())
    taken.update([match.observation for match in matches])
    new = tuple([i for i in range(len(observations)) if i not in taken])
    matches.sort(key=attrgetter("observation"))
    return Assignment(tuple(matches), new)
