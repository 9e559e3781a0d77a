"""Joint Compatibility Branch and Bound (Neira & Tardós 2001, IEEE Trans. Robotics 17(6)).

Pairings that pass their gates one by one can still contradict one another: an error of the pose
moves all innovations of a scan together, as the covariance between them describes. JCBB searches
the largest set of pairings that passes the gate as a whole, over all kinds of landmark at once.

A pair of the set is left out if another set of as many pairs without it is nearly as likely. This does not
apply to pieces of walls; see `unambiguous_pairs`. A pair is also left out if, given the other pairs,
another object is nearly as likely: the joint gate passes a poor pair among several good ones.

The search grows exponentially with the number of observations. A scan of many is therefore searched in
parts: first the observations with the fewest conflicts, then others, given the pairs that are chosen,
which leave few candidates. Paz et al. (2008, IEEE Trans. Robotics 24(5)) search a few random observations
jointly and match the others by nearest neighbours; here, each part is searched jointly.

Unlike the paper, only complete sets are tested. The paper drops a branch as soon as
its first pairings fail their own gate, which makes the result depend on the order of observations.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import numpy as np

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
from impslam.association.gates import GatedAssociation
from impslam.association.joint_system import JointSystem, PairColumns
from impslam.association.mahalanobis import Mahalanobis
from impslam.component import parameter, register
from impslam.types import Ints, Mask, Match, Observation

_PART = 16
"""Observations searched together. With three candidates each, 30 % of them spurious, 97 % of the searches
of 16 observations end within the default budget, of 20 only 63 %."""
_NO_PAIRS: Ints = np.empty(0, np.int64)


@register("jcbb")
class Jcbb(GatedAssociation):
    """The largest set of pairings that is compatible as a whole (Neira & Tardós 2001).

    The gate applies to each pairing alone, and to all of them jointly.
    """

    is_joint: ClassVar[bool] = True

    budget: int = parameter(
        2000,
        "1",
        "maximum number of pairings to try in a search (about 1 us each); then the best set so far is "
        "returned, which is compatible but perhaps not the largest",
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
        inside = [self._inside(group) for group in hypotheses]
        chosen = self._search(observations, hypotheses, inside, joint)
        near = [
            unclaimed_pairs(group, self._near(group), pairs)
            for group, pairs in zip(hypotheses, chosen, strict=True)
        ]
        assignment = make_assignment(observations, zip(hypotheses, chosen, near, strict=True))
        return assignment._replace(ambiguous=ambiguous(assignment.matches, hypotheses, inside))

    def _search(
        self,
        observations: tuple[Observation, ...],
        hypotheses: list[Hypotheses],
        inside: list[Mask],
        joint: Joint,
    ) -> list[list[int]]:
        """Return the chosen pairs of each of the hypotheses."""
        chosen: list[list[int]] = [[] for _ in hypotheses]
        place = [(g, p) for g, here in enumerate(inside) for p in here.nonzero()[0].tolist()]
        if not place:
            return chosen
        scored = [
            group.matches(here.nonzero()[0].tolist())
            for group, here in zip(hypotheses, inside, strict=True)
        ]
        matches = [match for some in scored for match in some]
        of_group = [g for g, _ in place]
        in_pieces = np.array([group.in_pieces for group in hypotheses])[of_group]
        unique = np.array([group.unique for group in hypotheses])[of_group]
        system = JointSystem(_columns(observations, scored), *joint(observations, matches))
        for found in self._parts(system, in_pieces, unique):
            for k in found.tolist():
                chosen[place[k][0]].append(place[k][1])
        return chosen

    def _parts(self, system: JointSystem, in_pieces: Mask, unique: Mask) -> Iterator[Ints]:
        """Yield the ids of the pairs chosen in each part of the scan; the masks (pairs,) are by id."""
        rest = system.given(_NO_PAIRS, np.arange(len(system)), self.gate)
        while len(rest):
            here = rest.first(_PART)
            part = rest.take(here)
            ids = part.columns.ids
            found = self._likely(part, self._unambiguous(part, in_pieces[ids]), unique[ids])
            yield ids[found]
            if len(part) == len(rest):
                break
            taken = np.isin(rest.columns.landmarks, rest.columns.landmarks[found])
            taken[here] = True
            rest = rest.given(found, np.flatnonzero(~taken), max(self.gate, self.new_gate))

    def _unambiguous(self, system: JointSystem, in_pieces: Mask) -> Ints:
        """Return the best pairs without which no other set of as many is nearly as likely."""
        best = system.search(self.gate, self.budget)
        rival = len(best.pairs), best.score + odds_cost(self.odds)
        alone = (system.columns.conflicts == 0) | in_pieces  # see `unambiguous_pairs`

        def is_ambiguous(p: int) -> bool:
            others = system.take(np.delete(np.arange(len(system)), p))
            return len(others.search(self.gate, self.budget, rival).pairs) > 0

        return best.pairs[[bool(alone[p]) or not is_ambiguous(p) for p in best.pairs.tolist()]]

    def _likely(self, system: JointSystem, chosen: Ints, is_unique: Mask) -> Ints:
        """Leave out pairs whose observation may be another object, one by one, the unlikeliest first."""
        new = np.array([cost_of_new(self.density, dim) for dim in system.columns.dims.tolist()])
        new[is_unique] = -np.inf
        while len(chosen):
            costs = system.costs_given_others(chosen) + new[chosen]
            worst = int(np.argmax(costs))
            if costs[worst] <= -odds_cost(self.odds):
                break
            chosen = np.delete(chosen, worst)
        return chosen


def _columns(observations: tuple[Observation, ...], scored: list[list[Match]]) -> PairColumns:
    """Return the columns of the pairs of each kind of landmark."""
    matches = [match for some in scored for match in some]
    noise = [
        np.linalg.slogdet(np.array([observations[match.observation].R for match in some]))[1]
        for some in scored
        if some
    ]
    return PairColumns(
        np.arange(len(matches)),
        np.array([len(match.innovation) for match in matches]),
        np.array([match.observation for match in matches]),
        np.array([match.landmark for match in matches]),
        np.concatenate(noise),
    )
