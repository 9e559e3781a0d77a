"""One-to-one choice among costs, shared by the associations."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from operator import attrgetter

import numpy as np

from impslam.association.base import Assignment, Hypotheses
from impslam.types import Array, Ints, Mask, Match, Observation

_FORBIDDEN = 1e9


def one_to_one(rows: Ints, columns: Ints, cost: Array) -> list[int]:
    """Return which pairs (row, column) to take: each row and column once, as many as possible.

    Of as many, those of least total cost; pairs that are not listed are not allowed.
    """
    if len(set(rows.tolist())) == len(set(columns.tolist())) == len(rows):  # nobody competes
        return list(range(len(rows)))
    from scipy.optimize import linear_sum_assignment  # noqa: PLC0415  0.2 s that few runs need

    _, a = np.unique(rows, return_inverse=True)
    _, k = np.unique(columns, return_inverse=True)
    table = np.full((a.max() + 1, k.max() + 1), _FORBIDDEN)
    place = np.zeros(table.shape, np.int64)
    table[a, k], place[a, k] = cost, np.arange(len(rows))
    chosen = linear_sum_assignment(table)
    return [int(p) for p in place[chosen][table[chosen] < _FORBIDDEN]]


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
    taken.update(match.observation for match in matches)
    new = tuple(i for i in range(len(observations)) if i not in taken)
    return Assignment(tuple(sorted(matches, key=attrgetter("observation"))), new)
