"""The relative pose of two maps of the same place, or that it is ambiguous.

Short ways of the one map are sought in the whole of the other (see `recognition.relocalisation`). Each that
is found tells the relation by itself. One answer may be wrong, as places look alike; several that agree, of
ways that share no scan, are believed (Mangelson et al. 2018), if few others contradict them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from enum import Enum
from typing import NamedTuple

import numpy as np

from impslam.errors import ImpError
from impslam.geometry.angles import wrap
from impslam.geometry.se2 import between, compose
from impslam.map import Keyframes, Map
from impslam.recognition.consistency import Relation, consistent
from impslam.recognition.correlative import spread_order
from impslam.recognition.relocalisation import Relocaliser, Verdict, query
from impslam.recognition.stored import stored_views
from impslam.types import Array, Ints

LENGTH = 3.0
"""m of way that is sought as one: from 2 m on, no place was told falsely in recorded buildings. The ways of
a short drive are shorter."""
TURN = 0.5
"""m of way that a radian counts for: it changes the view by about as much."""
MOST = 60
"""Ways that are sought: with more, a large map takes minutes."""
FEWEST, ENOUGH = 3, 6
"""Ways that agree before a relation is believed; and that make further ones needless."""
CONTRADICTED = 0.25
"""Of the ways found, as many may tell another relation; with more it is ambiguous."""
PLACE, HEADING = 0.1, 0.02
"""m, rad: standard deviations of a way's pose in the other map."""
BEND, TWIST = 0.01, 0.002
"""m/m, rad/m: those of two poses of one map against each other, by their distance; a settled map's shape
is surer, but an unsettled one bends by that much."""

Progress = Callable[[float], None]
"""Called with the share that is done, 0 to 1."""


class Outcome(Enum):
    """What is known of how two maps lie."""

    FOUND = "found"
    AMBIGUOUS = "ambiguous"
    APART = "apart"


class Link(NamedTuple):
    """A way that was found: keyframe `row` of the second map is at `pose` (3,) in the first one."""

    row: int
    pose: Array


class Alignment(NamedTuple):
    """How two maps lie.

    Attributes
    ----------
    outcome : FOUND; AMBIGUOUS where ways agree on it, but too few, or others on something else; APART
        where no two agree
    T : (3,) pose of the second map's frame in the first one; the best guess where it is not FOUND
    links : the ways that agree on it
    found, sought : ways that were found anywhere, and those that were sought
    """

    outcome: Outcome
    T: Array
    links: tuple[Link, ...]
    found: int
    sought: int

    @property
    def words(self) -> str:
        """What is known, in words."""
        ways = f"{len(self.links)} of {self.sought} stretches agree on their relative pose"
        if self.outcome is Outcome.FOUND:
            return ways
        if self.outcome is Outcome.AMBIGUOUS:
            return f"their relative pose is ambiguous: only {ways}, {self.found} were found"
        return f"they have no place in common ({self.sought} stretches were searched for)"


def aligned_to(first: Map, second: Map, progress: Progress = lambda _: None) -> Map:
    """Return the second map in the frame of the first.

    Raises
    ------
    ImpError
        If their relative pose is not found.
    """
    found = align_maps(first.keyframes, second.keyframes, progress)
    if found.outcome is not Outcome.FOUND:
        raise ImpError(f"{found.words}; drive where both have been")
    return second.moved(found.T)


def align_maps(
    first: Keyframes, second: Keyframes, progress: Progress = lambda _: None
) -> Alignment:
    """Return how the keyframes of a second map lie in a first one's; those not placed are left out."""
    if not (first.placed.all() and second.placed.all()):
        return _align_placed(first, second, progress)
    ways = _ways(second.poses)
    if not len(first) or not ways:
        return Alignment(Outcome.APART, np.zeros(3), (), 0, 0)
    places, views = Relocaliser(first), stored_views(second)
    links: list[Link] = []
    found = Alignment(Outcome.APART, np.zeros(3), (), 0, 0)
    for k, rows in enumerate(ways):
        progress(k / len(ways))
        answer = places.find_query(query([views[row] for row in rows], second.poses[rows]))
        if answer.verdict is Verdict.FOUND:
            links.append(Link(int(rows[-1]), answer.hypotheses[0].pose))
        found = judge(links, second.poses, k + 1)
        if found.outcome is Outcome.FOUND and len(found.links) >= ENOUGH:
            break
    return found


def _align_placed(first: Keyframes, second: Keyframes, progress: Progress) -> Alignment:
    """Return `align_maps` of those keyframes that are placed."""
    rows = np.flatnonzero(second.placed)
    placed = first.take(np.flatnonzero(first.placed)), second.take(rows)
    found = align_maps(*placed, progress)
    return found._replace(links=tuple(Link(int(rows[row]), pose) for row, pose in found.links))


def _ways(poses: Array) -> list[Ints]:
    """Return rows of keyframes of ways that share none, in an order whose beginning is spread evenly."""
    steps = np.diff(poses, axis=0)
    way = np.hypot(steps[:, 0], steps[:, 1]) + TURN * np.abs(wrap(steps[:, 2]))
    way = np.concatenate([[0.0], np.cumsum(way)])[: len(poses)]
    total = float(way[-1]) if len(way) else 0.0
    length = min(LENGTH, total / ENOUGH)
    count = min(MOST, math.floor(total / max(length, 1e-6))) if length > 0.0 else 0
    begins = total * np.arange(count) / max(count, 1)
    ways = [np.flatnonzero((way >= begin) & (way < begin + length)) for begin in begins]
    return [ways[k] for k in spread_order(count) if len(ways[k])]


def judge(links: Sequence[Link], poses: Array, sought: int) -> Alignment:
    """Return what links tell, of keyframes at poses (k, 3) in their own map."""
    n = len(links)
    agree = np.eye(n, dtype=bool)
    for a in range(n):
        for b in range(a):
            agree[a, b] = agree[b, a] = _agree(links[a], links[b], poses)
    best = _clique(agree)
    chosen = tuple(links[k] for k in best)
    outcome = Outcome.APART
    if len(chosen) > 1:
        contradicting = n - len(chosen)
        sure = len(chosen) >= FEWEST and contradicting <= CONTRADICTED * len(chosen)
        outcome = Outcome.FOUND if sure else Outcome.AMBIGUOUS
    T = fit([poses[link.row] for link in chosen], [link.pose for link in chosen])
    return Alignment(outcome, T, chosen, n, sought)


def _agree(one: Link, other: Link, poses: Array) -> bool:
    """Tell whether two links can both be true."""
    motion = between(poses[one.row], poses[other.row])
    distance = math.hypot(motion[0], motion[1])
    place, heading = 0.05 + BEND * distance, 0.01 + TWIST * distance
    bent = np.diag([2.0 * place**2, 2.0 * place**2, 2.0 * heading**2])  # both maps are
    found = np.diag([PLACE**2, PLACE**2, HEADING**2])
    still = Relation(np.zeros(3), np.zeros((3, 3)))
    return consistent(
        Relation(one.pose, found), Relation(other.pose, found), still, Relation(motion, bent)
    )


def _clique(agree: np.ndarray[tuple[int, int], np.dtype[np.bool_]]) -> list[int]:
    """Return links that all agree with each other: the most that a greedy search finds."""
    best: list[int] = []
    for k in np.argsort(-agree.sum(axis=1), kind="stable"):
        chosen = [int(k)]
        for other in np.argsort(-(agree & agree[k]).sum(axis=1), kind="stable"):
            if other != k and agree[other, chosen].all():
                chosen.append(int(other))
        best = max(best, chosen, key=len)
    return sorted(best)


def fit(inside: Sequence[Array], outside: Sequence[Array]) -> Array:
    """Return the pose T (3,) that lays poses (3,) each on the others in the least-squares sense.

    Places and headings weigh by their variances. For the places, the rotation is that of Umeyama 1991;
    a heading adds its own term to the same sum of cosines.
    """
    if not len(inside):
        return np.zeros(3)
    p, q = np.array(inside), np.array(outside)
    a, b = p[:, :2] - p[:, :2].mean(axis=0), q[:, :2] - q[:, :2].mean(axis=0)
    lever = (PLACE / HEADING) ** 2
    turns = q[:, 2] - p[:, 2]
    c = float((a * b).sum() + lever * np.cos(turns).sum())
    s = float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() + lever * np.sin(turns).sum())
    T = np.array([0.0, 0.0, wrap(math.atan2(s, c))])
    T[:2] = (q[:, :2] - compose(T, p)[:, :2]).mean(axis=0)
    return T
