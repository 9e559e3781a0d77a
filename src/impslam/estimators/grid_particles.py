"""A grid particle filter (Grisetti, Stachniss & Burgard 2007), on maps of surfaces.

Given the path, the map is known: a particle is a path, and a map drawn on it. A loop closes by choice: the
particles whose drift was right find the walls where their map has them, and the others die out.

Each particle lays the scan on its own map. With the pose x^ (+) V u that the motion leads to, u of unit
covariance, the likeliest u^ of scan and motion and its information L by Gauss-Newton,

    u ~ N(u^, L^-1),    -2 log w = c^2 / (s^2 n) sum(1 - share_i) + v log(1 + |u^|^2 / v) + log |L|:

the improved proposal, whose normaliser is taken from its optimum rather than summed over samples (there
Eq. 11 to 16). A point's share is 1 on a surface and falls to 0 by c (Geman-McClure): one that finds
none weighs as one far off. Points share errors: n of them count as one. What a loop leaves
of drift has heavier tails than a step's motion, hence Student's t with v degrees of freedom.

The tracker has already laid the scan on what was seen in the last metres. That counts once: a scan
enters the particles' maps when the robot has left it behind, by the particles' own poses of then. So one
map serves all particles of the same line, and particles that are drawn anew copy nothing.

The path reported is that of the likeliest line of particles; the covariance of a keyframe is the mean
square of all of them about it when it was new. What comes later makes it no larger; particles that are
left of it make it look far too small. The first particle is not drawn: it stays at its optimum.
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
from impslam.errors import NumericalError
from impslam.estimators.base import START_SIGMA, Draft, Estimator, check_keyframe, is_known
from impslam.estimators.grid_kernels import ancestors, lineage, propose
from impslam.estimators.keyframe_log import KeyframeLog
from impslam.estimators.particle_kernels import axes, systematic
from impslam.estimators.sampling import moved, normalised
from impslam.estimators.surface_book import SurfaceBook
from impslam.geometry.angles import wrap
from impslam.geometry.roots import root
from impslam.geometry.se2 import compose
from impslam.growing import GrowingArray
from impslam.landmarks.base import LandmarkModel
from impslam.map import Keyframe, Map, Revision
from impslam.surfaces.surface_map import Alignment
from impslam.tracking.base import KeyframeGate
from impslam.types import Array, Ints, Landmark, Observation

LEAD = 2.0
"""By so much, in log weight, another line has to lead before its path is reported: not at each draw."""
ITERATIONS = 12  # linearisations of a particle's pose


@register("grid_particles")
class GridParticles(Estimator):
    """Particles of the path, each with a map of surfaces of its own (Grisetti et al. 2007)."""

    tells_landmarks: ClassVar[bool] = False
    keyframes: ClassVar[KeyframeGate] = KeyframeGate(distance=0.4, angle=0.4, seconds=math.inf)

    particles: int = parameter(30, "1", "number of particles", ge=1)
    effective: float = parameter(
        0.5, "1", "share of the particles; fewer effective ones are drawn anew", gt=0, le=1
    )
    recent: float = parameter(
        12.0,
        "m",
        "way after which a scan enters the particles' maps: the tracker has laid later ones on it "
        "already; 0 with a tracker that does not match scans",
        ge=0,
    )
    wide: float = parameter(
        0.4, "m", "scale of the robust kernel at first: how far a particle may be off", gt=0
    )
    narrow: float = parameter(0.08, "m", "and in the end: three times a point's noise", gt=0)
    sigma: float = parameter(
        0.03, "m", "standard deviation of a point, and of the surface it is on", gt=0
    )
    shared: float = parameter(40.0, "1", "points of a scan that share one error", ge=1)
    tails: float = parameter(
        4.0,
        "1",
        "degrees of freedom of the motion (heavy tails); inf: Gaussian",
        gt=0,
        special="inf",
    )
    seed: int = parameter(0, "1", "of the random draws", ge=0)
    _models: Mapping[str, LandmarkModel] = PrivateAttr()
    _rng: np.random.Generator = PrivateAttr()
    _keys: KeyframeLog = PrivateAttr()
    _book: SurfaceBook = PrivateAttr()
    _poses: Array = PrivateAttr()
    """(P, 3) of the particles by now; in `_drawn` as they were at each keyframe, before drawn anew."""
    _drawn: GrowingArray = PrivateAttr()
    _parents: GrowingArray = PrivateAttr()
    _rows: Ints = PrivateAttr()
    """(P,) whose place each particle has taken at the newest keyframe."""
    _log_weights: Array = PrivateAttr()
    _scores: Array = PrivateAttr()
    """(P,) log weights over the whole drive."""
    _spreads: GrowingArray = PrivateAttr()
    _told: int = PrivateAttr(0)
    _line: Ints = PrivateAttr()
    _entered: int = PrivateAttr(0)
    _draws: int = PrivateAttr(0)

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
        P = self.particles
        self._models, self._rng = parts["models"], np.random.default_rng(self.seed)
        self._keys, self._book = KeyframeLog(), SurfaceBook(P)
        self._poses = np.tile(np.asarray(pose, np.float64), (P, 1))
        self._drawn, self._spreads = GrowingArray(P, 3), GrowingArray(3, 3)
        self._parents, self._rows = GrowingArray(P, dtype=np.int64), np.arange(P)
        self._log_weights, self._scores = np.zeros(P), np.zeros(P)
        self._told, self._line, self._entered, self._draws = 0, np.empty(0, np.int64), 0, 0

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
            book, how = self._book, self._alignment()
            maps = book.maps, book.tables, book.origin
            u, L, cost = propose(book.tiles, maps, view.features, guesses, roots, how)
            self._weigh(cost + np.linalg.slogdet(L)[1])
        u[1:] += np.linalg.solve(
            np.linalg.cholesky(L).swapaxes(1, 2), self._rng.standard_normal((self.particles, 3, 1))
        )[1:, :, 0]
        self._poses = moved(guesses, roots, u)
        self._drawn.append(self._poses)
        self._parents.append(self._rows)
        self._rows = np.arange(self.particles)
        revision = self._revision(keyframe, refused)
        self._survive()
        self._leave_behind()
        return revision

    def _alignment(self) -> Alignment:
        information = 1.0 / (self.sigma**2 * self.shared)
        return Alignment(ITERATIONS, self.wide, self.narrow, information, 1, self.tails)

    def _weigh(self, cost: Array) -> None:
        """Let particles count by -2 log of their likelihoods (P,)."""
        self._log_weights -= 0.5 * cost
        self._scores -= 0.5 * cost
        self._scores -= self._scores.max()

    def _weights(self) -> Array:
        """Return the weights (P,), whose sum is 1."""
        return normalised(self._log_weights)

    def _revision(self, keyframe: Keyframe, refused: str) -> Revision:
        """Return the newest pose of the line that leads, and earlier ones where another one leads now."""
        if self._scores.max() > self._scores[self._told] + LEAD:
            self._told = int(self._scores.argmax())
        pose, weights = self._poses[self._told], self._weights()
        off = self._poses - pose
        off[:, 2] = wrap(off[:, 2])
        self._spreads.append((weights[:, None] * off).T @ off + START_SIGMA**2 * np.eye(3))
        line = lineage(self._parents.array, self._told)
        same = np.append(line[:-1] == self._line, False)
        self._line, first = line, keyframe.id + 1 - len(line)
        rows = np.flatnonzero(~same)
        poses = self._drawn.array[rows, line[rows]]
        return Revision(rows + first, poses, self._spreads.array[rows], refused=refused)

    def _survive(self) -> None:
        """Draw particles anew if few count."""
        weights = self._weights()
        if 1.0 / (weights @ weights) >= self.effective * self.particles:
            return
        parents = systematic(weights, self._rng.random())
        self._rows, self._poses = parents, self._poses[parents]
        self._scores, self._log_weights = self._scores[parents], np.zeros(self.particles)
        self._book.survive(parents)
        heirs = np.flatnonzero(parents == self._told)
        self._told = int(heirs[0] if len(heirs) else self._scores.argmax())
        self._draws += 1

    def _leave_behind(self) -> None:
        """Enter the scans into the maps that are as far behind as the tracker looks."""
        keys, newest = self._keys, len(self._keys) - 1
        while self._entered <= newest and keys.way[newest] - keys.way[self._entered] >= self.recent:
            k, view = self._entered, keys.views[self._entered]
            self._entered += 1
            if view is None or not len(view.features):
                continue
            lines = ancestors(self._parents.array, self._rows, newest - k)
            self._book.add(view.features, self._drawn.array[k, lines], lines)

    def _path(self) -> Array:
        """Return the poses (k, 3) of all keyframes on the line that leads."""
        return np.asarray(self._drawn.array[np.arange(len(self._line)), self._line])

    def landmarks(self) -> tuple[Landmark, ...]:
        """Return the landmarks as the leading line has seen them."""
        return self.draft().landmarks()

    def draft(self) -> Draft:
        """Return the estimate as it is now; see `Estimator.draft`."""
        if not len(self._keys):
            return Draft(lambda: None, tuple)
        poses, spreads, keys = self._path(), self._spreads.array, self._keys.copy()

        def landmarks() -> tuple[Landmark, ...]:
            scans = keys.placed_scans(poses)
            return landmarks_of(poses, spreads, keys.seen, self._models, scans)

        return Draft(lambda: None, landmarks)

    def observations(self) -> tuple[tuple[Observation, ...], ...]:
        """Return what the keyframes saw; see `Estimator.observations`."""
        return self._keys.seen.by_keyframe()

    def counts(self) -> Mapping[str, int]:
        """Return how often particles were drawn anew, how many lines are left, and tiles of maps."""
        lines = ancestors(self._parents.array, self._rows, len(self._keys)) if self._entered else ()
        return {
            "times particles were drawn anew": self._draws,
            "tiles of surfaces": self._book.used,
            "lines of particles at the start": len(np.unique(lines)),
        }

    @property
    def state_size(self) -> int:
        """Number of scalars in one particle's path."""
        return 3 * len(self._keys)


def _usable(keyframe: Keyframe) -> tuple[Keyframe, str]:
    """Return what is usable of a keyframe, and what is wrong with the rest.

    Of a robot that is lost the motion is a guess, of which no covariance is known: all particles take it.
    """
    motion, wrong = keyframe.motion, ""
    try:
        check_keyframe(keyframe)
        if any(np.linalg.eigvalsh(o.R)[0] <= 0.0 for o in keyframe.observations):
            wrong = "an extractor's R is no covariance"
    except NumericalError as error:
        wrong = str(error)
    if keyframe.lost or not is_known(motion):
        d_pose = np.where(np.isfinite(motion.d_pose).all(), motion.d_pose, 0.0)
        motion = replace(motion, d_pose=d_pose, covariance=np.zeros((3, 3)))
    if not wrong:
        return replace(keyframe, motion=motion), ""
    why = f"the scan at {keyframe.stamp:.3f} s is not used for the map: {wrong}"
    return replace(keyframe, motion=motion, scan=None, observations=()), why
