"""Smoothing: the whole path and all landmarks, by iSAM2 (Kaess et al. 2012).

Association and lifecycle of landmarks are those of `landmarks`. Only the estimate differs: each motion and
each match becomes a factor of a graph, which is relinearised when its variables move, also past ones; a
filter linearises only once. After each keyframe the filter is moved to the newest pose and the landmarks of
the graph, and the next scan is matched there with the covariance of the filter. The final result has the
marginals at the optimum of the graph.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from pydantic import PrivateAttr

from impslam.component import parameter, register
from impslam.errors import ConfigError, NumericalError
from impslam.estimators.base import MIN_SIGMA, Draft, is_finite
from impslam.estimators.landmarks import Landmarks
from impslam.estimators.observation_delay import blurred
from impslam.estimators.smoother import Smoother, SmootherEstimate
from impslam.growing_array import GrowingArray
from impslam.map import Keyframe, Revision
from impslam.types import NO_COVARIANCE, Array, Landmark, Observation


@register("smoothing")
class Smoothing(Landmarks):
    """The whole path and all landmarks as one graph, by iSAM2; needs the extra `graph`."""

    takes_unique: ClassVar[bool] = False
    considers_systematic_errors: ClassVar[bool] = False
    library: ClassVar[str] = "gtsam"

    relinearise: float = parameter(
        0.1,
        "m, rad",
        "variables that moved farther are relinearised; at the end, all are iterated to the optimum",
        gt=0,
    )
    _smoother: Smoother = PrivateAttr()
    _nodes: list[int] = PrivateAttr(default_factory=list)
    """The graph's pose of each keyframe; after an unknown motion, that of the previous keyframe."""
    _covariances: GrowingArray = PrivateAttr()
    _dims: dict[int, int] = PrivateAttr(default_factory=dict)
    _refined: SmootherEstimate | None = PrivateAttr(None)

    def start(self, pose: Array, **parts: Any) -> None:
        """Begin at a pose (3,) with an empty map; see `Estimator.start`."""
        super().start(pose, **parts)
        if not self._filter.follows:
            raise ConfigError(
                f"estimator 'smoothing' does not work with filter {self._filter.name!r}; choose another "
                "one with --set filter.kind=riekf"
            )
        self._smoother = Smoother(pose, MIN_SIGMA, self.relinearise)
        self._nodes, self._dims, self._refined = [], {}, None
        self._covariances = GrowingArray(3, 3)

    def add(self, keyframe: Keyframe) -> Revision:
        """Process a keyframe; see `Estimator.add`."""
        self._refined = None
        revision = super().add(keyframe)
        if is_finite(keyframe.motion):
            self._smoother.add_motion(self._motion.d_pose, self._motion.covariance)
        self._nodes.append(self._smoother.poses - 1)
        if not revision.refused:
            observations = blurred(keyframe.observations, keyframe.motion, self._models)
            self._add_factors(observations, revision)
        moved = self._smoother.solve()
        return self._with_scale(self._synchronise(keyframe, revision, has_moved=moved > 0))

    def _add_factors(self, observations: tuple[Observation, ...], revision: Revision) -> None:
        """Add the factors of the observations according to their matches."""
        factors = self._filter.noise_factors(revision.matches) if revision.matches else None
        for i, match in enumerate(revision.matches):
            inflation = 1.0 if factors is None else float(factors[i])
            self._smoother.add_observation(
                match.landmark, observations[match.observation], inflation
            )
        pose = self._filter.pose
        for number, origin in zip(revision.added, revision.origins, strict=True):
            model = self._models[observations[origin].kind]
            self._smoother.add_landmark(number, model, observations[origin], pose)
            self._dims[number] = model.dim
        for number in revision.removed:
            del self._dims[number]

    def _synchronise(self, keyframe: Keyframe, revision: Revision, *, has_moved: bool) -> Revision:
        """Move the filter to the estimate of the graph; return the revision with the graph's poses."""
        pose, covariance = self._smoother.pose()
        self._filter.follow(pose, {n: self._smoother.landmark(n) for n in self._dims})
        self._covariances.append(covariance)
        if not has_moved:
            return replace(revision, poses=pose[None], covariances=covariance[None])
        poses = self._smoother.path()[self._nodes]
        first = keyframe.id + 1 - len(poses)
        ids = np.arange(first, keyframe.id + 1)
        return replace(revision, ids=ids, poses=poses, covariances=self._covariances.array.copy())

    def refine(self) -> Revision | None:
        """Return all poses at the optimum with their marginals; see `Estimator.refine`."""
        if not self._nodes:
            return None
        ids = np.arange(len(self._nodes))
        try:
            self._refined = best = self._smoother.optimum(self._checkpoint)
        except NumericalError as error:
            current = self._smoother.path()[self._nodes], self._covariances.array.copy()
            refused = Revision(ids, *current, refused=f"the map is not refined: {error}")
            return self._with_scale(refused)
        poses, covariances = best.poses[self._nodes], best.covariances[self._nodes]
        return self._with_scale(Revision(ids, poses, covariances))

    def landmarks(self) -> tuple[Landmark, ...]:
        """Return the landmarks of the graph; after `refine`, with marginals at the optimum."""
        if self._refined is None:
            return super().landmarks()
        best, moved = self._refined.landmarks, self._filter.copied()
        moved.follow(self._refined.poses[-1], {n: best[n][0] for n in self._dims})
        found = (self._with_marginal(mark, *best[mark.id]) for mark in moved.landmarks())
        return self._landmarks_with_scale(found)

    def landmark_covariance(self) -> Array:
        """Return that of the filter; after `refine` none, because each landmark has its own marginal."""
        return super().landmark_covariance() if self._refined is None else NO_COVARIANCE

    def _with_marginal(self, mark: Landmark, m: Array, P: Array) -> Landmark:
        """Return a landmark of state m (dim,) with the covariance P (dim, dim) of that state."""
        J = self._models[mark.kind].report(m).values_D_m
        return replace(mark, covariance=J @ P @ J.T)

    def draft(self) -> Draft:
        """Return a snapshot of the estimate; see `Estimator.draft`."""
        landmarks, poses = super().landmarks(), self._smoother.path()[self._nodes]
        revision, covariances = None, self._covariances.array.copy()
        if len(poses):
            revision = self._with_scale(Revision(np.arange(len(poses)), poses, covariances))
        return Draft(lambda: revision, lambda: landmarks)

    def counts(self) -> Mapping[str, int]:
        """Return the size of the graph, and the counts of `Landmarks`."""
        return {**super().counts(), "poses in the graph": self._smoother.poses - 1}

    @property
    def state_size(self) -> int:
        """Number of estimated scalars."""
        return 3 * (self._smoother.poses - 1) + sum(self._dims.values())
