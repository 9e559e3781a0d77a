"""EKF SLAM: predict, observe, associate, correct, extend (thesis Fig. 1)."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from pydantic import PrivateAttr

from impslam.association.base import Assignment, Association
from impslam.building.sightings import SightingsLog
from impslam.component import parameter, register
from impslam.errors import NumericalError
from impslam.estimators.alternative_places import AlternativePlaces
from impslam.estimators.base import MIN_SIGMA, Estimator, check_keyframe, is_finite
from impslam.estimators.duplicates import Duplicates, with_kept_landmark
from impslam.estimators.map_scale import joint_with_scale, landmark_with_scale, revision_with_scale
from impslam.estimators.observation_delay import blurred
from impslam.estimators.refused_fixes import RefusedFixes
from impslam.estimators.slip import RECENT, Attempt, explains, slipped
from impslam.filters.base import Filter
from impslam.health import MAX_GROWTH
from impslam.landmarks.base import LandmarkModel
from impslam.lifecycle.base import Lifecycle
from impslam.map import Keyframe, Revision
from impslam.maps.grid import Standstill
from impslam.noise import MAX_GAP
from impslam.types import Array, ErrorEstimate, Increment, Landmark, Match, Observation


@register("landmarks")
class Landmarks(Estimator):
    """A filter over the robot's pose and the landmarks, with association and lifecycle (the thesis)."""

    parts: ClassVar[tuple[str, ...]] = ("filter", "association", "lifecycle")
    takes_unique: ClassVar[bool] = True
    considers_systematic_errors: ClassVar[bool] = True

    scale_sigma: float = parameter(
        0.0,
        "1",
        "standard deviation of the scale of a lidar's ranges, and so of the map; 0: the scale is assumed "
        "to be exact",
        ge=0,
        le=1,
    )

    _filter: Filter = PrivateAttr()
    _association: Association = PrivateAttr()
    _lifecycle: Lifecycle = PrivateAttr()
    _models: Mapping[str, LandmarkModel] = PrivateAttr()
    _origin: Array = PrivateAttr()
    """(2,) m, the first position."""
    _motion: Increment = PrivateAttr()
    """The predicted motion to the newest keyframe, possibly with slip."""
    _recent: deque[set[int]] = PrivateAttr(default_factory=lambda: deque(maxlen=RECENT))
    """The landmarks matched in the newest keyframes."""
    _seen_kinds: set[str] = PrivateAttr(default_factory=set)
    _refused: RefusedFixes = PrivateAttr(default_factory=RefusedFixes)
    _duplicates: Duplicates = PrivateAttr(default_factory=Duplicates)
    _alternatives: AlternativePlaces = PrivateAttr(default_factory=AlternativePlaces)
    _counts: Counter[str] = PrivateAttr(default_factory=Counter)
    _sightings: SightingsLog = PrivateAttr(default_factory=SightingsLog)
    """The observations of keyframes, from which `graph` continues the map."""
    _standstill: Standstill = PrivateAttr(default_factory=Standstill)

    def start(self, pose: Array, **parts: Any) -> None:
        """Begin at a pose (3,) with an empty map; see `Estimator.start`."""
        self._filter, self._association = parts["filter"], parts["association"]
        self._lifecycle, self._models = parts["lifecycle"], parts["models"]
        self._duplicates, self._origin = Duplicates(), pose[:2].copy()
        self._alternatives = AlternativePlaces()
        self._filter.start(pose, MIN_SIGMA**2 * np.eye(3), self._models)
        self._lifecycle.start(self._models, self._association, self._filter.fresh())

    def add(self, keyframe: Keyframe) -> Revision:
        """Process a keyframe; see `Estimator.add`."""
        self._motion = keyframe.motion
        try:
            revision = self._add(keyframe)
        except NumericalError as error:
            self._sightings.add((), keyframe.stamp)
            self._motion = keyframe.motion
            if is_finite(keyframe.motion):
                self._filter.predict(keyframe.motion)
                self._lifecycle.move(keyframe.motion)
            reason = f"the scan at {keyframe.stamp:.3f} s is not used for the map: {error}"
            return self._revision(keyframe, refused=reason)
        is_redundant = self._standstill.is_redundant(revision.poses[-1])
        self._sightings.add(() if is_redundant else keyframe.observations, keyframe.stamp)
        return revision

    def _add(self, keyframe: Keyframe) -> Revision:
        check_keyframe(keyframe)
        observations = blurred(keyframe.observations, keyframe.motion, self._models)
        stamp, now = keyframe.stamp, keyframe.motion.stamp  # `now` is continuous if clocks are set

        self._filter.predict(keyframe.motion)
        try:
            choice = self._associate(observations, keyframe.motion)
            predicted, spread = self._filter.pose.copy(), self._filter.covariance[:2, :2].copy()
            innovation = self._filter.correct(observations, choice.matches)
        except NumericalError:
            self._filter.undo_predict()
            raise
        self._review_alternatives(predicted, spread, observations)
        self._recent.append({match.landmark for match in choice.matches})
        self._lifecycle.move(self._motion)
        self._filter.note(observations, choice.matches, stamp)

        unique = [i for i in choice.new if self._models[observations[i].kind].unique]
        others = [i for i in choice.new if i not in unique]
        unmatched = [observations[i] for i in others]
        is_empty = self._filter.state_size == len(self._filter.pose)
        chosen = [others[i] for i in self._lifecycle.promote(unmatched, now, is_empty)]
        chosen += self._first_of_kind(observations, unique)
        added = self._filter.extend([observations[i] for i in chosen], stamp)
        removed = self._check_refused_fixes(observations, choice.matches, chosen, now)

        fused = self._duplicates.fuse(choice, self._filter, self._association)
        matches = tuple([with_kept_landmark(m, fused) for m in choice.matches])
        removed += list(fused)
        ids, outlines = self._filter.outlines()
        if keyframe.scan is not None and len(ids):
            missed = self._lifecycle.review(
                keyframe.scan, self._filter.pose, ids, outlines, matches
            )
            self._filter.remove(missed)
            removed += missed

        if fused:
            self._counts["landmarks fused"] += len(fused)
        facts = {"matches": matches, "added": added, "origins": tuple(chosen)}
        facts["ambiguous"] = choice.ambiguous
        return self._revision(keyframe, **facts, removed=tuple(removed), innovation=innovation)

    def _associate(self, observations: tuple[Observation, ...], motion: Increment) -> Assignment:
        """Associate; repeat the prediction with slipping wheels if that explains more."""
        rolled = self._attempt(observations, motion)
        if rolled.unexplained(len(observations)) == 0 or motion.duration > MAX_GAP:
            return rolled.choice
        evidence = rolled.evidence(self._filter.joint, observations)
        self._repeat_prediction(slipped(motion))
        attempt = self._attempt(observations, self._motion)
        is_likelier = attempt.evidence(self._filter.joint, observations) > evidence
        recent = set().union(*self._recent)
        if is_likelier and explains(attempt, rolled, len(observations), recent):
            self._counts["keyframes with wheel slip"] += 1
            return attempt.choice
        self._repeat_prediction(motion)
        return rolled.choice

    def _review_alternatives(
        self, predicted: Array, spread: Array, observations: tuple[Observation, ...]
    ) -> None:
        """Search for places that look the same after an uncertain motion, and tell them apart later.

        `predicted` (3,) and `spread` (2, 2) are the pose and the covariance of the position before the
        correction.
        """
        uncertain = np.trace(self._motion.covariance[:2, :2]) > MAX_GROWTH**2
        if not uncertain and not self._alternatives.watching:
            return
        landmarks = [mark for mark in self._filter.landmarks() if self._has_place(mark)]
        seen = [one for one in observations if self._has_place(one)]
        if uncertain:
            self._alternatives.begin(spread, max((mark.id for mark in landmarks), default=-1))
        self._alternatives.review(predicted, self._filter.pose, seen, landmarks)

    def _has_place(self, one: Observation | Landmark) -> bool:
        """Return whether it is an object with a known place: no GPS frame, no wall without ends."""
        model = self._models[one.kind]
        return not model.unique and (one.end_points is not None or not model.has_extent)

    def _attempt(self, observations: tuple[Observation, ...], motion: Increment) -> Attempt:
        choice = self._filter.associate(observations, self._association)
        others = tuple(observations[i] for i in choice.new)
        return Attempt(choice, self._lifecycle.recognise(others, motion))

    def _repeat_prediction(self, motion: Increment) -> None:
        self._motion = motion
        self._filter.undo_predict()
        self._filter.predict(motion)

    def _first_of_kind(self, observations: tuple[Observation, ...], unique: list[int]) -> list[int]:
        """Return the indices of the first observations of unique landmarks."""
        first = {
            observations[i].kind: i
            for i in reversed(unique)
            if observations[i].kind not in self._seen_kinds
        }
        self._seen_kinds |= set(first)
        return list(first.values())

    def _check_refused_fixes(
        self,
        observations: tuple[Observation, ...],
        matches: Sequence[Match],
        added: list[int],
        now: float,
    ) -> list[int]:
        """Widen the pose, or remove the GPS frame, if refused fixes agree; return the removed ids."""
        used, removed = {match.observation for match in matches}, list[int]()
        for i, fix in enumerate(observations):
            if not self._models[fix.kind].unique or fix.kind not in self._seen_kinds:
                continue
            if i in used or i in added:
                self._refused.accept()
                continue
            frame = next(mark for mark in self._filter.landmarks() if mark.kind == fix.kind)
            # A frame parallel to map in which the fix is 0 has its origin at the antenna.
            antenna = self._models[fix.kind].invert(self._filter.pose, np.zeros((1, 2)))[0, :2]
            error = self._refused.refuse(antenna, fix, frame)
            if error is None:
                continue
            if error.frame_is_wrong:
                self._filter.remove([frame.id])
                removed.append(frame.id)
                self._seen_kinds.discard(fix.kind)
                self._counts["GPS frames re-initialised"] += 1
            else:
                self._filter.predict(Increment(now, np.zeros(3), error.covariance))
                self._counts["pose covariances widened by refused GPS fixes"] += 1
        return removed

    def observations(self) -> tuple[tuple[Observation, ...], ...]:
        """Return the observations of each keyframe; see `Estimator.observations`."""
        return self._sightings.by_keyframe()

    @property
    def systematic_errors(self) -> ErrorEstimate | None:
        """What the filter knows of the systematic errors of odometry."""
        return self._filter.systematic_errors

    def counts(self) -> Mapping[str, int]:
        """Return the counts of fused landmarks, slips, and corrections by refused GPS fixes."""
        return dict(self._counts)

    def _revision(self, keyframe: Keyframe, **facts: Any) -> Revision:
        pose, covariance = self._filter.pose[None], self._filter.covariance[None]
        facts["fits_elsewhere"] = self._alternatives.exist
        revision = Revision(np.array([keyframe.id]), pose, covariance, **facts)
        return self._with_scale(revision)

    def _with_scale(self, revision: Revision) -> Revision:
        return revision_with_scale(revision, self._origin, self.scale_sigma)

    def landmarks(self) -> tuple[Landmark, ...]:
        """Return the landmarks as `types.Landmark`."""
        return self._landmarks_with_scale(self._filter.landmarks())

    def landmark_covariance(self) -> Array:
        """Return the joint covariance (2 k, 2 k) of the landmarks; see `Estimator.landmark_covariance`."""
        found, covariance = self._filter.landmarks(), self._filter.landmark_covariance()
        return joint_with_scale(covariance, found, self._origin, self.scale_sigma)

    def _landmarks_with_scale(self, found: Iterable[Landmark]) -> tuple[Landmark, ...]:
        return tuple(landmark_with_scale(m, self._origin, self.scale_sigma) for m in found)

    @property
    def state_size(self) -> int:
        """Number of scalars in the state."""
        return self._filter.state_size
