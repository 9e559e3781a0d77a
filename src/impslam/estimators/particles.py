"""FastSLAM: particles of the robot's path, each with its own landmarks and its own association.

Given the path, landmarks are independent of each other: a particle is a path and a small filter for each
landmark (Montemerlo, Thrun, Koller & Wegbreit 2002). A scan costs what is seen in it, times the
particles, whatever the size of the map, and a false match costs the particles that made it.

FastSLAM 1 draws the pose from the motion. FastSLAM 2 (Montemerlo et al. 2003) draws from the motion and
what is seen: with a pose x^ (+) V u, u of unit covariance, and an innovation nu of H_x u and noise
Z = H_m P_m H_m^T + R for each match,

    L = I + sum H_x^T Z^-1 H_x,    b = sum H_x^T Z^-1 nu,    u ~ N(L^-1 b, L^-1),
    -2 log w = sum (nu^T Z^-1 nu + log |2 pi Z|) - b^T L^-1 b + log |L|,

which needs no inverse of the motion's covariance: a robot may stand. An observation that a particle takes
for nothing it knows weighs as one at the gate. Landmarks are then corrected at the pose drawn. Particles
are drawn anew, systematically, when their effective number falls below a share of them.

What is kept forgets: a particle's past is that of few ancestors, so covariances come out too small after
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
from impslam.estimators.base import START_SIGMA, Estimator, check_keyframe, is_known
from impslam.estimators.blur import blurred
from impslam.estimators.particle_book import Book
from impslam.estimators.particle_kernels import axes, correct, inform, systematic
from impslam.estimators.particle_sights import Cloud, Pairs, associate, sights
from impslam.estimators.sampling import moved, normalised
from impslam.filters.base import Filter
from impslam.geometry.angles import wrap
from impslam.geometry.roots import root
from impslam.geometry.se2 import compose
from impslam.landmarks.base import LandmarkModel
from impslam.lifecycle.base import Lifecycle
from impslam.map import Keyframe, Map, Revision
from impslam.types import Array, Increment, Ints, Landmark, Match, Observation

OUTSIDE = 13.8
"""Squared Mahalanobis distance, 99.9 % of two dimensions: what matches nothing weighs as if so far off."""
MOST = 0.5
"""Weight of the particles that know a landmark of the map."""


@register("particles")
class Particles(Estimator):
    """FastSLAM 1 and 2: each particle a path and landmarks of its own (Montemerlo et al. 2002, 2003)."""

    parts: ClassVar[tuple[str, ...]] = ("filter", "association", "lifecycle")

    particles: int = parameter(100, "1", "number of particles", ge=1)
    version: int = parameter(
        2, "1", "1: poses are drawn from the motion alone; 2: from what is seen, too", ge=1, le=2
    )
    effective: float = parameter(
        0.5, "1", "share of the particles; fewer effective ones are drawn anew", gt=0, le=1
    )
    seed: int = parameter(0, "1", "of the random draws", ge=0)
    _association: Association = PrivateAttr()
    _lifecycle: Lifecycle = PrivateAttr()
    _models: Mapping[str, LandmarkModel] = PrivateAttr()
    _rng: np.random.Generator = PrivateAttr()
    _poses: Array = PrivateAttr()
    _log_weights: Array = PrivateAttr()
    _books: dict[str, Book] = PrivateAttr()
    _told: set[int] = PrivateAttr()
    _next_id: int = PrivateAttr(default=0)

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
        asked: Association = parts["association"]
        self._association, self._lifecycle = asked.for_known_pose(), parts["lifecycle"]
        if self._association.is_joint:
            raise ConfigError(
                f"estimator 'particles' cannot ask association {self._association.name!r}, which judges a "
                "scan as a whole; choose another one with --set association.kind=mahalanobis"
            )
        tentative: Filter = parts["filter"]
        self._models, self._rng = parts["models"], np.random.default_rng(self.seed)
        self._poses = np.tile(np.asarray(pose, np.float64), (self.particles, 1))
        self._log_weights = np.zeros(self.particles)
        self._books, self._told, self._next_id = {}, set(), 0
        self._lifecycle.start(self._models, asked, tentative.fresh())

    def add(self, keyframe: Keyframe) -> Revision:
        """Take in a keyframe; see `Estimator.add`."""
        drawn = self._rng.bit_generator.state
        try:
            check_keyframe(keyframe)
            return self._add(
                keyframe, blurred(keyframe.observations, keyframe.motion, self._models)
            )
        except NumericalError as error:
            self._rng.bit_generator.state = drawn
            why = f"the scan at {keyframe.stamp:.3f} s is not used for the map: {error}"
        if is_known(keyframe.motion):
            self._poses, _ = self._draw((), self._ahead(keyframe.motion))
            self._lifecycle.move(keyframe.motion)
        return self._revision(keyframe, refused=why)

    def _add(self, keyframe: Keyframe, seen: tuple[Observation, ...]) -> Revision:
        kinds = sights(seen, {o.kind: self._book(o.kind) for o in seen})
        cloud = self._ahead(keyframe.motion)
        choice = associate(seen, kinds, cloud, self._association)
        poses, cost = self._draw(choice.pairs, cloud)

        self._poses = poses
        self._log_weights -= 0.5 * (cost + ~choice.matched @ _outside(seen))
        self._lifecycle.move(keyframe.motion)
        for pairs in choice.pairs:
            self._correct(pairs)
        weights = self._weights()
        shown = self._note(seen, choice.best, keyframe.stamp)
        for i in self._promote(seen, weights @ choice.new, keyframe.motion.stamp):
            holders = np.flatnonzero(~choice.matched[:, i])
            shown[self._enter(seen[i], holders, keyframe.stamp)] = i

        shares = self._shares(weights)
        gone = [number for number in self._told if shares[number] <= MOST]
        gone += self._through(keyframe, weights, choice.best)
        born = [i for i in shown if i not in self._told and i not in gone and shares[i] > MOST]
        matches = tuple(match for match in choice.best if match.landmark in self._told)
        revision = self._revision(
            keyframe,
            matches=matches,
            born=tuple(born),
            origins=tuple(shown[number] for number in born),
            gone=tuple(gone),
        )
        self._told = (self._told | set(born)) - set(gone)
        self._survive(weights, set(gone))
        return revision

    def _ahead(self, motion: Increment) -> Cloud:
        """Return where particles get to by a motion, drawn (version 1) or with what it is unsure by."""
        poses, roots = (
            compose(self._poses, motion.d_pose),
            axes(self._poses, root(motion.covariance)),
        )
        if self.version == 1:
            poses, roots = moved(poses, roots, self._normals()), np.zeros_like(roots)
        return Cloud(poses, roots, int(np.argmax(self._log_weights)))

    def _draw(self, pairs: Sequence[Pairs], cloud: Cloud) -> tuple[Array, Array]:
        """Return poses (P, 3) drawn by motion and matches, and -2 log likelihood (P,) of the matches.

        Raises
        ------
        NumericalError
            If the covariance of an innovation is not positive definite.
        """
        information, vector = (
            np.tile(np.eye(3), (self.particles, 1, 1)),
            np.zeros((self.particles, 3)),
        )
        cost = np.zeros(self.particles)
        for some in pairs:
            found, (book, _, z, R, _) = some.predict(cloud.poses), some.sight
            nu = book.model.residual(z[some.rows], found.z)
            P = book.P[book.rows[some.particles, some.slots]]
            slopes, out = (found.z_D_pose, found.z_D_m), (information, vector, cost)
            if not inform(some.particles, cloud.roots, (nu, R[some.rows]), slopes, P, out):
                raise NumericalError("the covariance of an innovation is not positive definite")
        L = np.linalg.cholesky(information)
        y = np.linalg.solve(L, vector[..., None])
        u = np.linalg.solve(L.swapaxes(1, 2), y + self._normals()[..., None])[..., 0]
        cost += 2.0 * np.log(np.einsum("pii->pi", L)).sum(1) - (y[..., 0] ** 2).sum(1)
        return moved(cloud.poses, cloud.roots, u), cost

    def _correct(self, pairs: Pairs) -> None:
        """Correct the landmarks that particles have matched, from the poses drawn."""
        found, (book, _, z, R, _) = pairs.predict(self._poses), pairs.sight
        nu = book.model.residual(z[pairs.rows], found.z)
        rows = book.own(pairs.particles, pairs.slots)
        P = book.P[rows]
        steps = correct(nu, R[pairs.rows], found.z_D_m, P)
        book.m[rows], book.P[rows] = book.model.retract(book.m[rows], steps), P

    def _note(
        self, seen: Sequence[Observation], matches: Sequence[Match], stamp: float
    ) -> dict[int, int]:
        """Keep the books of what the likeliest particle has matched; return which shows which."""
        for match in matches:
            observation = seen[match.observation]
            book, slot = self._place(match.landmark)
            book.note(slot, stamp, observation.attributes)
            self._widen(book, slot, observation)
        return {match.landmark: match.observation for match in matches}

    def _widen(self, book: Book, slot: int, observation: Observation) -> None:
        """Take in where a landmark has been seen, as a particle that knows it has it."""
        if not book.model.has_extent or observation.end_points is None:
            return
        (p,) = np.flatnonzero(book.rows[:, slot] >= 0)[:1]
        m, extent = book.m[book.rows[p, slot]], book.extents[slot]
        begin, end = book.model.extents(self._poses[p], m[None], observation.end_points[None])[0]
        extent[:] = min(extent[0], begin), max(extent[1], end)

    def _promote(self, seen: Sequence[Observation], share: Array, now: float) -> list[int]:
        """Return which observations, new to most, become landmarks."""
        unmatched = np.flatnonzero(share > MOST).tolist()
        alone = not any(len(book.ids) for book in self._books.values())
        promoted = self._lifecycle.promote([seen[i] for i in unmatched], now, alone)
        return [unmatched[k] for k in promoted]

    def _enter(self, observation: Observation, holders: Ints, stamp: float) -> int:
        """Add a landmark to some particles (h,); return its id."""
        book, number = self._book(observation.kind), self._next_id
        self._next_id += 1
        new = [book.model.initialise(pose, observation) for pose in self._poses[holders]]
        P = [i.m_D_z @ observation.R @ i.m_D_z.T + i.slack for i in new]
        label = -1 if observation.label is None else observation.label
        book.add(number, label, stamp, holders, np.array([i.m for i in new]), np.array(P))
        book.attributes[number] = dict(observation.attributes)
        self._widen(book, len(book.ids) - 1, observation)
        return number

    def _through(self, keyframe: Keyframe, weights: Array, matches: Sequence[Match]) -> list[int]:
        """Return the landmarks that should be seen from the likeliest pose, and are not."""
        best = int(np.argmax(weights))
        ids, outlines = [], []
        for book in self._books.values():
            (slots,) = np.nonzero((book.rows[best] >= 0) & np.isin(book.ids, list(self._told)))
            ids.append(book.ids[slots])
            outlines.append(book.model.outline(book.m[book.rows[best, slots]], book.extents[slots]))
        if keyframe.scan is None or not sum(map(len, ids)):
            return []
        known, ends = np.concatenate(ids), np.concatenate(outlines)
        return self._lifecycle.review(keyframe.scan, self._poses[best], known, ends, matches)

    def _survive(self, weights: Array, gone: set[int]) -> None:
        """Draw particles anew if few count; forget what is gone, and what none knows any more."""
        if 1.0 / (weights @ weights) < self.effective * self.particles:
            parents = systematic(weights, self._rng.random())
            self._poses, self._log_weights = self._poses[parents], np.zeros(self.particles)
            for book in self._books.values():
                book.survive(parents)
        for book in self._books.values():
            dead = (book.rows < 0).all(0) | np.isin(book.ids, list(gone))
            if dead.any():
                book.forget(dead)

    def _revision(self, keyframe: Keyframe, **facts: Any) -> Revision:
        """Return the mean and the covariance of the particles' poses."""
        weights = self._weights()
        middle = self._poses[np.argmax(weights)]
        off = self._poses - middle
        off[:, 2] = wrap(off[:, 2])
        mean = weights @ off
        pose, off = middle + mean, off - mean
        pose[2] = wrap(float(pose[2]))
        covariance = (weights[:, None] * off).T @ off + START_SIGMA**2 * np.eye(3)
        return Revision(np.array([keyframe.id]), pose[None], covariance[None], **facts)

    def landmarks(self) -> tuple[Landmark, ...]:
        """Return the landmarks that most particles know, in the form users read."""
        weights = self._weights()
        return tuple(
            book.landmark(slot, weights) for book, slot in map(self._place, sorted(self._told))
        )

    @property
    def state_size(self) -> int:
        """Number of scalars in one particle."""
        return 3 + sum(self._place(number)[0].model.dim for number in self._told)

    def _book(self, kind: str) -> Book:
        if kind not in self._books:
            if kind not in self._models:
                raise ConfigError(
                    f"no landmark model for observations of kind {kind!r}; register one"
                )
            self._books[kind] = Book(kind, self._models[kind], self.particles)
        return self._books[kind]

    def _place(self, number: int) -> tuple[Book, int]:
        """Return the book of a landmark, and its slot there; ids ascend."""
        for book in self._books.values():
            slot = int(np.searchsorted(book.ids, number))
            if slot < len(book.ids) and book.ids[slot] == number:
                return book, slot
        raise KeyError(number)

    def _shares(self, weights: Array) -> dict[int, float]:
        """Return the weight of the particles that know each landmark."""
        shares: dict[int, float] = {}
        for book in self._books.values():
            shares.update(zip(book.ids.tolist(), book.shares(weights).tolist(), strict=True))
        return shares

    def _weights(self) -> Array:
        """Return the weights (P,), whose sum is 1."""
        return normalised(self._log_weights)

    def _normals(self) -> Array:
        return self._rng.standard_normal((self.particles, 3))


def _outside(seen: Sequence[Observation]) -> Array:
    """Return -2 log of what each observation (a,) weighs that matches nothing."""
    return np.array([OUTSIDE + np.linalg.slogdet(2.0 * math.pi * o.R)[1] for o in seen], np.float64)
