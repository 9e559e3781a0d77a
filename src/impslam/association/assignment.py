"""One-to-one choice from a table of costs, shared by the associations."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from impslam.association.base import Assignment, Hypotheses
from impslam.types import Array, Mask, Match, Observation

_FORBIDDEN = 1e9


def one_to_one(cost: Array, allowed: Mask) -> list[tuple[int, int]]:
    """Return pairs (row, column) of least total cost with as many allowed pairs as possible."""
    a, k = (places.tolist() for places in allowed.nonzero())
    if len(set(a)) == len(set(k)) == len(a):  # nobody competes
        return list(zip(a, k, strict=True))
    from scipy.optimize import linear_sum_assignment  # noqa: PLC0415  0.2 s that few runs need

    rows, columns = np.unique(a), np.unique(k)
    table = np.where(allowed, cost, _FORBIDDEN)[np.ix_(rows, columns)]
    chosen = linear_sum_assignment(table)
    return [
        (int(rows[a]), int(columns[k]))
        for a, k in zip(*chosen, strict=True)
        if table[a, k] < _FORBIDDEN
    ]


def collect(
    observations: tuple[Observation, ...],
    chosen: Iterable[tuple[Hypotheses, list[tuple[int, int]], Mask]],
) -> Assignment:
    """Assemble matches; `near` (a,) marks observations too close to a landmark to be new."""
    matches: list[Match] = []
    taken: set[int] = set()
    for group, pairs, near in chosen:
        matches.extend(group.match(a, k) for a, k in pairs)
        taken.update(int(i) for i in group.observations[near])
    taken.update(match.observation for match in matches)
    new = tuple(i for i in range(len(observations)) if i not in taken)
    return Assignment(tuple(sorted(matches, key=lambda match: match.observation)), new)
