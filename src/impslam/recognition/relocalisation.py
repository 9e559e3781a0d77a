"""Where in a map a scan was taken, without any knowledge of where the robot is.

All of the map is searched (see `everywhere`), the places found are aligned with its surfaces, and the map
has to explain the scan's beams there (see `beams`). What remains are hypotheses with odds: that the scan
was taken at none of them is one of the possibilities, and so is that it cannot be told.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from impslam.geometry.angles import wrap
from impslam.geometry.se2 import compose, transform
from impslam.map import Keyframes
from impslam.recognition.beams import Beams, Explained, explain
from impslam.recognition.everywhere import search_everywhere
from impslam.recognition.ground import Ground, survey
from impslam.recognition.places import FINE, FINE_PRIOR
from impslam.recognition.pyramid import CELL, Bytes, pool
from impslam.recognition.stored import points_view, stored_views
from impslam.recognition.submap import View, gather
from impslam.surfaces.features import Features
from impslam.surfaces.surface_map import align, no_evidence
from impslam.types import Array, check_shape

FEWEST = 40  # points of a scan: fewer fit anywhere
REACH = 20.0  # m: points farther away are few, and move by cells with each step of heading
QUERY_CELL = 0.1  # m: one point in each
ALIGNED = 200  # points that alignment uses, about
BEAMS = 180  # of a scan: a mean score to within 0.04
SAME, SAME_TURN = 0.4, math.radians(8.0)  # m, rad: closer hypotheses are one
EVIDENCE = 30.0
"""Odds of two places are exp(EVIDENCE * difference of their scores). A scan's beams are not independent:
they share walls, people in the way and errors of the map, so that 180 of them are worth fewer."""
CHANCE_SCORE, LUCK = 0.45, 0.08
"""Score that the best place of a map may have for scans of somewhere else, and what is added for one scan,
a share of it for more of them, for chance has to repeat itself with each. Of 108 ways outside of a map of
an office, in which rooms look alike, one scored 0.57 and the next 0.44; 2 of 100 scans scored over 0.64."""
FOUND_ODDS = 0.98  # then the second place is at least 0.13 behind


class Verdict(Enum):
    """What is known of where a scan was taken."""

    FOUND = "found"
    AMBIGUOUS = "ambiguous"
    NOWHERE = "nowhere"


class Hypothesis(NamedTuple):
    """A place that may be the one.

    Attributes
    ----------
    pose : (3,) T_map_base
    score : how well the map explains the scan there, at most 1
    odds : share of the possibilities, the scan having been taken elsewhere among them
    """

    pose: Array
    score: float
    odds: float


class Answer(NamedTuple):
    """Where a scan was taken.

    Attributes
    ----------
    verdict : FOUND if the first hypothesis is it, NOWHERE if no place in the map is
    hypotheses : best first; their odds add up to at most 1
    """

    verdict: Verdict
    hypotheses: tuple[Hypothesis, ...]


class Near(NamedTuple):
    """A hint: the robot is within `radius` m of a place (2,) or pose (3,) in map, heading any way."""

    place: Array
    radius: float


class Query(NamedTuple):
    """What is sought: what views saw, in base_link of the newest one.

    Attributes
    ----------
    features : (n, 5) for alignment
    laser : (2,) m, where the lidar is
    beams : to be explained
    scans : number of the views
    """

    features: Features
    laser: Array
    beams: Beams
    scans: int


class Relocaliser:
    """Finds scans in a map; building one takes as long as drawing the map does, up to seconds.

    Attributes
    ----------
    ground : what the map tells of each place

    Examples
    --------
    A room of five walls is mapped from one place, and a scan from another one is found:

    >>> import numpy as np
    >>> import impslam
    >>> angles = np.radians(np.arange(-180.0, 180.0))
    >>> facing = np.radians([0.0, 70.0, 180.0, 250.0, 300.0])
    >>> def scan(x, y, turn):
    ...     left = [3.0, 2.0, 1.5, 2.5, 3.0] - x * np.cos(facing) - y * np.sin(facing)
    ...     c = np.cos(angles[:, None] + turn - facing)
    ...     return np.where(c > 1e-9, left / np.maximum(c, 1e-9), np.inf).min(axis=1)
    >>> slam = impslam.Slam("default")
    >>> slam.add_odometry([0.0, 1.0], [[0.0, 0.0, 0.0]] * 2)
    >>> slam.add_scans([0.0, 1.0], [scan(0.0, 0.0, 0.0)] * 2, angles)
    >>> finder = impslam.Relocaliser(slam.finish().keyframes)
    >>> ranges = scan(0.5, 0.2, 2.5)
    >>> answer = finder.locate(np.column_stack((ranges * np.cos(angles), ranges * np.sin(angles))))
    >>> answer.verdict.value, answer.hypotheses[0].pose.round(1).tolist()
    ('found', [0.5, 0.2, 2.5])
    """

    def __init__(self, keyframes: Keyframes) -> None:
        self.ground = survey(keyframes, stored_views(keyframes))

    def locate(
        self, points: ArrayLike, laser: ArrayLike = (0.0, 0.0), near: Near | None = None
    ) -> Answer:
        """Return where a scan was taken that ended at points (n, 2) m, in beam order.

        They are in base_link, in which the lidar is at `laser` (2,) m.
        """
        ends = np.asarray(points, np.float64)
        check_shape("points", ends, None, 2)
        return self.find(points_view(ends, np.asarray(laser, np.float64)), near)

    def find(self, view: View, near: Near | None = None) -> Answer:
        """Return where a scan was taken, or what can be said of it."""
        return self.find_query(query([view], np.zeros((1, 3))), near)

    def find_query(
        self, sought: Query, near: Near | None = None, followed: Sequence[Array] = ()
    ) -> Answer:
        """Return where the newest of several scans was taken.

        Poses (3,) that are `followed` are tried as well, unless a hint is given.
        """
        if len(sought.features) < FEWEST:
            return Answer(Verdict.AMBIGUOUS, ())
        room = None if near is None else _narrowed(self.ground, near)
        centred = sought.features.copy()
        centred[:, :2] -= sought.laser.astype(np.float32)
        places = search_everywhere(self.ground, centred, room)
        starts = [*_based(places.poses, sought.laser), *(followed if near is None else ())]
        return answer(self._settled(sought, starts), sought.scans, complete=places.complete)

    def _settled(self, sought: Query, starts: Sequence[Array]) -> list[tuple[Explained, Array]]:
        """Return places (3,) aligned and explained, best first; each of them once."""
        poses = [self.align(sought, start) for start in starts]
        explained = [(explain(self.ground, sought.beams, pose), pose) for pose in poses]
        explained.sort(key=lambda each: -each[0].score)
        return list(_distinct(explained))

    def align(self, sought: Query, start: Array) -> Array:
        """Return the pose (3,) near a start where the scans lie on the map's surfaces."""
        pose = np.array(start)
        how = FINE._replace(step=max(1, len(sought.features) // ALIGNED))
        align(self.ground.surfaces, sought.features, pose, FINE_PRIOR, how, no_evidence())
        return pose


def query(views: Sequence[View], poses: Array) -> Query:
    """Return what views saw whose base_link was at poses (k, 3) of one frame, the newest one last."""
    merged = gather(views, poses, poses[-1], QUERY_CELL, REACH)
    parts = [_spread_rows(view.features, BEAMS)[:, :2] - view.laser for view in views]
    starts = np.repeat(merged.vantages[:, :2], [len(part) for part in parts], axis=0)
    ends = [transform(T, part) for T, part in zip(merged.vantages, parts, strict=True)]
    return Query(merged.features, views[-1].laser, Beams(starts, np.concatenate(ends)), len(views))


def answer(explained: Sequence[tuple[Explained, Array]], scans: int, *, complete: bool) -> Answer:
    """Return hypotheses with odds and the verdict, from places of scans: distinct ones, best first."""
    if not explained:
        return Answer(Verdict.NOWHERE if complete else Verdict.AMBIGUOUS, ())
    nowhere = CHANCE_SCORE + LUCK / scans
    scores = np.array([nowhere, *(e.score for e, _ in explained)])
    weights = np.exp(EVIDENCE * (scores - scores.max()))
    odds = weights / weights.sum()
    hypotheses = tuple(
        Hypothesis(pose, e.score, float(share))
        for (e, pose), share in zip(explained, odds[1:], strict=True)
    )
    verdict = Verdict.AMBIGUOUS
    if complete and odds[1] >= FOUND_ODDS:
        verdict = Verdict.FOUND
    elif complete and odds[0] >= FOUND_ODDS:
        verdict = Verdict.NOWHERE
    return Answer(verdict, hypotheses)


def _spread_rows(rows: Features, count: int) -> Features:
    """Return at most so many rows, evenly among all."""
    count = min(count, len(rows))
    return rows[np.arange(count) * len(rows) // max(count, 1)]


def _based(lidar: Array, laser: Array) -> Array:
    """Return poses (k, 3) of base_link from those of its lidar, which is at (2,) m in it."""
    return compose(lidar, np.array([-laser[0], -laser[1], 0.0]))


def _distinct(
    explained: Iterable[tuple[Explained, Array]],
) -> Iterator[tuple[Explained, Array]]:
    """Yield the places that are not close to a better one."""
    kept: list[Array] = []
    for how, pose in explained:
        if not any(_same(pose, other) for other in kept):
            kept.append(pose)
            yield how, pose


def _same(one: Array, other: Array) -> bool:
    turn = abs(float(wrap(one[2] - other[2])))
    return math.dist(one[:2], other[:2]) <= SAME and turn <= SAME_TURN


def _narrowed(ground: Ground, near: Near) -> Bytes:
    """Return where a lidar may be, near a place."""
    rows, columns = np.indices(ground.room[0].shape, sparse=True)
    x = ground.corner[0] + (columns + 0.5) * CELL - near.place[0]
    y = ground.corner[1] + (rows + 0.5) * CELL - near.place[1]
    room = ground.room.copy()
    room[0][x * x + y * y > near.radius**2] = 0
    pool(room)
    return room
