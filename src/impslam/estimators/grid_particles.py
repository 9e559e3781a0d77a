"""A grid particle filter (Grisetti, Stachniss & Burgard 2007), on maps of surfaces.

Given the path, the map is known: a particle is a path with the map drawn on it. Loops close by selection:
particles with the right drift find the walls where their maps have them, and the others die out.

Each particle aligns the scan with its own map. With the predicted pose x^ (+) V u, u of unit covariance,
and the optimum u^ of scan and motion and its information L by Gauss-Newton,

    u ~ N(u^, L^-1),    -2 log w = c^2 / (s^2 n) sum(1 - share_i) + v log(1 + |u^|^2 / v) + log |L|:

the improved proposal, with its normaliser from the optimum instead of a sum over samples (there Eq. 11 to
16). A point's share is 1 on a surface and falls to 0 by distance c (Geman-McClure); a point without a
surface counts as far off. Points have common errors: n of them count as one. The drift over a loop has
heavier tails than the motion of a step, hence Student's t with v degrees of freedom.

The tracker has already aligned the scan with those of the last metres. To use these only once, a scan
enters the particles' maps with a delay, at the particles' poses of its time. All particles of one lineage
then share a map, and resampling copies nothing.

The reported path is that of the leading lineage. The covariance of a keyframe is the mean square of all
particles about it when it was new: later data do not increase it, and the few surviving ancestors would
make it far too small. The first particle is not sampled: it stays at its optimum.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from pydantic import PrivateAttr

from impslam.building.landmarks import landmarks_of
from impslam.component import parameter, register
from impslam.estimators.base import MIN_SIGMA, Draft, Estimator, is_finite, with_motion
from impslam.estimators.grid_kernels import ancestors, lineage, propose
from impslam.estimators.keyframe_log import KeyframeLog
from impslam.estimators.particle_kernels import axes, systematic
from impslam.estimators.sampling import moved, normalised
from impslam.estimators.shared_maps import SharedMaps
from impslam.geometry.angles import wrap
from impslam.geometry.roots import root
from impslam.geometry.se2 import compose
from impslam.growing_array import GrowingArray
from impslam.landmarks.base import LandmarkModel
from impslam.map import Keyframe, Revision
from impslam.surfaces.surface_map import Alignment
from impslam.tracking.base import KeyframeGate
from impslam.types import Array, Ints, Landmark, Observation

MIN_LEAD = 2.0
"""Log weight by which another lineage has to lead to be reported, which avoids frequent changes."""
ITERATIONS = 12  # linearisations of a particle's pose


@register("grid_particles")
class GridParticles(Estimator):
    """Particles of the path, each with its own map of surfaces (Grisetti et al. 2007)."""

    keyframes: ClassVar[KeyframeGate] = KeyframeGate(distance=0.4, angle=0.4, seconds=math.inf)

    particles: int = parameter(30, "1", "number of particles", ge=1)
    resample_below: float = parameter(
        0.5, "1", "share of effective particles below which they are resampled", gt=0, le=1
    )
    insertion_distance: float = parameter(
        12.0,
        "m",
        "distance after which a scan enters the particles' maps: the tracker has already aligned later "
        "scans with it; 0 with a tracker that does not match scans",
        ge=0,
    )
    wide: float = parameter(
        0.4, "m", "initial scale of the robust kernel: possible error of a particle", gt=0
    )
    narrow: float = parameter(0.08, "m", "final scale: three times the noise of a point", gt=0)
    sigma: float = parameter(
        0.03, "m", "standard deviation of a point and of the surface that it is on", gt=0
    )
    correlated_points: float = parameter(
        40.0, "1", "number of points of a scan with a common error", ge=1
    )
    dof: float = parameter(
        4.0,
        "1",
        "degrees of freedom of the motion (Student's t); inf: Gaussian",
        gt=0,
        special="inf",
    )
    seed: int = parameter(0, "1", "seed of the sampling", ge=0)
    _models: Mapping[str, LandmarkModel] = PrivateAttr()
    _rng: np.random.Generator = PrivateAttr()
    _keys: KeyframeLog = PrivateAttr()
    _maps: SharedMaps = PrivateAttr()
    _poses: Array = PrivateAttr()
    """(P, 3) current poses; `_drawn` has those at each keyframe before resampling."""
    _drawn: GrowingArray = PrivateAttr()
    _parents: GrowingArray = PrivateAttr()
    _rows: Ints = PrivateAttr()
    """(P,) rows of the parents at the newest keyframe."""
    _log_weights: Array = PrivateAttr()
    _scores: Array = PrivateAttr()
    """(P,) log weights over the whole drive."""
    _covariances: GrowingArray = PrivateAttr()
    _leader: int = PrivateAttr(0)
    _lineage: Ints = PrivateAttr()
    _entered: int = PrivateAttr(0)
    _resamplings: int = PrivateAttr(0)

    def start(self, pose: Array, **parts: Any) -> None:
        """Begin at a pose (3,) with an empty map; see `Estimator.start`."""
        P = self.particles
        self._models, self._rng = parts["models"], np.random.default_rng(self.seed)
        self._keys, self._maps = KeyframeLog(), SharedMaps(P)
        self._poses = np.tile(np.asarray(pose, np.float64), (P, 1))
        self._drawn, self._covariances = GrowingArray(P, 3), GrowingArray(3, 3)
        self._parents, self._rows = GrowingArray(P, dtype=np.int64), np.arange(P)
        self._log_weights, self._scores = np.zeros(P), np.zeros(P)
        self._leader = 0
        self._lineage = np.empty(0, np.int64)
        self._entered = 0
        self._resamplings = 0

    def add(self, keyframe: Keyframe) -> Revision:
        """Process a keyframe; see `Estimator.add`."""
        used, refused = _usable(keyframe)
        guesses = compose(self._poses, used.motion.d_pose)
        roots = axes(self._poses, root(used.motion.covariance))
        self._keys.add(used, None if len(self._keys) else self._poses[0])
        view = self._keys.views[-1]
        if view is None or not len(view.features):
            u, L = np.zeros((self.particles, 3)), np.tile(np.eye(3), (self.particles, 1, 1))
        else:
            maps, how = self._maps, self._alignment()
            tables = maps.maps, maps.tables, maps.origin
            u, L, cost = propose(maps.tiles, tables, view.features, guesses, roots, how)
            self._add_cost(cost + np.linalg.slogdet(L)[1])
        u[1:] += np.linalg.solve(
            np.linalg.cholesky(L).swapaxes(1, 2), self._rng.standard_normal((self.particles, 3, 1))
        )[1:, :, 0]
        self._poses = moved(guesses, roots, u)
        self._drawn.append(self._poses)
        self._parents.append(self._rows)
        self._rows = np.arange(self.particles)
        revision = self._revision(keyframe, refused)
        self._resample_if_needed()
        self._enter_scans()
        return revision

    def _alignment(self) -> Alignment:
        information = 1.0 / (self.sigma**2 * self.correlated_points)
        return Alignment(ITERATIONS, self.wide, self.narrow, information, 1, self.dof)

    def _add_cost(self, cost: Array) -> None:
        """Update the log weights by -2 log likelihood (P,)."""
        self._log_weights -= 0.5 * cost
        self._scores -= 0.5 * cost
        self._scores -= self._scores.max()

    def _weights(self) -> Array:
        """Return the weights (P,), whose sum is 1."""
        return normalised(self._log_weights)

    def _revision(self, keyframe: Keyframe, refused: str) -> Revision:
        """Return the newest pose of the leading lineage, and earlier poses that differ if it changed."""
        if self._scores.max() > self._scores[self._leader] + MIN_LEAD:
            self._leader = int(self._scores.argmax())
        pose, weights = self._poses[self._leader], self._weights()
        offsets = self._poses - pose
        offsets[:, 2] = wrap(offsets[:, 2])
        self._covariances.append(
            (weights[:, None] * offsets).T @ offsets + MIN_SIGMA**2 * np.eye(3)
        )
        line = lineage(self._parents.array, self._leader)
        is_same = np.append(line[:-1] == self._lineage, False)
        self._lineage, first = line, keyframe.id + 1 - len(line)
        rows = np.flatnonzero(~is_same)
        poses = self._drawn.array[rows, line[rows]]
        return Revision(rows + first, poses, self._covariances.array[rows], refused=refused)

    def _resample_if_needed(self) -> None:
        """Resample the particles if too few are effective."""
        weights = self._weights()
        if 1.0 / (weights @ weights) >= self.resample_below * self.particles:
            return
        parents = systematic(weights, self._rng.random())
        self._rows, self._poses = parents, self._poses[parents]
        self._scores, self._log_weights = self._scores[parents], np.zeros(self.particles)
        self._maps.resample(parents)
        heirs = np.flatnonzero(parents == self._leader)
        self._leader = int(heirs[0] if len(heirs) else self._scores.argmax())
        self._resamplings += 1

    def _enter_scans(self) -> None:
        """Enter scans into the maps that are far enough behind the robot; see `insertion_distance`."""
        keys, newest = self._keys, len(self._keys) - 1
        while (
            self._entered <= newest
            and keys.distance[newest] - keys.distance[self._entered] >= self.insertion_distance
        ):
            k, view = self._entered, keys.views[self._entered]
            self._entered += 1
            if view is None or not len(view.features):
                continue
            lines = ancestors(self._parents.array, self._rows, newest - k)
            self._maps.add(view.features, self._drawn.array[k, lines], lines)

    def _path(self) -> Array:
        """Return the poses (k, 3) of all keyframes of the leading lineage."""
        return np.asarray(self._drawn.array[np.arange(len(self._lineage)), self._lineage])

    def landmarks(self) -> tuple[Landmark, ...]:
        """Return the landmarks from the path of the leading lineage."""
        return self.draft().landmarks()

    def draft(self) -> Draft:
        """Return a snapshot of the estimate; see `Estimator.draft`."""
        if not len(self._keys):
            return Draft(lambda: None, tuple)
        poses, covariances, keys = self._path(), self._covariances.array, self._keys.copy()

        def landmarks() -> tuple[Landmark, ...]:
            scans = keys.placed_scans(poses)
            return landmarks_of(poses, covariances, keys.sightings, self._models, scans)

        return Draft(lambda: None, landmarks)

    def observations(self) -> tuple[tuple[Observation, ...], ...]:
        """Return the observations of each keyframe; see `Estimator.observations`."""
        return self._keys.sightings.by_keyframe()

    def counts(self) -> Mapping[str, int]:
        """Return the numbers of resamplings, of remaining lineages, and of tiles of the maps."""
        lines = ancestors(self._parents.array, self._rows, len(self._keys)) if self._entered else ()
        return {
            "resamplings": self._resamplings,
            "tiles of surfaces": self._maps.used,
            "particle lineages at the start": len(np.unique(lines)),
        }

    @property
    def state_size(self) -> int:
        """Number of scalars in one particle's path."""
        return 3 * len(self._keys)


def _usable(keyframe: Keyframe) -> tuple[Keyframe, str]:
    """Return the usable part of a keyframe, and what is wrong with the rest, or "".

    The motion of a lost robot is a guess of unknown covariance: all particles use it without noise.
    """
    motion = keyframe.motion
    if keyframe.lost or not is_finite(motion):
        d_pose = np.where(np.isfinite(motion.d_pose).all(), motion.d_pose, 0.0)
        motion = replace(motion, d_pose=d_pose, covariance=np.zeros((3, 3)))
    return with_motion(keyframe, motion)
