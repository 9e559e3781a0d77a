"""Joint Compatibility Branch and Bound (Neira & Tardós 2001, IEEE Trans. Robotics 17(6)).

Pairings that pass their gates one by one can still contradict one another: an error of the pose
moves all innovations of a scan together, and the covariance between them says how. JCBB looks for
the largest set of pairings that passes the gate as a whole, over all kinds of landmark at once.

A pair of the set is left out where the odds are nearly even: where there is another set of as many pairs
without it, nearly as likely. Pieces of walls are not; see `decided`.

One departure from the paper: a set is judged when it is whole. The paper drops a branch as soon as
its first pairings fail their own gate, which makes the answer depend on the order of observations.
"""

from __future__ import annotations

from typing import ClassVar, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from impslam.association.assignment import ODDS, ambiguous, collect, log_odds, unseen
from impslam.association.base import Assignment, Association, Hypotheses, Joint
from impslam.association.branch_and_bound import NONE, search
from impslam.association.mahalanobis import Mahalanobis
from impslam.component import parameter, register
from impslam.geometry.chi_square import quantile, quantiles
from impslam.types import Array, Ints, Mask, Match, Observation

T = TypeVar("T", np.int64, np.float64)


class _Pair(NamedTuple):
    """The p-th pair of a group, its d^2 + log det S, and log det R."""

    group: int
    p: int
    cost: float
    noise: float


def _starts(sizes: Ints) -> Ints:
    """Return where each of some adjoining pieces starts, and where the last one ends."""
    return np.concatenate([[0], np.cumsum(sizes)])


def _remaining(values: npt.NDArray[T]) -> npt.NDArray[T]:
    """Return the sum of the values from each on, and 0 for after the last."""
    return np.append(values, values[:1] * 0)[::-1].cumsum()[::-1]


def _numbered(ids: list[int]) -> Ints:
    """Return the ids' numbers, from 0."""
    return np.unique(ids, return_inverse=True)[1]


class _System:
    """The search among the pairs of a scan, or among some of them.

    Attributes
    ----------
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
        self._dims = np.array([len(match.innovation) for match in matches])
        self._landmarks = _numbered([match.landmark for match in matches])
        self._of = np.repeat(np.arange(len(options)), [len(some) for some in options])
        self._noise = np.array([some[0].noise for some in options])
        self._limits = quantiles(gate, int(self._dims.sum()))
        alike = self._of[:, None] == self._of
        alike |= self._landmarks[:, None] == self._landmarks
        self.contested = alike.sum(axis=1) > 1

    def search(self, among: Mask) -> tuple[list[int], float]:
        """Return the best set among some pairs (pairs,), and its d^2 + log det S."""
        pairs = np.flatnonzero(among)
        if not len(pairs):
            return [], 0.0
        rows = np.flatnonzero(np.repeat(among, self._dims))
        which, sizes = np.unique(self._of[pairs], return_counts=True)
        groups, dims = _starts(sizes), self._dims[pairs]
        rest = _remaining(dims[groups[:-1]])
        S, nu = self._S[np.ix_(rows, rows)], self._innovation[rows]
        starts = _starts(dims)
        best, _ = search(
            (S, nu),
            (starts, _numbered(self._landmarks[pairs].tolist())),
            groups,
            rest,
            _remaining(self._noise[which]),
            self._limits[: rest[0] + 1],
            self._budget,
        )
        chosen = [p for p in best.tolist() if p != NONE]
        taken = [row for p in chosen for row in range(starts[p], starts[p + 1])]
        index = np.array(taken, np.int64)
        block, off = S[np.ix_(index, index)], nu[index]
        score = float(off @ np.linalg.solve(block, off) + np.linalg.slogdet(block)[1])
        return pairs[chosen].tolist(), score


@register("jcbb")
class Jcbb(Association):
    """The largest set of pairings that is compatible as a whole (Neira & Tardós 2001)."""

    judges_jointly: ClassVar[bool] = True

    gate: float = parameter(
        0.999,
        "1",
        "probability that true pairings pass the gate, each alone and all jointly",
        gt=0,
        lt=1,
    )
    new_gate: float = parameter(
        0.999999,
        "1",
        "an observation within this gate of a landmark, yet not matched, is too near to be new",
        gt=0,
        lt=1,
    )
    budget: int = parameter(
        2000,
        "1",
        "pairings that the search looks at (about 1 us each); then the best set so far is taken, "
        "which is compatible but perhaps not the largest",
        ge=1,
    )

    odds: float = parameter(
        ODDS,
        "1",
        "a pair must make its set so many times as likely as another of as many pairs: so many unused "
        "observations are worth a wrong match",
        ge=1,
    )

    def reach(self, dof: int) -> float:
        """Return the wider gate; see `Association.reach`."""
        return quantile(max(self.gate, self.new_gate), dof)

    def given_pose(self) -> Mahalanobis:
        """Return what has the same gates and odds; see `Association.given_pose`."""
        return Mahalanobis(gate=self.gate, new_gate=self.new_gate, odds=self.odds)

    def assign(
        self, observations: tuple[Observation, ...], hypotheses: list[Hypotheses], joint: Joint
    ) -> Assignment:
        """Match the most pairs that are jointly compatible; of as many, the likeliest."""
        chosen: list[list[int]] = [[] for _ in hypotheses]
        inside = [self._inside(group) for group in hypotheses]
        options = self._options(observations, hypotheses, inside)
        if options:
            for pair in self._search(observations, hypotheses, options, joint):
                chosen[pair.group].append(pair.p)
        near = [self._near(*one) for one in zip(hypotheses, chosen, strict=True)]
        made = collect(observations, zip(hypotheses, chosen, near, strict=True))
        return made._replace(ambiguous=ambiguous(made.matches, hypotheses, inside))

    def _inside(self, group: Hypotheses) -> Mask:
        """Tell which pairs pass the gate, each alone."""
        limit = quantile(self.gate, group.innovation.shape[-1])
        return np.asarray((group.distance2 <= limit) & group.possible)

    def _options(
        self,
        observations: tuple[Observation, ...],
        hypotheses: list[Hypotheses],
        inside: list[Mask],
    ) -> list[list[_Pair]]:
        """Return the individually compatible pairs of each observation, the least ambiguous first.

        The order rests on the scores alone, so that the observations' own order does not matter.
        """
        options: dict[int, list[_Pair]] = {}
        for g, group in enumerate(hypotheses):
            pairs = np.flatnonzero(inside[g])
            if not len(pairs):
                continue
            asked = group.observations[pairs].tolist()
            noise = np.linalg.slogdet(np.array([observations[i].R for i in asked]))[1].tolist()
            costs = (group.distance2 + group.log_det)[pairs].tolist()
            for i, *pair in zip(asked, pairs.tolist(), costs, noise, strict=True):
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
        every = np.ones(len(pairs), np.bool_)
        best, score = system.search(every)

        def is_doubtful(p: int) -> bool:
            if not system.contested[p] or hypotheses[pairs[p].group].in_pieces:  # see `decided`
                return False
            others, of_others = system.search(np.arange(len(pairs)) != p)
            return len(others) == len(best) and of_others - score < log_odds(self.odds)

        return [pairs[p] for p in best if not is_doubtful(p)]

    def _near(self, group: Hypotheses, chosen: list[int]) -> list[int]:
        limit = quantile(self.new_gate, group.innovation.shape[-1])
        return unseen(group, (group.distance2 < limit) & group.possible, chosen)
