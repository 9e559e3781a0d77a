"""The observations of all keyframes as columns by kind, and their transformation to map.

A sighting is a Gaussian on two values in its own frame: the position (x, y) of a point along the map's
axes; or the offset of a line along its normal at the middle of the piece, and its direction. Errors of
poses are additive on [x, y, theta].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.types import Array, Ints, Observation


class Sightings(NamedTuple):
    """n observations of one kind, by keyframe.

    Attributes
    ----------
    keyframes : (n,) row of the keyframe, ascending
    numbers : (n,) index among the observations of all kinds and keyframes
    z, R : (n, 2) and (n, 2, 2), in base_link
    ends : (n, 2, 2) m, end points of lines in base_link; zero for points
    headings : (n,) rad, the attribute "heading" in base_link; NaN if missing
    labels : (n,) identities read by the sensor, -1 if unknown
    """

    keyframes: Ints
    numbers: Ints
    z: Array
    R: Array
    ends: Array
    headings: Array
    labels: Ints


class PlacedSightings(NamedTuple):
    """n sightings in map.

    Attributes
    ----------
    frames : (n, 4) x, y of a point or of the middle of a line's piece, m; direction of the line's
        normal or a corner's heading, rad (NaN if missing); half the piece's length, m
    relative : (n, 3) distinct entries of the covariance relative to other sightings of the same place
    whole : (n, 3) the same relative to map
    """

    frames: Array
    relative: Array
    whole: Array


_NO_ENDS = np.zeros((2, 2))


class SightingsLog:
    """Collects the observations of keyframes, one keyframe after another."""

    def __init__(self) -> None:
        self._seen: dict[str, list[tuple[int, int, Observation]]] = {}
        self._columns: dict[str, Sightings] = {}
        self.stamps: list[float] = []
        self._count = 0

    def add(self, observations: Sequence[Observation], stamp: float) -> None:
        """Add the observations of the next keyframe at its stamp, s; their beams are not kept."""
        for observation in observations:
            kept = self._seen.setdefault(observation.kind, [])
            kept.append((len(self.stamps), self._count, observation.without_beams()))
            self._count += 1
        self.stamps.append(stamp)

    def copy(self) -> SightingsLog:
        """Return a copy for reading, which later keyframes do not change; conversions are shared."""
        other = SightingsLog()
        other._seen = {kind: kept.copy() for kind, kept in self._seen.items()}
        other._columns, other.stamps, other._count = self._columns, self.stamps.copy(), self._count
        return other

    def part(self, rows: Ints) -> SightingsLog:
        """Return the log of some keyframes (r,), ascending; the numbers of observations do not change."""
        other, index = SightingsLog(), {row: r for r, row in enumerate(rows.tolist())}
        for kind, kept in self._seen.items():
            if chosen := [(index[k], number, o) for k, number, o in kept if k in index]:
                other._seen[kind] = chosen
        other.stamps, other._count = [self.stamps[row] for row in rows.tolist()], self._count
        return other

    def by_keyframe(self) -> tuple[tuple[Observation, ...], ...]:
        """Return the observations of each keyframe."""
        rows: list[list[tuple[int, Observation]]] = [[] for _ in self.stamps]
        for kept in self._seen.values():
            for keyframe, number, observation in kept:
                rows[keyframe].append((number, observation))
        return tuple(tuple(o for _, o in sorted(row, key=itemgetter(0))) for row in rows)

    def kinds(self) -> list[str]:
        """Return the kinds in the order of their first observations."""
        return list(self._seen)

    def observations(self, kind: str) -> list[Observation]:
        """Return the observations of a kind, one for each row of its columns."""
        return [observation for _, _, observation in self._seen[kind]]

    def columns(self, kind: str) -> Sightings:
        """Return the sightings of a kind; earlier conversions are reused."""
        known, count = self._columns.get(kind), len(self._seen[kind])
        begin = 0 if known is None else len(known.keyframes)
        if known is None or begin < count:
            new = _columns(self._seen[kind][begin:])
            parts = [new] if known is None else [known, new]
            known = Sightings(*map(np.concatenate, zip(*parts, strict=True)))
            self._columns[kind] = known
        return Sightings(*map(itemgetter(slice(count)), known))  # a copy may have more by now


def _columns(seen: list[tuple[int, int, Observation]]) -> Sightings:
    observations = [observation for _, _, observation in seen]
    return Sightings(
        np.array([keyframe for keyframe, _, _ in seen], np.int64),
        np.array([number for _, number, _ in seen], np.int64),
        np.array([o.z for o in observations]),
        np.array([o.R for o in observations]),
        np.array([_NO_ENDS if o.end_points is None else o.end_points for o in observations]),
        np.array([o.attributes.get("heading", math.nan) for o in observations]),
        np.array([-1 if o.label is None else o.label for o in observations], np.int64),
    )


@kernel
def _add_propagated(J: Array, P: Array, out: Array) -> None:
    """Add the distinct entries of J P J^T, J (2, d), to out (3,)."""
    for a in range(J.shape[1]):
        for b in range(J.shape[1]):
            out[0] += J[0, a] * P[a, b] * J[0, b]
            out[1] += J[0, a] * P[a, b] * J[1, b]
            out[2] += J[1, a] * P[a, b] * J[1, b]


@kernel
def _point(pose: Array, z: Array, frame: Array, by_z: Array, by_pose: Array) -> None:
    """Write the position of a point in map, and its Jacobians by z and pose."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    dx, dy = c * z[0] - s * z[1], s * z[0] + c * z[1]
    frame[0], frame[1] = pose[0] + dx, pose[1] + dy
    frame[3] = 0.0
    by_z[0, 0], by_z[0, 1], by_z[1, 0], by_z[1, 1] = c, -s, s, c
    by_pose[0, 0], by_pose[0, 1], by_pose[0, 2] = 1.0, 0.0, -dy
    by_pose[1, 0], by_pose[1, 1], by_pose[1, 2] = 0.0, 1.0, dx


@kernel
def _line(pose: Array, z: Array, ends: Array, frame: Array, by_z: Array, by_pose: Array) -> None:
    """Write the frame of a piece of a line in map, and its Jacobians by z and pose."""
    tx, ty = -math.sin(z[1]), math.cos(z[1])
    one, two = ends[0, 0] * tx + ends[0, 1] * ty, ends[1, 0] * tx + ends[1, 1] * ty
    middle = 0.5 * (one + two)
    phi = wrap_in_kernel(pose[2] + z[1])
    c, s = math.cos(phi), math.sin(phi)
    frame[0] = pose[0] + z[0] * c - middle * s
    frame[1] = pose[1] + z[0] * s + middle * c
    frame[2], frame[3] = phi, 0.5 * abs(two - one)
    by_z[0, 0], by_z[0, 1], by_z[1, 0], by_z[1, 1] = 1.0, -middle, 0.0, 1.0
    by_pose[0, 0], by_pose[0, 1], by_pose[0, 2] = c, s, -middle
    by_pose[1, 0], by_pose[1, 1], by_pose[1, 2] = 0.0, 0.0, 1.0


@kernel
def add_relief(cov: Array, length: float, relief: float) -> None:
    """Add the standard deviation `relief`, m, of a surface from its line to a line's covariance (3,)."""
    if length > 0.0:
        cov[0] += 0.5 * relief * relief
        cov[2] += 2.0 * relief * relief / (length * length)


@kernel
def transform_to_map(
    sightings: Sightings, poses: Array, covariances: Array, limits: Array, is_line: bool
) -> PlacedSightings:
    """Return sightings in map, given poses (k, 3) and covariances (k, 3, 3) of the keyframes.

    `limits` (3,) m, rad and m are the maximum standard deviations between keyframes of one place (common
    errors move them together), and that of a surface from its line.
    """
    n = len(sightings.keyframes)
    frames, relative, whole = np.empty((n, 4)), np.zeros((n, 3)), np.zeros((n, 3))
    by_z, by_pose, P_relative = np.empty((2, 2)), np.empty((2, 3)), np.zeros((3, 3))
    for i in range(n):
        k = sightings.keyframes[i]
        pose, P = poses[k], covariances[k]
        if is_line:
            _line(pose, sightings.z[i], sightings.ends[i], frames[i], by_z, by_pose)
        else:
            _point(pose, sightings.z[i], frames[i], by_z, by_pose)
            frames[i, 2] = pose[2] + sightings.headings[i]
        _add_propagated(by_z, sightings.R[i], relative[i])
        whole[i] = relative[i]
        P_relative[0, 0] = P_relative[1, 1] = min(0.5 * (P[0, 0] + P[1, 1]), limits[0] ** 2)
        P_relative[2, 2] = min(P[2, 2], limits[1] ** 2)
        _add_propagated(by_pose, P_relative, relative[i])
        add_relief(relative[i], 2.0 * frames[i, 3], limits[2])
        _add_propagated(by_pose, P, whole[i])
    return PlacedSightings(frames, relative, whole)
