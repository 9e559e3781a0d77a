"""Other places where the scans fit as well, after the position has become uncertain.

After a gap in the data, association matches a scan with the landmarks of one place, although another place
that looks the same may be within the uncertainty, such as the next door of a corridor. The covariance of
the estimate does not include the others. So they are searched for, and kept until later scans contradict
them.

They differ from the estimate by a translation: after a gap, the heading is known from odometry or from the
walls, the position is not.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from impslam.geometry.chi_square import GATE_2D
from impslam.geometry.se2 import transform
from impslam.types import Array, Ints, Landmark, Mask, Observation

MIN_SHIFT = 0.5
"""m between the estimate and another place; nearer ones are the same landmarks."""
TOLERANCE = 0.2
"""m by which landmarks may miss their places elsewhere: errors of the map over a gate of association, and
less than half of the distance between neighbours."""
MAX_ANGLE = 0.1
"""rad between parallel walls."""
MIN_KEYFRAMES = 3
"""Keyframes in a row that must fit worse elsewhere: a landmark is missed now and then."""


class AlternativePlaces:
    """Finds the places that look like that of the estimate, and rules them out by later scans."""

    def __init__(self) -> None:
        self._shifts, self._worse = np.empty((0, 2)), np.empty(0, np.int64)
        # if a search is due: covariance of the predicted position, and the correction of it so far
        self._prior: tuple[Array, Array] | None = None
        self._newest = -1  # newest landmark when the position became uncertain

    @property
    def exist(self) -> bool:
        """Whether the scans still fit at another place."""
        return len(self._shifts) > 0

    @property
    def watching(self) -> bool:
        """Whether `review` has anything to do."""
        return self.exist or self._prior is not None

    def begin(self, spread: Array, newest: int) -> None:
        """Begin after an uncertain motion; the predicted position has the covariance `spread` (2, 2), m^2.

        `newest` is the newest landmark: later ones are at the place that is chosen now.
        """
        if not self.watching:
            self._newest = newest
        self._prior = spread.copy(), np.zeros(2)

    def review(
        self,
        predicted: Array,
        pose: Array,
        observations: Sequence[Observation],
        landmarks: Sequence[Landmark],
    ) -> None:
        """Compare a scan with the landmarks at each place; it is taken from `pose` (3,).

        `predicted` (3,) is the pose before its correction. All walls have end points.
        """
        known = [mark for mark in landmarks if mark.id <= self._newest]
        self._compare(pose, observations, known)
        if self._prior is not None:
            self._prior[1][:] += pose[:2] - predicted[:2]
            self._search(*self._prior, pose, observations, known)

    def _compare(
        self, pose: Array, observations: Sequence[Observation], known: Sequence[Landmark]
    ) -> None:
        """Drop the places at which the last scans fit worse than at the estimate."""
        fits = self._fits(self._shifts, pose, observations, known)
        self._worse = np.where(fits[1:] < fits[0], self._worse + 1, 0)
        alike = self._worse < MIN_KEYFRAMES
        self._shifts, self._worse = self._shifts[alike], self._worse[alike]

    def _search(
        self,
        spread: Array,
        correction: Array,
        pose: Array,
        observations: Sequence[Observation],
        known: Sequence[Landmark],
    ) -> None:
        """Find the places within the uncertainty where at most one observation less fits a landmark.

        The search waits for a scan that determines the position along both axes.
        """
        area = Ellipse(-correction, spread)
        shifts = _candidates(pose, observations, known, area)
        distance = np.hypot(shifts[:, 0], shifts[:, 1])
        if not (distance < TOLERANCE).any():
            return
        elsewhere = shifts[area.contains(shifts) & (distance >= MIN_SHIFT)]
        fits = self._fits(elsewhere, pose, observations, known)
        alike = elsewhere[fits[1:] >= fits[0] - 1]
        self._shifts = np.concatenate((self._shifts, alike))
        self._worse = np.concatenate((self._worse, np.zeros(len(alike), np.int64)))
        self._prior = None

    @staticmethod
    def _fits(
        shifts: Array, pose: Array, observations: Sequence[Observation], known: Sequence[Landmark]
    ) -> Ints:
        """Return how many observations fit at `pose` (3,) and then at each translation (n, 2)."""
        places = np.concatenate((np.zeros((1, 2)), shifts))
        return np.asarray(_explained(places, pose, observations, known).sum(axis=1))


class Ellipse(NamedTuple):
    """The translations, m, within the gate: their mean (2,) and covariance (2, 2)."""

    mean: Array
    covariance: Array

    def contains(self, shifts: Array) -> Mask:
        """Return (n,) which translations (n, 2) are inside."""
        off = shifts - self.mean
        distance2 = np.einsum("ni,ni->n", off, np.linalg.solve(self.covariance, off.T).T)
        return np.asarray(distance2 < GATE_2D)

    def meets(self, lines: Array) -> Mask:
        """Return (n,) which lines (n, 3) meet it; see `_lines`."""
        normals, off = lines[:, :2], lines[:, 2] - lines[:, :2] @ self.mean
        return np.asarray(
            off**2 < GATE_2D * np.einsum("ni,ij,nj->n", normals, self.covariance, normals)
        )


def _candidates(
    pose: Array, observations: Sequence[Observation], known: Sequence[Landmark], area: Ellipse
) -> Array:
    """Return translations (n, 2) in m that move an observed point or two observed walls to landmarks.

    They are half of `TOLERANCE` apart. With walls, they are inside the area or near zero.
    """
    found, lines = [np.empty((0, 2))], [np.empty((0, 3))]
    for one in observations:
        same = [mark for mark in known if mark.kind == one.kind]
        if one.end_points is None:
            places = np.reshape([mark.position for mark in same], (-1, 2))
            found.append(places - transform(pose, one.z[:2]))
        elif same:
            walls = np.array([mark.end_points for mark in same])
            lines.append(_lines(transform(pose, one.end_points), walls))
    walls = np.concatenate(lines)
    found += _intersections(walls[area.meets(walls) | (np.abs(walls[:, 2]) < TOLERANCE)], area)
    shifts = np.concatenate(found)
    cells = np.round(shifts / (0.5 * TOLERANCE))
    return shifts[np.unique(cells, axis=0, return_index=True)[1]]


def _lines(ends: Array, walls: Array) -> Array:
    """Return the lines (n, 3) of the translations that move a piece (2, 2) to parallel walls (m, 2, 2).

    A line [x, y, d] has the points p with [x, y] . p = d; [x, y] is a unit vector.
    """
    normals, piece = _normals(walls), _normals(ends[None])[0]
    parallel = np.abs(normals @ piece) > np.cos(MAX_ANGLE)
    off = np.einsum("ni,ni->n", normals, walls[:, 0] - ends.mean(axis=0))
    return np.asarray(np.column_stack((normals, off))[parallel])


def _normals(walls: Array) -> Array:
    """Return the unit normals (m, 2) of walls (m, 2, 2)."""
    along, length = walls[:, 1] - walls[:, 0], np.maximum(_lengths(walls), 1e-9)
    return np.asarray(np.column_stack((-along[:, 1], along[:, 0])) / length[:, None])


def _intersections(lines: Array, area: Ellipse) -> Iterator[Array]:
    """Yield intersections (n, 2) of lines (k, 3) at 30 degrees or more, inside an area or near zero."""
    for k in range(len(lines) - 1):
        (a, b, c), (d, e, f) = lines[k], lines[k + 1 :].T
        sine = a * e - b * d
        cross = np.abs(sine) > 0.5
        points = np.stack((c * e - b * f, a * f - c * d), axis=1)[cross] / sine[cross, None]
        yield points[area.contains(points) | (np.hypot(*points.T) < TOLERANCE)]


def _explained(
    shifts: Array, pose: Array, observations: Sequence[Observation], known: Sequence[Landmark]
) -> Mask:
    """Return which observations (n, k) show a landmark from `pose` (3,) plus each translation (n, 2)."""
    out = np.zeros((len(shifts), len(observations)), np.bool_)
    reach = np.hypot(*shifts.T).max(initial=0.0) + TOLERANCE
    for i, one in enumerate(observations):
        same = [mark for mark in known if mark.kind == one.kind]
        if not same:
            continue
        if one.end_points is None:
            at = transform(pose, one.z[:2])
            places = np.array([mark.position for mark in same])
            off = (shifts + at)[:, None] - places[np.hypot(*(places - at).T) < reach]
            out[:, i] = (np.hypot(off[..., 0], off[..., 1]) < TOLERANCE).any(axis=1)
        else:
            ends = transform(pose, one.end_points)
            walls = np.array([mark.end_points for mark in same])
            sizes = _lengths(walls) + _lengths(ends[None])
            middles = walls.mean(axis=1) - ends.mean(axis=0)
            near = np.hypot(*middles.T) < reach + 0.5 * sizes
            out[:, i] = _on_walls(shifts[:, None] + ends, walls[near]).any(axis=1)
    return out


def _lengths(walls: Array) -> Array:
    """Return the lengths (m,) of walls (m, 2, 2)."""
    return np.asarray(np.hypot(*(walls[:, 1] - walls[:, 0]).T))


def _on_walls(ends: Array, walls: Array) -> Mask:
    """Return (n, m) whether pieces with ends (n, 2, 2) are on walls with ends (m, 2, 2), all in map."""
    normals = _normals(walls)
    off = ends[:, None] - walls[:, None, 0]  # (n, m, 2, 2)
    beside = np.abs(np.einsum("nmei,mi->nme", off, normals)) < TOLERANCE
    middle = off.mean(axis=2)
    along = middle[..., 0] * normals[:, 1] - middle[..., 1] * normals[:, 0]
    length = _lengths(walls)
    return np.asarray(
        beside.all(axis=2) & (np.abs(along - 0.5 * length) < 0.5 * length + TOLERANCE)
    )
