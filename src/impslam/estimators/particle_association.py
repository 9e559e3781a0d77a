"""Data association of a scan for all particles at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from impslam.association.base import Association, Hypotheses
from impslam.estimators.particle_kernels import gated_pairs
from impslam.estimators.particle_landmarks import LandmarkTable
from impslam.landmarks.base import Prediction
from impslam.types import Array, Ints, Mask, Match, Observation

MAX_GAP, MAX_SIGMAS = 1.0, 5.0
"""m between two pieces of one wall: a door; and standard deviations by which a landmark may be misplaced,
beyond any gate."""
_BASE = np.zeros(3)


class ParticlePoses(NamedTuple):
    """The particles' poses (P, 3), and roots (P, 3, 3) of their covariances.

    `best` is the index of the likeliest particle.
    """

    poses: Array
    roots: Array
    best: int

    def spread(self) -> tuple[float, float]:
        """Return the rms deviation from the best particle, including its uncertainty: m and rad."""
        off = self.poses - self.poses[self.best]
        off[:, 2] = np.sin(off[:, 2])
        squares = off**2 + (self.roots**2).sum(2)
        x, y, theta = squares.mean(0).tolist()
        return float(np.sqrt(x + y)), float(np.sqrt(theta))


class KindObservations(NamedTuple):
    """The observations of one kind: `indices` (a,) in the scan, z (a, dz), R (a, dz, dz) and ends."""

    table: LandmarkTable
    indices: Ints
    z: Array
    R: Array
    ends: Array  # (a, 2, 2) m in base_link, end points of pieces of walls

    @classmethod
    def of(
        cls, table: LandmarkTable, observations: Sequence[Observation], indices: list[int]
    ) -> KindObservations:
        """Return the observations with these indices (a,), all of one kind."""
        some = [observations[i] for i in indices]
        z, R = np.array([o.z for o in some], np.float64), np.array([o.R for o in some], np.float64)
        model = table.model
        feet = model.outline(model.invert(_BASE, z), np.zeros((len(z), 2)))
        ends = [
            foot if o.end_points is None else o.end_points
            for o, foot in zip(some, feet, strict=True)
        ]
        return cls(table, np.array(indices), z, R, np.array(ends, np.float64))


class ParticleMatches(NamedTuple):
    """n matches of one kind: particle, row among the observations of the kind, slot in its table."""

    kind: KindObservations
    particles: Ints
    rows: Ints
    slots: Ints

    def predict(self, poses: Array) -> Prediction:
        """Return the predicted observation of each landmark from its particle's pose; (n, ...) each."""
        table = self.kind.table
        m = table.m[table.rows[self.particles, self.slots]]
        found = table.model.predict(poses[self.particles], m[:, None])
        return Prediction(found.z[:, 0], found.z_D_pose[:, 0], found.z_D_m[:, 0])


def by_kind(
    observations: Sequence[Observation], tables: Mapping[str, LandmarkTable]
) -> list[KindObservations]:
    """Return the observations by kind."""
    kinds: dict[str, list[int]] = {}
    for i, observation in enumerate(observations):
        kinds.setdefault(observation.kind, []).append(i)
    return [
        KindObservations.of(tables[kind], observations, indices) for kind, indices in kinds.items()
    ]


class ParticleAssociations(NamedTuple):
    """The associations of all particles.

    Attributes
    ----------
    pairs : matches by kind
    matched, new : (P, a) which observations are matched, and which may be new landmarks
    best : matches of the likeliest particle, by landmark id
    """

    pairs: list[ParticleMatches]
    matched: Mask
    new: Mask
    best: tuple[Match, ...]


def associate(
    observations: tuple[Observation, ...],
    seen: Sequence[KindObservations],
    cloud: ParticlePoses,
    association: Association,
) -> ParticleAssociations:
    """Associate the observations for every particle.

    This is one call of the association, with distinct ids for each particle's landmarks and observations.
    """
    count, observed = len(cloud.poses), len(observations)
    stride = 1 + max((len(kind.table.ids) for kind in seen), default=0)
    hypotheses = [
        _hypotheses(
            kind, cloud, observed, stride, association.max_distance2(kind.table.model.dim_z)
        )
        for kind in seen
        if len(kind.table.ids)
    ]
    chosen = association.assign(observations * count, hypotheses, _joint)
    new, matched = np.zeros(count * observed, np.bool_), np.zeros(count * observed, np.bool_)
    new[list(chosen.new)] = True
    table = np.array([(m.observation, m.landmark) for m in chosen.matches], np.int64).reshape(-1, 2)
    matched[table[:, 0]] = True
    particles, which = np.divmod(table[:, 0], max(observed, 1))
    pairs, best = [], list[Match]()
    for kind in seen:
        row_of = np.full(observed, -1)
        row_of[kind.indices] = np.arange(len(kind.indices))
        (mine,) = np.nonzero(row_of[which] >= 0)
        if len(mine):
            slots = table[mine, 1] % stride
            pairs.append(ParticleMatches(kind, particles[mine], row_of[which[mine]], slots))
            for n in np.flatnonzero(particles[mine] == cloud.best).tolist():
                number, match = int(kind.table.ids[slots[n]]), chosen.matches[mine[n]]
                best.append(match._replace(observation=int(which[mine[n]]), landmark=number))
    best.sort(key=attrgetter("observation"))
    shape = count, observed
    return ParticleAssociations(pairs, matched.reshape(shape), new.reshape(shape), tuple(best))


def _joint(*_: object) -> tuple[Array, Array]:
    raise NotImplementedError("particles evaluate pairings independently")


def _hypotheses(
    kind: KindObservations, cloud: ParticlePoses, observed: int, stride: int, gate: float
) -> Hypotheses:
    """Return the pairings of all particles inside the gate."""
    table, model = kind.table, kind.table.model
    near = _near(kind, cloud) if np.isfinite(gate) else np.arange(len(table.ids))
    rows = np.ascontiguousarray(table.rows[:, near])
    predicted = model.predict(cloud.poses, table.m[rows])
    angles = np.zeros(model.dim_z, np.bool_)
    angles[list(model.z_angles)] = True
    pairs, *scored = gated_pairs(
        (predicted.z, predicted.z_D_pose, predicted.z_D_m),
        (rows, table.P, cloud.roots),
        (kind.z, kind.R),
        _possible(kind, cloud, near),
        angles,
        gate,
    )
    (p, a, k), (innovation, S, distance2, log_det) = pairs.T, scored

    def apart(from_robot: bool) -> tuple[Array, Array]:
        z, poses = kind.z[a][:, None], cloud.poses[p]
        if from_robot:
            known = model.invert(_BASE, predicted.z[p, k])
            return model.distance(known, model.invert(_BASE, z[:, 0]))
        return model.distance(table.m[rows[p, k]], model.invert(poses, z)[:, 0])

    slots = near[k]
    return Hypotheses(
        table.kind,
        p * observed + kind.indices[a],
        p * stride + slots,
        table.labels[slots],
        innovation,
        S,
        distance2,
        log_det,
        apart,
        np.ones(len(pairs), np.bool_),
    )


def _near(kind: KindObservations, cloud: ParticlePoses) -> Ints:
    """Return the landmarks (k,) that any particle may have observed."""
    table, pose = kind.table, cloud.poses[cloud.best]
    rows = table.rows[cloud.best]
    ends = table.model.outline(table.m[rows], table.extents) - pose[:2]
    along = ends[:, 1] - ends[:, 0]
    length2 = np.maximum((along**2).sum(1), 1e-12)
    share = np.clip(-(ends[:, 0] * along).sum(1) / length2, 0.0, 1.0)
    distance = np.hypot(*(ends[:, 0] + share[:, None] * along).T)
    seen = float(np.hypot(kind.ends[..., 0], kind.ends[..., 1]).max())
    distance_sigma, turn_sigma = cloud.spread()
    sigma = distance_sigma + turn_sigma * seen + np.sqrt(np.trace(table.P[rows], axis1=1, axis2=2))
    return np.flatnonzero((distance < seen + MAX_GAP + MAX_SIGMAS * sigma) | (rows < 0))


def _possible(kind: KindObservations, cloud: ParticlePoses, near: Ints) -> Mask:
    """Return which pairs (a, k) the extents allow, within 2 sigma, for the likeliest particle."""
    table, model, observed = kind.table, kind.table.model, len(kind.z)
    out = np.ones((observed, len(near)), np.bool_)
    rows = table.rows[cloud.best, near]
    known = np.flatnonzero(rows >= 0)
    if not model.has_extent or not len(known):
        return out
    pose, root = cloud.poses[cloud.best], cloud.roots[cloud.best]
    a, k = (index.ravel() for index in np.meshgrid(np.arange(observed), known, indexing="ij"))
    m, P = table.m[rows[k]], table.P[rows[k]]
    overlap = model.overlap(pose, m, table.extents[near[k]], model.extents(pose, m, kind.ends[a]))
    variance = ((overlap.gap_D_pose @ root) ** 2).sum(1)
    variance += np.einsum("pi,pij,pj->p", overlap.gap_D_m, P, overlap.gap_D_m)
    out[a, k] = overlap.gap <= overlap.allowed + 2.0 * np.sqrt(np.maximum(variance, 0.0))
    return out
