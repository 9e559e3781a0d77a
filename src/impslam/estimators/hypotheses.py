"""Multiple-hypothesis SLAM: what one scan cannot tell, later ones do (Reid 1979, IEEE TAC 24(6)).

A hypothesis says of every observation so far which landmark it shows or that it began one, and keeps
a filter of its own. Each observation branches each hypothesis: it may be any landmark in the gate, at the
density of its innovation N(nu; 0, S), or one that is not in the map yet, at the density of such
landmarks. A landmark is seen once in a scan at most. The likeliest hypotheses are kept; those whose
beliefs have become the same are one, with the sum of their weights, so that ambiguities that no
longer matter use none of the limited number.

The pose is that of the likeliest hypothesis; when another one becomes it, the keyframes on which they
differ are revised. A covariance is that of the mixture: it includes the uncertainty of the association.

A match is told if hypotheses of nearly all weight agree on it, before any become one: beliefs become the
same, too, where it makes no difference which landmark was seen. A scan is judged by its own noise there:
errors that repeat (`repeats` of the filter) weaken corrections and weights, not what one scan can tell.

Landmarks are numbered by the observation that began them, so that hypotheses can be compared.

Nothing says that a landmark should have been seen: of two at one place, one may never be seen again. So a
landmark that was begun twice can stay, and hypotheses that differ in that alone weigh about the same.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, NamedTuple

import numpy as np
from pydantic import PrivateAttr

from impslam.component import parameter, register
from impslam.errors import NumericalError
from impslam.estimators.base import START_SIGMA, Estimator, check_keyframe, is_known
from impslam.estimators.blur import blurred
from impslam.estimators.sampling import normalised
from impslam.filters.base import Filter
from impslam.geometry.angles import wrap
from impslam.geometry.chi_square import quantile
from impslam.landmarks.base import LandmarkModel
from impslam.map import Keyframe, Map, Revision
from impslam.types import Array, Increment, Landmark, Match, Observation


@dataclass(frozen=True, slots=True, eq=False)
class Past:
    """The newest pose of a hypothesis, its covariance, and those before; hypotheses share them."""

    keyframe: int
    pose: Array
    covariance: Array
    before: Past | None


@dataclass(slots=True, eq=False)
class Hypothesis:
    """One assignment of all observations so far to landmarks.

    Attributes
    ----------
    filter : the belief, given these assignments
    log_weight : log of its probability, up to a constant that all share
    names : ids of landmarks by those that the filter gave them
    shown : of the newest scan's observations so far, the landmarks (ids) they are
    matches : those of them that were known before
    sharper : how much log_weight grows where the newest scan counts with its own noise
    """

    filter: Filter
    log_weight: float = 0.0
    names: dict[int, int] = field(default_factory=dict)
    past: Past | None = None
    shown: list[int] = field(default_factory=list)
    matches: dict[int, Match] = field(default_factory=dict)
    sharper: float = 0.0

    def copy(self) -> Hypothesis:
        """Return one that goes on by itself."""
        names, shown, matches = dict(self.names), list(self.shown), dict(self.matches)
        belief = self.filter.copied()
        return replace(self, filter=belief, names=names, shown=shown, matches=matches)


class Branch(NamedTuple):
    """How a hypothesis may go on: log weight, and the match; None: the observation is new.

    `sharper` is how much the log weight grows where the observation counts with its own noise.
    """

    log_weight: float
    of: Hypothesis
    match: Match | None = None
    sharper: float = 0.0


@register("hypotheses")
class MultipleHypotheses(Estimator):
    """Several hypotheses of what was seen, each a filter of its own (Reid 1979)."""

    parts: ClassVar[tuple[str, ...]] = ("filter",)
    tells_landmarks: ClassVar[bool] = False

    most: int = parameter(20, "1", "hypotheses that are kept", ge=1)
    gate: float = parameter(
        0.9999, "1", "probability that a true pairing passes the chi-square gate", gt=0, lt=1
    )
    density: float = parameter(
        0.03,
        "1/z",
        "landmarks that are not in the map yet in a unit of measurement space (points: 1 m^2): a "
        "tenth of the 0.3 that offices have in all, for most that are seen have been seen before",
        gt=0,
    )
    odds: float = parameter(
        1e-5, "1", "a hypothesis so much less likely than the best is dropped", gt=0, lt=1
    )
    same: float = parameter(
        0.2,
        "sigma",
        "beliefs that differ by less in all means are one; together they are 1 % wider at most",
        ge=0,
    )
    agreement: float = parameter(
        0.99, "1", "a match is told when hypotheses of so much weight agree", gt=0.5, le=1
    )
    _models: Mapping[str, LandmarkModel] = PrivateAttr()
    _hypotheses: list[Hypothesis] = PrivateAttr()
    _told: dict[int, Past] = PrivateAttr(default_factory=dict)
    _observations: int = PrivateAttr(default=0)
    _sure: tuple[Match, ...] = PrivateAttr(default=())

    def start(
        self,
        pose: Array,
        known: Map | None = None,
        frozen: bool = False,
        hint: Array | None = None,
        **parts: Any,
    ) -> None:
        """Begin at a pose (3,) with an empty map; see `Estimator.start`."""
        self._refuse(known)
        self._models = parts["models"]
        parts["filter"].start(pose, START_SIGMA**2 * np.eye(3), self._models)
        self._hypotheses = [Hypothesis(parts["filter"])]
        self._told, self._observations = {}, 0

    def add(self, keyframe: Keyframe) -> Revision:
        """Take in a keyframe; see `Estimator.add`."""
        seen, why = tuple[Observation, ...](), ""
        try:
            check_keyframe(keyframe)
            _check_noise(keyframe.observations)
            seen = blurred(keyframe.observations, keyframe.motion, self._models)
        except NumericalError as error:
            why = f"the scan at {keyframe.stamp:.3f} s is not used for the map: {error}"
        if is_known(keyframe.motion):
            self._move(keyframe.motion)
        try:
            self._see(seen, keyframe.stamp)
        except NumericalError as error:
            why = f"the scan at {keyframe.stamp:.3f} s is not used to its end for the map: {error}"
        return self._revision(keyframe, why)

    def _move(self, motion: Increment) -> None:
        for hypothesis in self._hypotheses:
            hypothesis.filter.predict(motion)
            hypothesis.shown, hypothesis.matches, hypothesis.sharper = [], {}, 0.0

    def _see(self, observations: tuple[Observation, ...], stamp: float) -> None:
        for observation in observations:
            branches = [b for h in self._hypotheses for b in self._branches(h, observation)]
            branches.sort(key=lambda branch: -branch.log_weight)
            least = branches[0].log_weight + math.log(self.odds)
            kept = [b for b in branches[: self.most] if b.log_weight >= least]
            self._hypotheses = [
                self._grown(branch, own, observation, stamp)
                for branch, own in zip(kept, _owned(kept), strict=True)
            ]
            self._observations += 1
        self._sure = self._agreed()
        self._merge()

    def _branches(self, of: Hypothesis, observation: Observation) -> Iterator[Branch]:
        """Yield what an observation may be in a hypothesis, the sensor's noise as a correction takes it."""
        seen, matches = (observation,), list[Match]()
        for group in of.filter.hypothesise(seen, lambda dof: quantile(self.gate, dof)):
            pairs = np.flatnonzero(group.possible).tolist()
            matches += [m for m in group.matches(pairs) if of.names[m.landmark] not in of.shown]
        yield Branch(of.log_weight + math.log(self.density), of)
        if matches:
            densities = of.filter.log_densities(seen, matches)
            alone = of.filter.log_densities(seen, matches, alone=True) - densities
            for match, density, sharper in zip(matches, densities, alone, strict=True):
                yield Branch(of.log_weight + float(density), of, match, float(sharper))

    def _grown(
        self, branch: Branch, own: Hypothesis, observation: Observation, stamp: float
    ) -> Hypothesis:
        """Take an observation into a hypothesis that is the branch's alone."""
        own.log_weight, own.sharper = branch.log_weight, own.sharper + branch.sharper
        if branch.match is None:
            (number,) = own.filter.extend((observation,), stamp)
            own.names[number] = self._observations
        else:
            number = branch.match.landmark
            own.filter.correct((observation,), (branch.match,))
            own.filter.note((observation,), (branch.match,), stamp)
            own.matches[len(own.shown)] = branch.match
        own.shown.append(own.names[number])
        return own

    def _merge(self) -> None:
        """Make hypotheses whose beliefs are the same one; the likelier one's assignments are kept."""
        kept: list[Hypothesis] = []
        for hypothesis in sorted(self._hypotheses, key=lambda h: -h.log_weight):
            for other in kept:
                if other.filter.resembles(hypothesis.filter, self.same):
                    both = np.logaddexp(other.log_weight, hypothesis.log_weight)
                    other.log_weight = float(both)
                    break
            else:
                kept.append(hypothesis)
        best = max(h.log_weight for h in kept)
        for hypothesis in kept:
            hypothesis.log_weight -= best
        self._hypotheses = sorted(kept, key=lambda h: -h.log_weight)

    def _weights(self) -> Array:
        return normalised(np.array([h.log_weight for h in self._hypotheses]))

    def _revision(self, keyframe: Keyframe, refused: str) -> Revision:
        """Return the keyframes on which the likeliest hypothesis differs from what was told."""
        for h in self._hypotheses:
            h.past = Past(keyframe.id, h.filter.pose, h.filter.covariance, h.past)
        changed, past = list[Past](), self._hypotheses[0].past
        while past is not None and self._told.get(past.keyframe) is not past:
            self._told[past.keyframe] = past
            changed.append(past)
            past = past.before
        covariances = np.array([p.covariance for p in changed])
        covariances[0] = self._spread()
        return Revision(
            np.array([p.keyframe for p in changed]),
            np.array([p.pose for p in changed]),
            covariances,
            matches=() if refused else self._sure,
            refused=refused,
        )

    def _spread(self) -> Array:
        """Return the pose's covariance (3, 3) about the likeliest hypothesis, over all of them."""
        pose, total = self._hypotheses[0].filter.pose, np.zeros((3, 3))
        for weight, h in zip(self._weights(), self._hypotheses, strict=True):
            off = h.filter.pose - pose
            off[2] = wrap(float(off[2]))
            total += weight * (h.filter.covariance + np.outer(off, off))
        return total

    def _agreed(self) -> tuple[Match, ...]:
        """Return the newest scan's matches on which hypotheses of nearly all weight agree."""
        weights = normalised(np.array([h.log_weight + h.sharper for h in self._hypotheses]))
        likeliest, agreed = self._hypotheses[int(weights.argmax())], []
        for i, match in likeliest.matches.items():
            name = likeliest.names[match.landmark]
            share = weights @ [h.shown[i] == name for h in self._hypotheses]
            if share >= self.agreement:
                agreed.append(match._replace(observation=i, landmark=name))
        return tuple(agreed)

    def landmarks(self) -> tuple[Landmark, ...]:
        """Return the landmarks of the likeliest hypothesis in the form users read."""
        best = self._hypotheses[0]
        found = [replace(m, id=best.names[m.id]) for m in best.filter.landmarks()]
        return tuple(sorted(found, key=lambda landmark: landmark.id))

    @property
    def state_size(self) -> int:
        """Number of scalars in the belief of the likeliest hypothesis."""
        return self._hypotheses[0].filter.state_size


def _owned(branches: list[Branch]) -> list[Hypothesis]:
    """Return for each branch a hypothesis of its own: copies, and the original for the last one."""
    last = {id(branch.of): i for i, branch in enumerate(branches)}
    return [b.of if last[id(b.of)] == i else b.of.copy() for i, b in enumerate(branches)]


def _check_noise(observations: tuple[Observation, ...]) -> None:
    """Raise `NumericalError` for an R that is no covariance, before anything has changed."""
    for observation in observations:
        try:
            np.linalg.cholesky(observation.R)
        except np.linalg.LinAlgError:
            raise NumericalError(
                f"the noise of a {observation.kind} is not positive definite: check the sensor's sigma"
            ) from None
