"""Determine the relative pose of two maps of the same place.

Short stretches of one map's drive are searched for in the whole other map (see
`recognition.relocalisation`). Each match determines the relative pose by itself. A single match may be
wrong, because places look alike; several that agree, from stretches without common scans, are accepted
(Mangelson et al. 2018) if few others contradict them, and if the scans around them fit the first map. The
floors of a building have equal corridors, but not equal rooms.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from typing import NamedTuple

import numpy as np

from impslam.errors import ImpError
from impslam.geometry.angles import wrap
from impslam.geometry.se2 import between, compose, motion_lengths
from impslam.map import Keyframes, Map
from impslam.recognition.beams import MAX_MISFIT
from impslam.recognition.consistency import Relation, consistent
from impslam.recognition.correlative import spread_order
from impslam.recognition.relocalisation import Query, Relocaliser, Verdict, query
from impslam.recognition.stored_views import stored_views
from impslam.types import Array, Ints

LENGTH = 3.0
"""m, of a stretch: from 2 m on, no false match occurred in recorded buildings. Short drives have shorter
stretches."""
STRETCH_PER_RADIAN = 0.5
"""m that a turn of a radian counts for in `LENGTH`: it shows as much that is new."""
MAX_STRETCHES = 60
"""With more, a large map takes minutes."""
MIN_AGREEING, ENOUGH = 3, 6
"""Stretches that have to agree, and the number after which the search ends."""
MAX_CONTRADICTING = 0.25
"""Contradicting matches per agreeing one; with more the relative pose is ambiguous."""
POSITION_SIGMA, HEADING_SIGMA = 0.1, 0.02
"""m, rad: standard deviations of a stretch's pose in the other map."""
BEND, TWIST = 0.01, 0.002
"""m/m, rad/m: standard deviations of the relative pose of two keyframes of one map by their distance; a
refined map is more accurate, but an unrefined one is bent by that much."""
MAX_LEVER = 30.0
"""m from the nearest agreeing stretch within which scans are compared with the first map: farther away,
`BEND` puts a beam's end more than 0.3 m off, where it no longer counts as near its wall."""

Progress = Callable[[float], None]
"""Called with the completed share, 0 to 1."""


class RelationStatus(Enum):
    """Whether the relative pose of two maps was determined."""

    FOUND = "found"
    AMBIGUOUS = "ambiguous"
    APART = "apart"


class SegmentMatch(NamedTuple):
    """A match of a stretch: keyframe `row` of the second map is at `pose` (3,) in the first one."""

    row: int
    pose: Array


class MapRelation(NamedTuple):
    """The relative pose of two maps.

    Attributes
    ----------
    outcome : FOUND; AMBIGUOUS if too few stretches agree, or too many contradict, or the scans around them
        do not fit; APART if no two agree
    T : (3,) pose of the second map's frame in the first one; the best guess unless FOUND
    links : the stretches that agree on it
    found, searched : numbers of matched and of searched stretches
    misfit : share of the second map's beams near the links that contradict the first one
    uncertain : number of stretches that fit at several places, or only perhaps
    """

    outcome: RelationStatus
    T: Array
    links: tuple[SegmentMatch, ...]
    found: int
    searched: int
    misfit: float = 0.0
    uncertain: int = 0

    @property
    def words(self) -> str:
        """The result in words."""
        agreement = f"{len(self.links)} of {self.searched} stretches agree on their relative pose"
        if self.outcome is RelationStatus.FOUND:
            return agreement
        if self.misfit > MAX_MISFIT:
            return (
                f"their relative pose is ambiguous: {agreement}, but {100.0 * self.misfit:.0f} % "
                "of the beams there contradict the other map, as those of another floor do"
            )
        if self.outcome is RelationStatus.AMBIGUOUS:
            others = f"{self.found} were found{self._others}"
            return f"their relative pose is ambiguous: only {agreement}, {others}"
        return f"they have no place in common ({self.searched} stretches were searched for{self._others})"

    @property
    def _others(self) -> str:
        return f", {self.uncertain} fit at several places, or uncertainly" if self.uncertain else ""


def aligned_to(first: Map, second: Map, progress: Progress = lambda _: None) -> Map:
    """Return the second map in the frame of the first.

    Raises
    ------
    ImpError
        If their relative pose cannot be determined.
    """
    found = align_maps(first.keyframes, second.keyframes, progress)
    if found.outcome is not RelationStatus.FOUND:
        raise ImpError(f"{found.words}; drive in an area that both maps contain")
    return second.moved(found.T)


def align_maps(
    first: Keyframes, second: Keyframes, progress: Progress = lambda _: None
) -> MapRelation:
    """Return the relative pose of the keyframes of two maps; those not placed are ignored."""
    if not (first.placed.all() and second.placed.all()):
        return _align_placed(first, second, progress)
    stretches = _stretches(second.poses)
    if not len(first) or not stretches:
        return MapRelation(RelationStatus.APART, np.zeros(3), (), 0, 0)
    relocaliser, views = Relocaliser(first), stored_views(second)
    scans = {
        int(rows[-1]): query([views[row] for row in rows], second.poses[rows]) for rows in stretches
    }
    links: list[SegmentMatch] = []
    found, uncertain = MapRelation(RelationStatus.APART, np.zeros(3), (), 0, 0), 0
    for k, (row, stretch) in enumerate(scans.items()):
        progress(k / len(scans))
        answer = relocaliser.find_query(stretch)
        if answer.verdict is Verdict.FOUND:
            links.append(SegmentMatch(row, answer.hypotheses[0].pose))
        uncertain += answer.verdict is Verdict.AMBIGUOUS
        found = judge(links, second.poses, k + 1)._replace(uncertain=uncertain)
        if found.outcome is RelationStatus.FOUND and len(found.links) >= ENOUGH:
            break
    return _verified(found, relocaliser, scans, second.poses)


def _verified(
    found: MapRelation, relocaliser: Relocaliser, scans: Mapping[int, Query], poses: Array
) -> MapRelation:
    """Return an alignment after a comparison of the scans of stretches, by row, with the first map."""
    if found.outcome is not RelationStatus.FOUND:
        return found
    against = compared = 0.0
    for row, stretch in scans.items():
        apart = [math.dist(poses[row, :2], poses[link.row, :2]) for link in found.links]
        if min(apart) > MAX_LEVER:
            continue
        link = found.links[int(np.argmin(apart))]
        start = compose(link.pose, between(poses[link.row], poses[row]))
        seen = relocaliser.explain(stretch, relocaliser.align(stretch, start))
        against += seen.contradicting
        compared += seen.known
    misfit = against / compared if compared else 0.0
    outcome = RelationStatus.FOUND if misfit <= MAX_MISFIT else RelationStatus.AMBIGUOUS
    return found._replace(outcome=outcome, misfit=misfit)


def _align_placed(first: Keyframes, second: Keyframes, progress: Progress) -> MapRelation:
    """Return `align_maps` of the placed keyframes."""
    rows = np.flatnonzero(second.placed)
    placed = first.take(np.flatnonzero(first.placed)), second.take(rows)
    found = align_maps(*placed, progress)
    return found._replace(
        links=tuple(SegmentMatch(int(rows[row]), pose) for row, pose in found.links)
    )


def _stretches(poses: Array) -> list[Ints]:
    """Return the keyframe rows of disjoint stretches, in an order whose every prefix is spread evenly."""
    steps = np.diff(poses, axis=0)
    steps[:, 2] = wrap(steps[:, 2])
    driven = np.cumsum(motion_lengths(steps, STRETCH_PER_RADIAN))
    distance = np.concatenate([[0.0], driven])[: len(poses)]
    total = float(distance[-1]) if len(distance) else 0.0
    length = min(LENGTH, total / ENOUGH)
    count = min(MAX_STRETCHES, math.floor(total / max(length, 1e-6))) if length > 0.0 else 0
    begins = total * np.arange(count) / max(count, 1)
    rows = [np.flatnonzero((distance >= b) & (distance < b + length)) for b in begins]
    return [rows[k] for k in spread_order(count) if len(rows[k])]


def judge(links: Sequence[SegmentMatch], poses: Array, searched: int) -> MapRelation:
    """Return the alignment from links, of keyframes at poses (k, 3) in their own map."""
    n = len(links)
    agree = np.eye(n, dtype=bool)
    for a in range(n):
        for b in range(a):
            agree[a, b] = agree[b, a] = _agree(links[a], links[b], poses)
    best = _clique(agree)
    chosen = tuple(links[k] for k in best)
    outcome = RelationStatus.APART
    if len(chosen) > 1:
        contradicting = n - len(chosen)
        is_certain = len(chosen) >= MIN_AGREEING
        is_certain &= contradicting <= MAX_CONTRADICTING * len(chosen)
        outcome = RelationStatus.FOUND if is_certain else RelationStatus.AMBIGUOUS
    T = fit([poses[link.row] for link in chosen], [link.pose for link in chosen])
    return MapRelation(outcome, T, chosen, n, searched)


def _agree(one: SegmentMatch, other: SegmentMatch, poses: Array) -> bool:
    """Return whether two links are consistent."""
    motion = between(poses[one.row], poses[other.row])
    distance = math.hypot(motion[0], motion[1])
    position, heading = 0.05 + BEND * distance, 0.01 + TWIST * distance
    bent = np.diag([2.0 * position**2, 2.0 * position**2, 2.0 * heading**2])  # of both maps
    found = np.diag([POSITION_SIGMA**2, POSITION_SIGMA**2, HEADING_SIGMA**2])
    identity = Relation(np.zeros(3), np.zeros((3, 3)))
    return consistent(
        Relation(one.pose, found), Relation(other.pose, found), identity, Relation(motion, bent)
    )


def _clique(agree: np.ndarray[tuple[int, int], np.dtype[np.bool_]]) -> list[int]:
    """Return the largest set of mutually consistent links that a greedy search finds."""
    best: list[int] = []
    for k in np.argsort(-agree.sum(axis=1), kind="stable"):
        chosen = [int(k)]
        for other in np.argsort(-(agree & agree[k]).sum(axis=1), kind="stable"):
            if other != k and agree[other, chosen].all():
                chosen.append(int(other))
        best = max(best, chosen, key=len)
    return sorted(best)


def fit(inside: Sequence[Array], outside: Sequence[Array]) -> Array:
    """Return the pose T (3,) that maps `inside` poses (3,) onto `outside` ones by least squares.

    Positions and headings are weighted by their variances. For the positions, the rotation is that of
    Umeyama 1991; each heading adds a term to the same sum of cosines.
    """
    if not len(inside):
        return np.zeros(3)
    p, q = np.array(inside), np.array(outside)
    a, b = p[:, :2] - p[:, :2].mean(axis=0), q[:, :2] - q[:, :2].mean(axis=0)
    lever = (POSITION_SIGMA / HEADING_SIGMA) ** 2
    turns = q[:, 2] - p[:, 2]
    c = float((a * b).sum() + lever * np.cos(turns).sum())
    s = float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() + lever * np.sin(turns).sum())
    T = np.array([0.0, 0.0, wrap(math.atan2(s, c))])
    T[:2] = (q[:, :2] - compose(T, p)[:, :2]).mean(axis=0)
    return T
