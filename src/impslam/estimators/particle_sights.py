"""What a scan shows to all particles at once: which landmarks are near, and which pairs are likely."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from impslam.association.base import Association, Hypotheses
from impslam.errors import NumericalError
from impslam.estimators.particle_book import Book
from impslam.estimators.particle_kernels import judge
from impslam.landmarks.base import Prediction
from impslam.types import Array, Ints, Mask, Match, Observation

REACH = 1.0
"""m: two pieces that are one wall may be a door apart."""
SIGMAS = 5.0
"""Standard deviations, beyond any gate, of how far a landmark may be from where it is thought to be."""
_BASE = np.zeros(3)


class Cloud(NamedTuple):
    """Where the robot may be: poses (P, 3) and roots (P, 3, 3) of what they are unsure by.

    `best` is the likeliest particle's number.
    """

    poses: Array
    roots: Array
    best: int

    def spread(self) -> tuple[float, float]:
        """Return how far particles are from the best one and unsure, rms: m and rad."""
        off = self.poses - self.poses[self.best]
        off[:, 2] = np.sin(off[:, 2])
        squares = off**2 + (self.roots**2).sum(2)
        x, y, theta = squares.mean(0).tolist()
        return float(np.sqrt(x + y)), float(np.sqrt(theta))


class Sight(NamedTuple):
    """The observations of a kind: `indices` (a,) into the scan, z (a, dz), R (a, dz, dz) and ends."""

    book: Book
    indices: Ints
    z: Array
    R: Array
    ends: Array  # (a, 2, 2) m in base_link, where pieces of walls begin and end

    @classmethod
    def of(cls, book: Book, observations: Sequence[Observation], indices: list[int]) -> Sight:
        """Return this of some observations.

        Raises
        ------
        NumericalError
            If an R is not positive definite.
        """
        some = [observations[i] for i in indices]
        z, R = np.array([o.z for o in some], np.float64), np.array([o.R for o in some], np.float64)
        try:
            np.linalg.cholesky(R)
        except np.linalg.LinAlgError:
            raise NumericalError(
                f"the covariance of a {book.kind} is not positive definite: check the sensor's noise"
            ) from None
        model = book.model
        feet = model.outline(model.invert(_BASE, z), np.zeros((len(z), 2)))
        ends = [
            foot if o.end_points is None else o.end_points
            for o, foot in zip(some, feet, strict=True)
        ]
        return cls(book, np.array(indices), z, R, np.array(ends, np.float64))


class Pairs(NamedTuple):
    """n matches of one kind: particle, row of the observation in its sight, slot in its book."""

    sight: Sight
    particles: Ints
    rows: Ints
    slots: Ints

    def predict(self, poses: Array) -> Prediction:
        """Return how each landmark is seen from its particle's pose; (n, ...) each."""
        book = self.sight.book
        m = book.m[book.rows[self.particles, self.slots]]
        found = book.model.predict(poses[self.particles], m[:, None])
        return Prediction(found.z[:, 0], found.z_D_pose[:, 0], found.z_D_m[:, 0])


def sights(observations: Sequence[Observation], books: Mapping[str, Book]) -> list[Sight]:
    """Return the observations by kind."""
    kinds: dict[str, list[int]] = {}
    for i, observation in enumerate(observations):
        kinds.setdefault(observation.kind, []).append(i)
    return [Sight.of(books[kind], observations, indices) for kind, indices in kinds.items()]


class Choice(NamedTuple):
    """What all particles take the observations for.

    Attributes
    ----------
    pairs : matches by kind
    matched, new : (P, a) which observations are matched, and which may begin a landmark
    best : matches of the likeliest particle, by the ids of landmarks
    """

    pairs: list[Pairs]
    matched: Mask
    new: Mask
    best: tuple[Match, ...]


def associate(
    observations: tuple[Observation, ...],
    seen: Sequence[Sight],
    cloud: Cloud,
    association: Association,
) -> Choice:
    """Associate for every particle.

    One call for all: to the association, each particle's landmarks and observations are others.
    """
    count, asked = len(cloud.poses), len(observations)
    stride = 1 + max((len(sight.book.ids) for sight in seen), default=0)
    hypotheses = [
        _hypotheses(sight, cloud, asked, stride, association.max_distance2(sight.book.model.dim_z))
        for sight in seen
        if len(sight.book.ids)
    ]
    chosen = association.assign(observations * count, hypotheses, _joint)
    new, matched = np.zeros(count * asked, np.bool_), np.zeros(count * asked, np.bool_)
    new[list(chosen.new)] = True
    table = np.array([(m.observation, m.landmark) for m in chosen.matches], np.int64).reshape(-1, 2)
    matched[table[:, 0]] = True
    particles, which = np.divmod(table[:, 0], max(asked, 1))
    pairs, best = [], list[Match]()
    for sight in seen:
        row_of = np.full(asked, -1)
        row_of[sight.indices] = np.arange(len(sight.indices))
        (mine,) = np.nonzero(row_of[which] >= 0)
        if len(mine):
            slots = table[mine, 1] % stride
            pairs.append(Pairs(sight, particles[mine], row_of[which[mine]], slots))
            for n in np.flatnonzero(particles[mine] == cloud.best).tolist():
                number, match = int(sight.book.ids[slots[n]]), chosen.matches[mine[n]]
                best.append(match._replace(observation=int(which[mine[n]]), landmark=number))
    best.sort(key=attrgetter("observation"))
    shape = count, asked
    return Choice(pairs, matched.reshape(shape), new.reshape(shape), tuple(best))


def _joint(*_: object) -> tuple[Array, Array]:
    raise NotImplementedError("particles judge pairings one by one")


def _hypotheses(sight: Sight, cloud: Cloud, asked: int, stride: int, gate: float) -> Hypotheses:
    """Return the pairings in a gate of all particles."""
    book, model, count = sight.book, sight.book.model, len(cloud.poses)
    near = _near(sight, cloud) if np.isfinite(gate) else np.arange(len(book.ids))
    rows = np.ascontiguousarray(book.rows[:, near])
    predicted = model.predict(cloud.poses, book.m[rows])
    angles = np.zeros(model.dim_z, np.bool_)
    angles[list(model.z_angles)] = True
    pairs, *scored = judge(
        (predicted.z, predicted.z_D_pose, predicted.z_D_m),
        (rows, book.P, cloud.roots),
        (sight.z, sight.R),
        _possible(sight, cloud, near),
        angles,
        gate,
    )
    (p, a, k), (innovation, S, distance2, log_det) = pairs.T, scored

    def apart(from_robot: bool) -> tuple[Array, Array]:
        z, poses = sight.z[a][:, None], cloud.poses[p]
        if from_robot:
            known = model.invert(_BASE, predicted.z[p, k])
            return model.distance(known, model.invert(_BASE, z[:, 0]))
        return model.distance(book.m[rows[p, k]], model.invert(poses, z)[:, 0])

    slots = near[k]
    every = np.arange(count)[:, None] * asked + sight.indices
    return Hypotheses(
        book.kind,
        every.ravel(),
        p * asked + sight.indices[a],
        p * stride + slots,
        book.labels[slots],
        innovation,
        S,
        distance2,
        log_det,
        apart,
        np.ones(len(pairs), np.bool_),
    )


def _near(sight: Sight, cloud: Cloud) -> Ints:
    """Return the landmarks (k,) that any particle may see among the observations."""
    book, pose = sight.book, cloud.poses[cloud.best]
    rows = book.rows[cloud.best]
    ends = book.model.outline(book.m[rows], book.extents) - pose[:2]
    along = ends[:, 1] - ends[:, 0]
    length2 = np.maximum((along**2).sum(1), 1e-12)
    share = np.clip(-(ends[:, 0] * along).sum(1) / length2, 0.0, 1.0)
    distance = np.hypot(*(ends[:, 0] + share[:, None] * along).T)
    seen = float(np.hypot(sight.ends[..., 0], sight.ends[..., 1]).max())
    place, turn = cloud.spread()
    unsure = place + turn * seen + np.sqrt(np.trace(book.P[rows], axis1=1, axis2=2))
    return np.flatnonzero((distance < seen + REACH + SIGMAS * unsure) | (rows < 0))


def _possible(sight: Sight, cloud: Cloud, near: Ints) -> Mask:
    """Tell which pairs (a, k) extents allow to the likeliest particle, within two standard deviations."""
    book, model, asked = sight.book, sight.book.model, len(sight.z)
    out = np.ones((asked, len(near)), np.bool_)
    rows = book.rows[cloud.best, near]
    known = np.flatnonzero(rows >= 0)
    if not model.has_extent or not len(known):
        return out
    pose, root = cloud.poses[cloud.best], cloud.roots[cloud.best]
    a, k = (index.ravel() for index in np.meshgrid(np.arange(asked), known, indexing="ij"))
    m, P = book.m[rows[k]], book.P[rows[k]]
    overlap = model.overlap(pose, m, book.extents[near[k]], model.extents(pose, m, sight.ends[a]))
    variance = ((overlap.gap_D_pose @ root) ** 2).sum(1)
    variance += np.einsum("pi,pij,pj->p", overlap.gap_D_m, P, overlap.gap_D_m)
    out[a, k] = overlap.gap <= overlap.allowed + 2.0 * np.sqrt(np.maximum(variance, 0.0))
    return out
