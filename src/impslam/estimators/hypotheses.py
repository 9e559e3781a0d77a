"""Multiple-hypothesis SLAM: later scans resolve ambiguous associations (Reid 1979, IEEE TAC 24(6)).

A hypothesis assigns every observation so far to a landmark or to a new one, and has its own filter. Each
observation branches each hypothesis: it may be any landmark in the gate, at the density of its innovation
N(nu; 0, S), or one that is not in the map yet, at the density of such landmarks. A landmark is seen at most
once in a scan. The likeliest hypotheses are kept. Those whose beliefs have become equal are merged and
their weights added, so that ambiguities that no longer matter do not use up the limited number.

The pose is that of the likeliest hypothesis; when another one becomes the likeliest, keyframes on which
they differ are revised. Covariances are those of the mixture, with the uncertainty of the association.

A match is reported if hypotheses of nearly all weight agree on it before merging: beliefs also become equal
if it makes no difference which landmark was seen. For this decision a scan has only its own noise: repeated
errors (`repeats` of the filter) weaken corrections and weights, but not the evidence of a single scan.

The id of a landmark is the number of its first observation, so that hypotheses can be compared.

Missed detections are not modelled: of two landmarks at one place, one may never be seen again. A duplicate
can therefore remain, and hypotheses that differ only in that have about the same weight.
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
from impslam.estimators.base import MIN_SIGMA, Estimator, check_keyframe, is_finite
from impslam.estimators.observation_delay import blurred
from impslam.estimators.sampling import normalised
from impslam.filters.base import Filter
from impslam.geometry.angles import wrap
from impslam.geometry.chi_square import quantile
from impslam.landmarks.base import LandmarkModel
from impslam.map import Keyframe, Revision
from impslam.types import Array, Increment, Landmark, Match, Observation


@dataclass(frozen=True, slots=True, eq=False)
class Past:
    """Linked list of a hypothesis's poses and covariances, newest first; hypotheses share its tails."""

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
    log_weight : log of its probability, up to a common constant
    ids : ids of landmarks by their ids in the filter
    observed : landmark ids of the newest scan's observations so far
    matches : matches of those that were known before, by observation
    scan_gain : increase of log_weight if the newest scan had only its own noise
    """

    filter: Filter
    log_weight: float = 0.0
    ids: dict[int, int] = field(default_factory=dict)
    past: Past | None = None
    observed: list[int] = field(default_factory=list)
    matches: dict[int, Match] = field(default_factory=dict)
    scan_gain: float = 0.0

    def copy(self) -> Hypothesis:
        """Return an independent copy."""
        ids, observed, matches = dict(self.ids), list(self.observed), dict(self.matches)
        belief = self.filter.copied()
        return replace(self, filter=belief, ids=ids, observed=observed, matches=matches)


class Branch(NamedTuple):
    """A continuation of a hypothesis: log weight, and the match; None: the landmark is new.

    `scan_gain` is the increase of the log weight if the observation had only its own noise.
    """

    log_weight: float
    hypothesis: Hypothesis
    match: Match | None = None
    scan_gain: float = 0.0


@register("hypotheses")
class MultipleHypotheses(Estimator):
    """Several hypotheses of the association, each with its own filter (Reid 1979)."""

    parts: ClassVar[tuple[str, ...]] = ("filter",)

    max_hypotheses: int = parameter(20, "1", "maximum number of hypotheses", ge=1)
    gate: float = parameter(
        0.9999, "1", "probability that a true pairing passes the chi-square gate", gt=0, lt=1
    )
    density: float = parameter(
        0.03,
        "1/z",
        "landmarks that are not in the map yet, per unit of measurement space (points: 1 m^2): a "
        "tenth of the 0.3 of offices, because most observed landmarks are known",
        gt=0,
    )
    min_weight: float = parameter(
        1e-5, "1", "hypotheses with less weight, relative to the best, are dropped", gt=0, lt=1
    )
    merge_distance: float = parameter(
        0.2,
        "sigma",
        "hypotheses are merged if all means differ by less; merging widens them by at most 1 %",
        ge=0,
    )
    agreement: float = parameter(
        0.99,
        "1",
        "share of the weight that has to agree on a match before it is reported",
        gt=0.5,
        le=1,
    )
    _models: Mapping[str, LandmarkModel] = PrivateAttr()
    _hypotheses: list[Hypothesis] = PrivateAttr()
    _reported: dict[int, Past] = PrivateAttr(default_factory=dict)
    _observation_count: int = PrivateAttr(default=0)
    _agreed_matches: tuple[Match, ...] = PrivateAttr(default=())

    def start(self, pose: Array, **parts: Any) -> None:
        """Begin at a pose (3,) with an empty map; see `Estimator.start`."""
        self._models = parts["models"]
        parts["filter"].start(pose, MIN_SIGMA**2 * np.eye(3), self._models)
        self._hypotheses = [Hypothesis(parts["filter"])]
        self._reported, self._observation_count = {}, 0

    def add(self, keyframe: Keyframe) -> Revision:
        """Process a keyframe; see `Estimator.add`."""
        observations, reason = tuple[Observation, ...](), ""
        try:
            check_keyframe(keyframe)
            observations = blurred(keyframe.observations, keyframe.motion, self._models)
        except NumericalError as error:
            reason = f"the scan at {keyframe.stamp:.3f} s is not used for the map: {error}"
        if is_finite(keyframe.motion):
            self._move(keyframe.motion)
        try:
            self._branch(observations, keyframe.stamp)
        except NumericalError as error:
            reason = f"the scan at {keyframe.stamp:.3f} s is not used for the map: {error}"
        return self._revision(keyframe, reason)

    def _move(self, motion: Increment) -> None:
        for hypothesis in self._hypotheses:
            hypothesis.filter.predict(motion)
            hypothesis.observed, hypothesis.matches, hypothesis.scan_gain = [], {}, 0.0

    def _branch(self, observations: tuple[Observation, ...], stamp: float) -> None:
        """Branch by all observations of a scan; after a `NumericalError` by none of them."""
        before = self._hypotheses, self._observation_count
        self._hypotheses = [h.copy() for h in self._hypotheses] if observations else before[0]
        try:
            for observation in observations:
                self._branch_by(observation, stamp)
        except NumericalError:
            self._hypotheses, self._observation_count = before
            raise
        self._agreed_matches = self._agreed()
        self._merge()

    def _branch_by(self, observation: Observation, stamp: float) -> None:
        """Branch by one observation; branches without a solution are dropped if others are left."""
        branches = [b for h in self._hypotheses for b in self._branches(h, observation)]
        branches.sort(key=lambda branch: -branch.log_weight)
        threshold = branches[0].log_weight + math.log(self.min_weight)
        kept = [b for b in branches[: self.max_hypotheses] if b.log_weight >= threshold]
        extended, failed = list[Hypothesis](), NumericalError()
        for branch, own in zip(kept, _owned(kept), strict=True):
            try:
                extended.append(self._extended(branch, own, observation, stamp))
            except NumericalError as error:
                failed = error
        if not extended:
            raise failed
        self._hypotheses = extended
        self._observation_count += 1

    def _branches(self, parent: Hypothesis, observation: Observation) -> Iterator[Branch]:
        """Yield the possible associations of an observation, with the noise used in corrections."""
        seen, matches = (observation,), list[Match]()
        for group in parent.filter.hypothesise(seen, lambda dof: quantile(self.gate, dof)):
            pairs = np.flatnonzero(group.possible).tolist()
            matches += [
                m for m in group.matches(pairs) if parent.ids[m.landmark] not in parent.observed
            ]
        yield Branch(parent.log_weight + math.log(self.density), parent)
        if matches:
            densities = parent.filter.log_densities(seen, matches)
            gains = parent.filter.log_densities(seen, matches, alone=True) - densities
            for match, density, scan_gain in zip(matches, densities, gains, strict=True):
                yield Branch(parent.log_weight + float(density), parent, match, float(scan_gain))

    def _extended(
        self, branch: Branch, own: Hypothesis, observation: Observation, stamp: float
    ) -> Hypothesis:
        """Apply a branch to `own`, a hypothesis that no other branch uses."""
        own.log_weight, own.scan_gain = branch.log_weight, own.scan_gain + branch.scan_gain
        if branch.match is None:
            (number,) = own.filter.extend((observation,), stamp)
            own.ids[number] = self._observation_count
        else:
            number = branch.match.landmark
            own.filter.correct((observation,), (branch.match,))
            own.filter.note((observation,), (branch.match,), stamp)
            own.matches[len(own.observed)] = branch.match
        own.observed.append(own.ids[number])
        return own

    def _merge(self) -> None:
        """Merge hypotheses with equal beliefs; the assignments of the likelier one are kept."""
        kept: list[Hypothesis] = []
        for hypothesis in sorted(self._hypotheses, key=lambda h: -h.log_weight):
            for other in kept:
                if other.filter.resembles(hypothesis.filter, self.merge_distance):
                    total = np.logaddexp(other.log_weight, hypothesis.log_weight)
                    other.log_weight = float(total)
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
        """Return the keyframes on which the likeliest hypothesis differs from the reported poses."""
        for h in self._hypotheses:
            h.past = Past(keyframe.id, h.filter.pose, h.filter.covariance, h.past)
        changed, past = list[Past](), self._hypotheses[0].past
        while past is not None and self._reported.get(past.keyframe) is not past:
            self._reported[past.keyframe] = past
            changed.append(past)
            past = past.before
        changed.reverse()
        covariances = np.array([p.covariance for p in changed])
        covariances[-1] = self._mixture_covariance()
        return Revision(
            np.array([p.keyframe for p in changed]),
            np.array([p.pose for p in changed]),
            covariances,
            matches=() if refused else self._agreed_matches,
            refused=refused,
        )

    def _mixture_covariance(self) -> Array:
        """Return the covariance (3, 3) of all hypotheses about the pose of the likeliest one."""
        pose, total = self._hypotheses[0].filter.pose, np.zeros((3, 3))
        for weight, h in zip(self._weights(), self._hypotheses, strict=True):
            offset = h.filter.pose - pose
            offset[2] = wrap(float(offset[2]))
            total += weight * (h.filter.covariance + np.outer(offset, offset))
        return total

    def _agreed(self) -> tuple[Match, ...]:
        """Return the newest scan's matches on which hypotheses of nearly all weight agree."""
        weights = normalised(np.array([h.log_weight + h.scan_gain for h in self._hypotheses]))
        likeliest, agreed = self._hypotheses[int(weights.argmax())], []
        for i, match in likeliest.matches.items():
            number = likeliest.ids[match.landmark]
            share = weights @ [h.observed[i] == number for h in self._hypotheses]
            if share >= self.agreement:
                agreed.append(match._replace(observation=i, landmark=number))
        return tuple(agreed)

    def landmarks(self) -> tuple[Landmark, ...]:
        """Return the landmarks of the likeliest hypothesis as `types.Landmark`."""
        best = self._hypotheses[0]
        return tuple(replace(m, id=best.ids[m.id]) for m in best.filter.landmarks())

    def landmark_covariance(self) -> Array:
        """Return the joint covariance by the likeliest hypothesis; see `Estimator.landmark_covariance`."""
        return self._hypotheses[0].filter.landmark_covariance()

    @property
    def state_size(self) -> int:
        """Number of scalars in the belief of the likeliest hypothesis."""
        return self._hypotheses[0].filter.state_size


def _owned(branches: list[Branch]) -> list[Hypothesis]:
    """Return a separate hypothesis per branch: copies, and the original for its last branch."""
    last = {id(branch.hypothesis): i for i, branch in enumerate(branches)}
    parents = [branch.hypothesis for branch in branches]
    return [h if last[id(h)] == i else h.copy() for i, h in enumerate(parents)]
