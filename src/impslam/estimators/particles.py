"""FastSLAM: particles of the robot's path, each with its own landmarks and its own association.

Given the path, landmarks are independent of each other: a particle is a path and a small filter for each
landmark (Montemerlo, Thrun, Koller & Wegbreit 2002). The cost of a scan is proportional to its number of
observations and to that of particles, for any size of the map, and a false match affects only the
particles that made it.

FastSLAM 1 samples the pose from the motion. FastSLAM 2 (Montemerlo et al. 2003) samples it from the motion
and the observations: with a pose x^ (+) V u, u of unit covariance, and an innovation nu of H_x u and noise
Z = H_m P_m H_m^T + R for each match,

    L = I + sum H_x^T Z^-1 H_x,    b = sum H_x^T Z^-1 nu,    u ~ N(L^-1 b, L^-1),
    -2 log w = sum (nu^T Z^-1 nu + log |2 pi Z|) - b^T L^-1 b + log |L|,

which needs no inverse of the motion's covariance, so the robot may be stationary. An unmatched observation
is weighted like one at the gate. Landmarks are then corrected at the sampled pose. Particles are resampled
systematically when their effective number falls below a share of them.

Resampling depletes the past: all particles descend from few ancestors, so covariances are too small after
long loops (Bailey, Nieto & Nebot 2006). `imp reproduce filters` shows it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from pydantic import PrivateAttr

from impslam.association.base import Association
from impslam.component import parameter, register
from impslam.errors import ConfigError, NumericalError
from impslam.estimators.base import MIN_SIGMA, Estimator, check_keyframe, is_finite
from impslam.estimators.observation_delay import blurred
from impslam.estimators.particle_association import (
    ParticleMatches,
    ParticlePoses,
    associate,
    by_kind,
)
from impslam.estimators.particle_kernels import add_information, axes, correct, systematic
from impslam.estimators.particle_landmarks import LandmarkTable
from impslam.estimators.sampling import moved, normalised
from impslam.filters.base import Filter
from impslam.geometry.angles import wrap
from impslam.geometry.chi_square import GATE_2D
from impslam.geometry.roots import root
from impslam.geometry.se2 import compose
from impslam.landmarks.base import LandmarkModel, average
from impslam.lifecycle.base import Lifecycle
from impslam.map import Keyframe, Revision
from impslam.types import Array, Increment, Ints, Landmark, Match, Observation

MIN_WEIGHT = 0.5
"""Total weight of the particles that have a landmark of the map."""


@register("particles")
class Particles(Estimator):
    """FastSLAM 1 and 2: particles with their own path and landmarks (Montemerlo et al. 2002, 2003)."""

    parts: ClassVar[tuple[str, ...]] = ("filter", "association", "lifecycle")

    particles: int = parameter(100, "1", "number of particles", ge=1)
    version: int = parameter(
        2,
        "1",
        "1: poses are sampled from the motion alone; 2: from motion and observations",
        ge=1,
        le=2,
    )
    resample_below: float = parameter(
        0.5, "1", "share of effective particles below which they are resampled", gt=0, le=1
    )
    seed: int = parameter(0, "1", "seed of the sampling", ge=0)
    _association: Association = PrivateAttr()
    _lifecycle: Lifecycle = PrivateAttr()
    _models: Mapping[str, LandmarkModel] = PrivateAttr()
    _rng: np.random.Generator = PrivateAttr()
    _poses: Array = PrivateAttr()
    _log_weights: Array = PrivateAttr()
    _tables: dict[str, LandmarkTable] = PrivateAttr()
    _mapped: set[int] = PrivateAttr()
    _next_id: int = PrivateAttr(default=0)

    def start(self, pose: Array, **parts: Any) -> None:
        """Begin at a pose (3,) with an empty map; see `Estimator.start`."""
        association: Association = parts["association"]
        self._association, self._lifecycle = association.for_known_pose(), parts["lifecycle"]
        if self._association.is_joint:
            raise ConfigError(
                f"estimator 'particles' cannot use association {self._association.name!r}, which matches a "
                "scan as a whole; choose another one with --set association.kind=mahalanobis"
            )
        tentative: Filter = parts["filter"]
        self._models, self._rng = parts["models"], np.random.default_rng(self.seed)
        self._poses = np.tile(np.asarray(pose, np.float64), (self.particles, 1))
        self._log_weights = np.zeros(self.particles)
        self._tables, self._mapped, self._next_id = {}, set(), 0
        self._lifecycle.start(self._models, association, tentative.fresh())

    def add(self, keyframe: Keyframe) -> Revision:
        """Process a keyframe; see `Estimator.add`."""
        random_state = self._rng.bit_generator.state
        try:
            check_keyframe(keyframe)
            return self._add(
                keyframe, blurred(keyframe.observations, keyframe.motion, self._models)
            )
        except NumericalError as error:
            self._rng.bit_generator.state = random_state
            reason = f"the scan at {keyframe.stamp:.3f} s is not used for the map: {error}"
        if is_finite(keyframe.motion):
            self._poses, _ = self._sample((), self._predicted(keyframe.motion))
            self._lifecycle.move(keyframe.motion)
        return self._revision(keyframe, refused=reason)

    def _add(self, keyframe: Keyframe, seen: tuple[Observation, ...]) -> Revision:
        kinds = by_kind(seen, {o.kind: self._table(o.kind) for o in seen})
        cloud = self._predicted(keyframe.motion)
        choice = associate(seen, kinds, cloud, self._association)
        poses, cost = self._sample(choice.pairs, cloud)

        self._poses = poses
        self._log_weights -= 0.5 * (cost + ~choice.matched @ _unmatched_cost(seen))
        self._lifecycle.move(keyframe.motion)
        for pairs in choice.pairs:
            self._correct(pairs)
        weights = self._weights()
        observed = self._note(seen, choice.best, keyframe.stamp)
        for i in self._promote(seen, weights @ choice.new, keyframe.motion.stamp):
            holders = np.flatnonzero(~choice.matched[:, i])
            observed[self._add_landmark(seen[i], holders, keyframe.stamp)] = i

        shares = self._shares(weights)
        removed = [number for number in self._mapped if shares[number] <= MIN_WEIGHT]
        removed += self._missed(keyframe, weights, choice.best)
        added = [
            i
            for i in observed
            if i not in self._mapped and i not in removed and shares[i] > MIN_WEIGHT
        ]
        matches = tuple(match for match in choice.best if match.landmark in self._mapped)
        revision = self._revision(
            keyframe,
            matches=matches,
            added=tuple(added),
            origins=tuple(observed[number] for number in added),
            removed=tuple(removed),
        )
        self._mapped = (self._mapped | set(added)) - set(removed)
        self._resample(weights, set(removed))
        return revision

    def _predicted(self, motion: Increment) -> ParticlePoses:
        """Return the poses after a motion: sampled (version 1), or with their uncertainty."""
        poses = compose(self._poses, motion.d_pose)
        roots = axes(self._poses, root(motion.covariance))
        if self.version == 1:
            poses, roots = moved(poses, roots, self._normals()), np.zeros_like(roots)
        return ParticlePoses(poses, roots, int(np.argmax(self._log_weights)))

    def _sample(
        self, pairs: Sequence[ParticleMatches], cloud: ParticlePoses
    ) -> tuple[Array, Array]:
        """Return poses (P, 3) sampled by motion and matches, and -2 log likelihood (P,) of the matches.

        Raises
        ------
        NumericalError
            If the covariance of an innovation is not positive definite.
        """
        information = np.tile(np.eye(3), (self.particles, 1, 1))
        vector, cost = np.zeros((self.particles, 3)), np.zeros(self.particles)
        for some in pairs:
            predicted, (table, _, z, R, _) = some.predict(cloud.poses), some.kind
            seen = table.model.residual(z[some.rows], predicted.z), R[some.rows]
            P = table.P[table.rows[some.particles, some.slots]]
            jacobians, out = (predicted.z_D_pose, predicted.z_D_m), (information, vector, cost)
            if not add_information(some.particles, cloud.roots, seen, jacobians, P, out):
                raise NumericalError("the covariance of an innovation is not positive definite")
        L = np.linalg.cholesky(information)
        y = np.linalg.solve(L, vector[..., None])
        u = np.linalg.solve(L.swapaxes(1, 2), y + self._normals()[..., None])[..., 0]
        cost += 2.0 * np.log(np.einsum("pii->pi", L)).sum(1) - (y[..., 0] ** 2).sum(1)
        return moved(cloud.poses, cloud.roots, u), cost

    def _correct(self, pairs: ParticleMatches) -> None:
        """Correct the matched landmarks from the sampled poses."""
        predicted, (table, _, z, R, _) = pairs.predict(self._poses), pairs.kind
        nu = table.model.residual(z[pairs.rows], predicted.z)
        rows = table.unshare(pairs.particles, pairs.slots)
        P = table.P[rows]
        steps = correct(nu, R[pairs.rows], predicted.z_D_m, P)
        table.m[rows], table.P[rows] = table.model.retract(table.m[rows], steps), P

    def _note(
        self, seen: Sequence[Observation], matches: Sequence[Match], stamp: float
    ) -> dict[int, int]:
        """Record the matches of the likeliest particle; return their observations by landmark id."""
        for match in matches:
            observation = seen[match.observation]
            table, slot = self._find(match.landmark)
            table.note(slot, stamp, observation.attributes)
            self._widen(table, slot, observation)
        return {match.landmark: match.observation for match in matches}

    def _widen(self, table: LandmarkTable, slot: int, observation: Observation) -> None:
        """Extend the extent of a landmark by an observation, in the map of one of its particles."""
        if not table.model.has_extent or observation.end_points is None:
            return
        (p,) = np.flatnonzero(table.rows[:, slot] >= 0)[:1]
        m, extent = table.m[table.rows[p, slot]], table.extents[slot]
        begin, end = table.model.extents(self._poses[p], m[None], observation.end_points[None])[0]
        extent[:] = min(extent[0], begin), max(extent[1], end)

    def _promote(self, seen: Sequence[Observation], share: Array, now: float) -> list[int]:
        """Return which observations that are new to most particles become landmarks."""
        unmatched = np.flatnonzero(share > MIN_WEIGHT).tolist()
        is_empty = not any(len(table.ids) for table in self._tables.values())
        promoted = self._lifecycle.promote([seen[i] for i in unmatched], now, is_empty)
        return [unmatched[k] for k in promoted]

    def _add_landmark(self, observation: Observation, holders: Ints, stamp: float) -> int:
        """Add a landmark to some particles (h,); return its id."""
        table, number = self._table(observation.kind), self._next_id
        self._next_id += 1
        new = [table.model.initialise(pose, observation) for pose in self._poses[holders]]
        P = [i.m_D_z @ observation.R @ i.m_D_z.T + i.slack for i in new]
        label = -1 if observation.label is None else observation.label
        table.add(number, label, stamp, holders, np.array([i.m for i in new]), np.array(P))
        average(table.attributes[number], observation.attributes, 1.0)
        self._widen(table, len(table.ids) - 1, observation)
        return number

    def _missed(self, keyframe: Keyframe, weights: Array, matches: Sequence[Match]) -> list[int]:
        """Return the landmarks to remove because the likeliest particle should see them but does not."""
        best = int(np.argmax(weights))
        ids, outlines = [], []
        for table in (b for b in self._tables.values() if not b.model.unique):
            (slots,) = np.nonzero((table.rows[best] >= 0) & np.isin(table.ids, list(self._mapped)))
            ids.append(table.ids[slots])
            outlines.append(
                table.model.outline(table.m[table.rows[best, slots]], table.extents[slots])
            )
        if keyframe.scan is None or not sum(map(len, ids)):
            return []
        known, ends = np.concatenate(ids), np.concatenate(outlines)
        return self._lifecycle.review(keyframe.scan, self._poses[best], known, ends, matches)

    def _resample(self, weights: Array, removed: set[int]) -> None:
        """Resample if few particles are effective; remove the given landmarks, and those of no particle."""
        if 1.0 / (weights @ weights) < self.resample_below * self.particles:
            parents = systematic(weights, self._rng.random())
            self._poses, self._log_weights = self._poses[parents], np.zeros(self.particles)
            for table in self._tables.values():
                table.resample(parents)
        for table in self._tables.values():
            unused = (table.rows < 0).all(0) | np.isin(table.ids, list(removed))
            if unused.any():
                table.forget(unused)

    def _revision(self, keyframe: Keyframe, **facts: Any) -> Revision:
        """Return the mean and the covariance of the particles' poses."""
        weights = self._weights()
        middle = self._poses[np.argmax(weights)]
        off = self._poses - middle
        off[:, 2] = wrap(off[:, 2])
        mean = weights @ off
        pose, off = middle + mean, off - mean
        pose[2] = wrap(float(pose[2]))
        covariance = (weights[:, None] * off).T @ off + MIN_SIGMA**2 * np.eye(3)
        return Revision(np.array([keyframe.id]), pose[None], covariance[None], **facts)

    def landmarks(self) -> tuple[Landmark, ...]:
        """Return the landmarks of most particles as `types.Landmark`."""
        weights = self._weights()
        return tuple(
            table.landmark(slot, weights) for table, slot in map(self._find, sorted(self._mapped))
        )

    @property
    def state_size(self) -> int:
        """Number of scalars in one particle."""
        return 3 + sum(self._find(number)[0].model.dim for number in self._mapped)

    def _table(self, kind: str) -> LandmarkTable:
        if kind not in self._tables:
            if kind not in self._models:
                raise ConfigError(
                    f"no landmark model for observations of kind {kind!r}; register one"
                )
            self._tables[kind] = LandmarkTable(kind, self._models[kind], self.particles)
        return self._tables[kind]

    def _find(self, number: int) -> tuple[LandmarkTable, int]:
        """Return the table of a landmark and its slot there; ids ascend."""
        for table in self._tables.values():
            slot = int(np.searchsorted(table.ids, number))
            if slot < len(table.ids) and table.ids[slot] == number:
                return table, slot
        raise KeyError(number)

    def _shares(self, weights: Array) -> dict[int, float]:
        """Return the total weight of the particles that have each landmark."""
        shares: dict[int, float] = {}
        for table in self._tables.values():
            shares.update(zip(table.ids.tolist(), table.shares(weights).tolist(), strict=True))
        return shares

    def _weights(self) -> Array:
        """Return the weights (P,), whose sum is 1."""
        return normalised(self._log_weights)

    def _normals(self) -> Array:
        return self._rng.standard_normal((self.particles, 3))


def _unmatched_cost(seen: Sequence[Observation]) -> Array:
    """Return -2 log likelihood of each observation (a,) if it is unmatched: at the gate from a landmark."""
    return np.array([GATE_2D + np.linalg.slogdet(2.0 * math.pi * o.R)[1] for o in seen], np.float64)
