"""Landmarks are tentative until seen often enough, and are removed when beams pass through them (2.1.3).

A tentative landmark is kept in a small filter that only dead-reckons: it is compared with later scans
with the right uncertainty, and does not affect the map before it is confirmed. It stays at its first
position, so that people do not become landmarks. The first scan is the exception: its landmarks are added
at once, because every step without a landmark turns the whole map relative to its start. They are on trial:
those that are not seen again as often and as soon as tentative ones are removed.

A confirmed landmark has a score: it rises with each match and falls when beams that should have hit the
landmark end behind it. Occlusion changes nothing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from pydantic import PrivateAttr

from impslam.association.base import Association
from impslam.component import parameter, register
from impslam.filters.base import Filter
from impslam.geometry.angles import wrap_in_kernel
from impslam.geometry.kernels import kernel
from impslam.landmarks.base import LandmarkModel
from impslam.lifecycle.base import Lifecycle
from impslam.types import Array, Increment, Ints, Mask, Match, Observation, Scan

_SAMPLES = 9  # along a wall
_NEIGHBOUR_ANGLE = 0.01  # rad from a bearing within which beams count; a little over their spacing
_HEADING_LIMIT = 0.3**2  # rad^2: beyond, the linearisation of the dead-reckoning filter is invalid


@kernel
def _check_beams(
    position: Array,
    normal: Array,
    half: float,
    directions: Array,
    points: Array,
    valid: Mask,
    margin: float,
) -> int:
    """Return -1 if all beams towards a position (2,) end behind it, +1 if some end on it, else 0."""
    bearing = math.atan2(position[1], position[0])
    seen, behind, before = 0, 0, 0
    margin_angle = half + _NEIGHBOUR_ANGLE
    for turn in (-2.0 * math.pi, 0.0, 2.0 * math.pi):
        if not directions[0] - margin_angle <= bearing + turn <= directions[-1] + margin_angle:
            continue
        low = np.searchsorted(directions, bearing + turn - half)
        high = np.searchsorted(directions, bearing + turn + half)
        for b in range(max(int(low) - 1, 0), min(int(high) + 1, len(directions))):
            if valid[b] and abs(directions[b] - bearing - turn) <= margin_angle:
                seen += 1
                offset = normal[0] * (points[b, 0] - position[0]) + normal[1] * (
                    points[b, 1] - position[1]
                )
                if offset > margin:
                    behind += 1
                elif offset < -margin:
                    before += 1
    if seen in (0, before):
        return 0
    return -1 if behind == seen else 1


@kernel
def _is_hidden(
    ends: Array, directions: Array, ranges: Array, valid: Mask, margin: float, width: float
) -> bool:
    """Return whether no beam towards a landmark can end behind it: most landmarks are in other rooms.

    A beam shorter than the distance to the landmark's nearest point ends in front of it, up to the effect
    of the beam's angle from a sample's bearing.
    """
    x, y = ends[0]
    dx, dy = ends[1, 0] - x, ends[1, 1] - y
    length2 = dx * dx + dy * dy
    s = min(max(-(x * dx + y * dy) / length2, 0.0), 1.0) if length2 > 0.0 else 0.0
    nearest = math.hypot(x + s * dx, y + s * dy)
    margin_angle = _NEIGHBOUR_ANGLE + (
        math.atan2(width, max(nearest, 1e-9)) if length2 == 0.0 else 0.0
    )
    begin = math.atan2(y, x)
    across = wrap_in_kernel(math.atan2(ends[1, 1], ends[1, 0]) - begin)
    low, high = begin + min(across, 0.0) - margin_angle, begin + max(across, 0.0) + margin_angle
    for turn in (-2.0 * math.pi, 0.0, 2.0 * math.pi):
        if directions[-1] < low + turn or directions[0] > high + turn:
            continue
        first = np.searchsorted(directions, low + turn)
        for b in range(max(int(first) - 1, 0), len(directions)):
            if directions[b] > high + turn:
                break
            if valid[b] and (ranges[b] > nearest or ranges[b] * margin_angle > margin):
                return False
    return True


@kernel
def _visibility_balance(
    ends: Array, directions: Array, points: Array, valid: Mask, margin: float, width: float
) -> float:
    """Return the balance of a landmark's samples seen through (-) and hit (+), in [-1, 1].

    ends (2, 2), points (n, 2) and directions (n,), ascending, are all in the laser frame.
    """
    out, position, normal = 0.0, np.empty(2), np.empty(2)
    direction = ends[1] - ends[0]
    length = math.hypot(direction[0], direction[1])
    samples = _SAMPLES if length > 0.0 else 1
    for j in range(samples):
        position[:] = ends[0] + (j + 0.5) / samples * direction
        distance = max(math.hypot(position[0], position[1]), 1e-9)
        # A point counts as seen through only if all beams beside it pass: one side of a convex
        # corner is always free.
        half = math.atan2(width, distance) if length == 0.0 else 0.0
        normal[:] = position / distance
        if length > 0.0:
            normal[0], normal[1] = -direction[1] / length, direction[0] / length
            if normal[0] * position[0] + normal[1] * position[1] < 0.0:
                normal *= -1.0
        out += _check_beams(position, normal, half, directions, points, valid, margin)
    return out / samples


@kernel
def _transform_into(pose: Array, points: Array, out: Array) -> None:
    """Fill out (n, 2) with points (n, 2) in the frame of a pose (3,)."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for i in range(len(points)):
        x, y = points[i, 0] - pose[0], points[i, 1] - pose[1]
        out[i, 0], out[i, 1] = c * x + s * y, c * y - s * x


@kernel
def _balances(
    beams: tuple[Array, Array, Mask],
    poses: tuple[Array, Array],
    known: tuple[Ints, Array],
    matched: Ints,
    limits: tuple[float, float],
) -> Array:
    """Return the balance of each landmark (k,) if it is negative, else 0 or more.

    `beams` are points (n, 2), directions (n,) in base_link and valid flags; `poses` are
    `T_map_base` and `T_base_laser`, (3,); `known` are the landmarks' ids (k,) and outlines; `limits` are
    margin and width, m. Landmarks beyond the end of the farthest beam, and those with an id in `matched`,
    are left out.
    """
    (points, directions, valid), (base, laser), (ids, outlines) = beams, poses, known
    out, is_matched = np.zeros(len(ids)), np.zeros(len(ids), np.bool_)
    for number in matched:
        is_matched |= ids == number
    if valid.sum() < 2:
        return out
    limit2 = 0.0
    for b in range(len(valid)):
        if valid[b]:
            limit2 = max(limit2, points[b, 0] ** 2 + points[b, 1] ** 2)
    if (directions[1:] < directions[:-1]).any():
        order = np.argsort(directions, kind="mergesort")
        points, directions, valid = points[order], directions[order], valid[order]
    in_laser, ends = np.empty((len(points), 2)), np.empty((len(outlines), 2, 2))
    _transform_into(laser, points, in_laser)
    _transform_into(base, outlines.reshape(-1, 2), ends.reshape(-1, 2))
    directions, ranges = directions - laser[2], np.hypot(in_laser[:, 0], in_laser[:, 1])
    for i in range(len(out)):
        x, y = 0.5 * (ends[i, 0, 0] + ends[i, 1, 0]), 0.5 * (ends[i, 0, 1] + ends[i, 1, 1])
        if x * x + y * y >= limit2 or is_matched[i]:
            continue
        seen = np.empty((2, 2))
        _transform_into(laser, ends[i], seen)
        if not _is_hidden(seen, directions, ranges, valid, limits[0], limits[1]):
            out[i] = _visibility_balance(seen, directions, in_laser, valid, limits[0], limits[1])
    return out


@register("tentative")
class Tentative(Lifecycle):
    """Confirms landmarks after enough sightings over enough time; removes those seen through."""

    sightings: int = parameter(4, "1", "scans that must show a landmark to confirm it", ge=1)
    persistence: float = parameter(
        0.4, "s", "time from the first to the last of them; a walker's foot rests for 0.3 s", ge=0
    )
    timeout: float = parameter(
        1.0, "s", "a tentative landmark that is not seen for this long is dropped", gt=0
    )
    margin: float = parameter(
        0.3, "m", "a beam that ends this far behind a landmark has passed through it", gt=0
    )
    width: float = parameter(
        0.1, "m", "all beams that pass a point within this distance must pass through", gt=0
    )
    max_score: float = parameter(
        15.0, "scans", "upper limit of a landmark's score: this many misses remove it", gt=0
    )
    _candidates: Filter = PrivateAttr()
    _association: Association = PrivateAttr()
    _models: Mapping[str, LandmarkModel] = PrivateAttr()
    _seen: dict[int, tuple[int, float, float]] = PrivateAttr(default_factory=dict)
    _scores: dict[int, float] = PrivateAttr(default_factory=dict)
    _trials: dict[int, tuple[int, float, float]] = PrivateAttr(default_factory=dict)
    _starts_trial: bool = PrivateAttr(default=False)
    _now: float = PrivateAttr(default=0.0)

    def start(
        self, models: Mapping[str, LandmarkModel], association: Association, tracker: Filter
    ) -> None:
        """Begin with an empty dead-reckoning filter."""
        self._models, self._association, self._candidates = models, association, tracker
        self._scores.clear()
        self._trials.clear()
        self._starts_trial = False
        self._restart()

    def move(self, increment: Increment) -> None:
        """Dead-reckon; restart once the heading is too uncertain for comparisons."""
        if not self._seen or self._candidates.covariance[2, 2] > _HEADING_LIMIT:
            self._restart()
        self._candidates.predict(increment)

    def recognise(
        self, observations: tuple[Observation, ...], motion: Increment
    ) -> tuple[Match, ...]:
        """Match observations with tentative landmarks; see `Lifecycle.recognise`."""
        if not observations or not self._seen:
            return ()
        self._candidates.predict(motion)
        matches = self._candidates.associate(observations, self._association).matches
        self._candidates.undo_predict()
        return matches

    def promote(self, observations: Sequence[Observation], stamp: float, lost: bool) -> list[int]:
        """Return the observations (indices) whose landmark has now been seen often enough."""
        self._now, self._starts_trial = stamp, lost
        if lost:
            return list(range(len(observations)))
        if not observations and not self._seen:
            return []
        choice = self._candidates.associate(tuple(observations), self._association)
        promoted, leaving = [], []
        for match in choice.matches:
            count, first, _ = self._seen[match.landmark]
            self._seen[match.landmark] = (count + 1, first, stamp)
            if count + 1 >= self.sightings and stamp - first >= self.persistence:
                promoted.append(match.observation)
                leaving.append(match.landmark)
        leaving += [i for i, (_, _, last) in self._seen.items() if stamp - last > self.timeout]
        self._remove(leaving)
        if self.sightings == 1 and self.persistence == 0.0:
            return [*promoted, *choice.new]
        for number in self._candidates.extend([observations[i] for i in choice.new], stamp):
            self._seen[number] = (1, stamp, stamp)
        return promoted

    def review(
        self, scan: Scan, pose: Array, ids: Ints, outlines: Array, matches: Sequence[Match]
    ) -> list[int]:
        """Return the ids of landmarks that failed their trial or were seen through too often."""
        matched = {match.landmark for match in matches}
        for number in matched:
            self._scores[number] = min(self._score(number) + 1.0, self.max_score)
        failed = self._update_trials(ids, matched)
        seen_through = self._seen_through(scan, pose, ids, outlines, matched)
        lost = failed + [number for number in seen_through if number not in failed]
        for number in lost:
            self._scores.pop(number, None)
            self._trials.pop(number, None)
        return lost

    def _update_trials(self, ids: Ints, matched: set[int]) -> list[int]:
        """Return the landmarks of the first scan that were not seen again in time."""
        if self._starts_trial:
            self._trials = dict.fromkeys(ids.tolist(), (1, self._now, self._now))
            self._starts_trial = False
        known = set(ids.tolist()) if self._trials else set[int]()
        self._trials = {i: trial for i, trial in self._trials.items() if i in known}
        for number in matched & self._trials.keys():
            count, first, _ = self._trials[number]
            self._trials[number] = (count + 1, first, self._now)
            if count + 1 >= self.sightings and self._now - first >= self.persistence:
                del self._trials[number]
        return [i for i, (_, _, last) in self._trials.items() if self._now - last > self.timeout]

    def _seen_through(
        self, scan: Scan, pose: Array, ids: Ints, outlines: Array, matched: set[int]
    ) -> list[int]:
        """Lower the scores of landmarks seen through; return those whose score is too low."""
        balance = _balances(
            (scan.points, scan.directions, scan.valid),
            (pose, scan.laser),
            (ids, outlines),
            np.fromiter(matched, np.int64, len(matched)),
            (self.margin, self.width),
        )
        lost = []
        for k in (balance < 0.0).nonzero()[0].tolist():
            number = int(ids[k])
            self._scores[number] = self._score(number) + float(balance[k])
            if self._scores[number] < 0.0:
                lost.append(number)
        return lost

    def _score(self, number: int) -> float:
        return self._scores.get(number, float(self.sightings))

    def _remove(self, ids: list[int]) -> None:
        self._candidates.remove(ids)
        for number in ids:
            del self._seen[number]

    def _restart(self) -> None:
        self._seen.clear()
        self._candidates.start(np.zeros(3), np.zeros((3, 3)), self._models)
