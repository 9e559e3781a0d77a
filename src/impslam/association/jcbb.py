"""Joint Compatibility Branch and Bound (Neira & Tardós 2001, IEEE Trans. Robotics 17(6)).

Pairings that pass their gates one by one can still contradict one another: an error of the pose
moves all innovations of a scan together, as the covariance between them describes. JCBB searches
the largest set of pairings that passes the gate as a whole, over all kinds of landmark at once.

A pair of the set is left out if another set of as many pairs without it is nearly as likely. This does not
apply to pieces of walls; see `unambiguous_pairs`. A pair is also left out if, given the other pairs,
another object is nearly as likely: the joint gate passes a poor pair among several good ones.

Unlike the paper, only complete sets are tested. The paper drops a branch as soon as
its first pairings fail their own gate, which makes the result depend on the order of observations.
"""

from __future__ import annotations

from itertools import pairwise
from typing import ClassVar, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from impslam.association.assignment import (
    DENSITY,
    MIN_ODDS,
    ambiguous,
    cost_of_new,
    make_assignment,
    odds_cost,
    unclaimed_pairs,
)
from impslam.association.base import Assignment, Hypotheses, Joint
from impslam.association.branch_and_bound import NONE, search
from impslam.association.gates import GatedAssociation
from impslam.association.mahalanobis import Mahalanobis
from impslam.component import parameter, register
from impslam.geometry.chi_square import quantiles
from impslam.types import Array, Ints, Mask, Match, Observation

T = TypeVar("T", np.int64, np.float64)


class _Pair(NamedTuple):
    """The p-th pair of a group, its d^2 + log det S, and log det R."""

    group: int
    p: int
    cost: float
    noise: float


def _starts(sizes: Ints) -> Ints:
    """Return the start of each of several consecutive blocks, and the end of the last one."""
    return np.concatenate([[0], np.cumsum(sizes)])


def _rows(starts: Ints, chosen: list[int]) -> Ints:
    """Return the rows of the chosen pairs, in the order of these."""
    return np.array([row for p in chosen for row in range(starts[p], starts[p + 1])], np.int64)


def _remaining(values: npt.NDArray[T]) -> npt.NDArray[T]:
    """Return the sums of the values from each index to the end, followed by 0."""
    return np.append(values, values[:1] * 0)[::-1].cumsum()[::-1]


def _numbered(ids: list[int]) -> Ints:
    """Return the ids renumbered from 0."""
    return np.unique(ids, return_inverse=True)[1]


class _System:
    """The search among the pairs of a scan, or among some of them.

    Attributes
    ----------
    dims : (pairs,), dim_z of each pair
    contested : (pairs,), whether another pair has the same observation or landmark
    """

    def __init__(
        self,
        options: list[list[_Pair]],
        matches: list[Match],
        innovation: Array,
        S: Array,
        gate: float,
        budget: int,
    ) -> None:
        self._S, self._innovation, self._budget = S, innovation, budget
        self.dims = np.array([len(match.innovation) for match in matches])
        self._landmarks = _numbered([match.landmark for match in matches])
        self._observation_of = np.repeat(np.arange(len(options)), [len(some) for some in options])
        self._noise = np.array([some[0].noise for some in options])
        self._limits = quantiles(gate, int(self.dims.sum()))
        conflicts = self._observation_of[:, None] == self._observation_of
        conflicts |= self._landmarks[:, None] == self._landmarks
        self.contested = conflicts.sum(axis=1) > 1

    def search(self, among: Mask) -> tuple[list[int], float]:
        """Return the best set among some pairs (pairs,), and its d^2 + log det S."""
        pairs = np.flatnonzero(among)
        if not len(pairs):
            return [], 0.0
        rows = np.flatnonzero(np.repeat(among, self.dims))
        group_ids, sizes = np.unique(self._observation_of[pairs], return_counts=True)
        groups, dims = _starts(sizes), self.dims[pairs]
        rest = _remaining(dims[groups[:-1]])
        S, nu = self._S[np.ix_(rows, rows)], self._innovation[rows]
        starts = _starts(dims)
        best, _ = search(
            (S, nu),
            (starts, _numbered(self._landmarks[pairs].tolist())),
            groups,
            rest,
            _remaining(self._noise[group_ids]),
            self._limits[: rest[0] + 1],
            self._budget,
        )
        chosen = [p for p in best.tolist() if p != NONE]
        index = _rows(starts, chosen)
        block, residual = S[np.ix_(index, index)], nu[index]
        score = float(residual @ np.linalg.solve(block, residual) + np.linalg.slogdet(block)[1])
        return pairs[chosen].tolist(), score

    def costs_given_others(self, chosen: list[int]) -> Array:
        """Return d^2 + log det S of each of the chosen pairs, given all others.

        With P = S^-1 of the chosen pairs, the innovation of a pair has the conditional covariance
        P_pp^-1 and the conditional mean error P_pp^-1 (P nu)_p.
        """
        rows = _rows(_starts(self.dims), chosen)
        P = np.linalg.inv(self._S[np.ix_(rows, rows)])
        pull, ends = P @ self._innovation[rows], _starts(self.dims[chosen])
        costs = np.empty(len(chosen))
        for k, (first, end) in enumerate(pairwise(ends.tolist())):
            block, part = P[first:end, first:end], pull[first:end]
            costs[k] = part @ np.linalg.solve(block, part) - np.linalg.slogdet(block)[1]
        return costs


@register("jcbb")
class Jcbb(GatedAssociation):
    """The largest set of pairings that is compatible as a whole (Neira & Tardós 2001).

    The gate applies to each pairing alone, and to all of them jointly.
    """

    is_joint: ClassVar[bool] = True

    budget: int = parameter(
        2000,
        "1",
        "maximum number of pairings to try (about 1 us each); then the best set so far is returned, "
        "which is compatible but perhaps not the largest",
        ge=1,
    )
    density: float = parameter(
        DENSITY,
        "1/z",
        "density of other landmarks of the kind in measurement space, as for `mahalanobis`",
        gt=0,
    )
    odds: float = parameter(
        MIN_ODDS,
        "1",
        "a pair is used only if its set is this many times as likely as any other set of the same size, "
        "and as a set in which the observation is a new landmark: a wrong match costs as much as this many "
        "unused observations",
        ge=1,
    )

    def for_known_pose(self) -> Mahalanobis:
        """Return an association with the same gates and odds; see `Association.for_known_pose`."""
        return Mahalanobis(
            gate=self.gate, new_gate=self.new_gate, density=self.density, odds=self.odds
        )

    def assign(
        self, observations: tuple[Observation, ...], hypotheses: list[Hypotheses], joint: Joint
    ) -> Assignment:
        """Match the largest jointly compatible set of pairs; among equals, the likeliest."""
        chosen: list[list[int]] = [[] for _ in hypotheses]
        inside = [self._inside(group) for group in hypotheses]
        options = self._options(observations, hypotheses, inside)
        if options:
            for pair in self._search(observations, hypotheses, options, joint):
                chosen[pair.group].append(pair.p)
        near = [
            unclaimed_pairs(group, self._near(group), pairs)
            for group, pairs in zip(hypotheses, chosen, strict=True)
        ]
        assignment = make_assignment(observations, zip(hypotheses, chosen, near, strict=True))
        return assignment._replace(ambiguous=ambiguous(assignment.matches, hypotheses, inside))

    def _options(
        self,
        observations: tuple[Observation, ...],
        hypotheses: list[Hypotheses],
        inside: list[Mask],
    ) -> list[list[_Pair]]:
        """Return the individually compatible pairs of each observation, the least ambiguous first.

        The order depends only on the scores, not on the order of the observations.
        """
        options: dict[int, list[_Pair]] = {}
        for g, group in enumerate(hypotheses):
            pairs = np.flatnonzero(inside[g])
            if not len(pairs):
                continue
            indices = group.observations[pairs].tolist()
            noise = np.linalg.slogdet(np.array([observations[i].R for i in indices]))[1].tolist()
            costs = (group.distance2 + group.log_det)[pairs].tolist()
            for i, *pair in zip(indices, pairs.tolist(), costs, noise, strict=True):
                options.setdefault(i, []).append(_Pair(g, *pair))
        return sorted(options.values(), key=lambda some: (len(some), min(p.cost for p in some)))

    def _search(
        self,
        observations: tuple[Observation, ...],
        hypotheses: list[Hypotheses],
        options: list[list[_Pair]],
        joint: Joint,
    ) -> list[_Pair]:
        pairs = [pair for some in options for pair in some]
        matches = [hypotheses[pair.group].matches([pair.p])[0] for pair in pairs]
        system = _System(options, matches, *joint(observations, matches), self.gate, self.budget)
        all_pairs = np.ones(len(pairs), np.bool_)
        best, score = system.search(all_pairs)

        def is_ambiguous(p: int) -> bool:
            in_pieces = hypotheses[pairs[p].group].in_pieces  # see `unambiguous_pairs`
            if not system.contested[p] or in_pieces:
                return False
            others, other_score = system.search(np.arange(len(pairs)) != p)
            return len(others) == len(best) and other_score - score < odds_cost(self.odds)

        unambiguous = [p for p in best if not is_ambiguous(p)]
        is_unique = [hypotheses[pair.group].unique for pair in pairs]
        return [pairs[p] for p in self._likely(system, unambiguous, is_unique)]

    def _likely(self, system: _System, chosen: list[int], is_unique: list[bool]) -> list[int]:
        """Leave out pairs whose observation may be another object, one by one, the unlikeliest first."""
        while chosen:
            costs = system.costs_given_others(chosen)
            costs += [cost_of_new(self.density, int(system.dims[p])) for p in chosen]
            costs[[is_unique[p] for p in chosen]] = -np.inf
            worst = int(np.argmax(costs))
            if costs[worst] <= -odds_cost(self.odds):
                break
            chosen = chosen[:worst] + chosen[worst + 1 :]
        return chosen
