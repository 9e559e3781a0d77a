"""Global localisation of a scan in a map, without a prior pose.

The whole map is searched (see `global_search`), the places found are aligned with its surfaces, and each is
scored by how well the map explains the scan's beams there (see `beams`). The result is a list of hypotheses
with probabilities, which account for places outside the map, and a verdict: found, ambiguous or nowhere.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from impslam.checked_arrays import finite, numeric
from impslam.component import shorten
from impslam.errors import ConfigError, ShapeError
from impslam.geometry.angles import wrap
from impslam.geometry.se2 import compose, transform
from impslam.map import Keyframes
from impslam.recognition.beams import MAX_MISFIT, Beams, Explanation, explain
from impslam.recognition.global_search import search_everywhere
from impslam.recognition.places import FINE, FINE_PRIOR
from impslam.recognition.pyramid import CELL, Bytes, pool
from impslam.recognition.search_map import SearchMap, make_search_map
from impslam.recognition.stored_views import points_view, stored_views
from impslam.recognition.submap import View, gather
from impslam.surfaces.features import Features
from impslam.surfaces.surface_map import align, no_evidence
from impslam.types import Array, check_shape

MIN_POINTS = 40  # of a scan: fewer fit anywhere
MAX_RANGE = 20.0  # m: farther points are few, and move by cells with each step of heading
QUERY_CELL = 0.1  # m, with one point in each
ALIGN_POINTS = 200  # approximate number used for alignment
BEAMS = 180  # of a scan: standard error of the mean score 0.04
SEPARATION, HEADING_SEPARATION = 0.4, math.radians(8.0)  # m, rad: closer hypotheses are merged
EVIDENCE = 30.0
"""Odds of two places are exp(EVIDENCE * difference of their scores). This is less than the number of beams,
which are not independent: they share walls, people in view and errors of the map."""
WRONG_SCORE, CHANCE_GAIN, MIN_CHANCE = -0.5, 9.3, 0.4
"""The best place of a map scores `WRONG_SCORE` + `CHANCE_GAIN` / sqrt(n) by chance, for n independent
points: the mean score of wrong places, and what the best of many of them gains. The lower bound allows for
rooms that look alike. Of 625 single scans outside the maps of two offices, 5 scored higher by 0.13, and of
as many drives of 2 m none."""
CLEAR_LEAD = 0.41
"""The lead of the best of many wrong places over the second one is exponentially distributed, like that of
the greatest of many random values. For 795 scans and 718 drives of two offices whose best place was wrong,
its mean was 0.09. It was greater than 0.41 for 14 and 25. The two of these drives that scored more than
0.5 were in rooms that look alike, and more than `MAX_MISFIT` of their beams contradicted the map."""
FOUND_PROBABILITY = 0.98  # then the second place is at least 0.13 behind


class Verdict(Enum):
    """Whether a scan was located."""

    FOUND = "found"
    AMBIGUOUS = "ambiguous"
    NOWHERE = "nowhere"


class PlaceHypothesis(NamedTuple):
    """A possible place.

    Attributes
    ----------
    pose : (3,) T_map_base
    score : how well the map explains the scan there, at most 1
    probability : among the hypotheses and the possibility of another place
    """

    pose: Array
    score: float
    probability: float


class Answer(NamedTuple):
    """The result of a relocalisation.

    Attributes
    ----------
    verdict : FOUND if the first hypothesis is certain, NOWHERE if no place in the map fits
    hypotheses : best first; their probabilities add up to at most 1
    """

    verdict: Verdict
    hypotheses: tuple[PlaceHypothesis, ...]


class Near(NamedTuple):
    """A hint: the robot is within `radius` m of a place (2,) or pose (3,) in map, at any heading."""

    place: Array
    radius: float


class Query(NamedTuple):
    """The scans to locate, in base_link of the newest one.

    Attributes
    ----------
    features : (n, 5) for alignment
    laser : (2,) m, position of the lidar
    beams : for scoring
    scans : number of scans
    """

    features: Features
    laser: Array
    beams: Beams
    scans: int


class Relocaliser:
    """Locates scans in a map; construction takes as long as drawing the map, up to seconds.

    Attributes
    ----------
    search_map : grids and surfaces of the map

    Examples
    --------
    Map a room of five walls from one place, and locate a scan from another one:

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
        if not isinstance(keyframes, Keyframes):
            raise ConfigError(f"{shorten(keyframes)}: expected the keyframes of a Map")
        self.search_map = make_search_map(keyframes, stored_views(keyframes))

    def locate(
        self, points: ArrayLike, laser: ArrayLike = (0.0, 0.0), near: Near | None = None
    ) -> Answer:
        """Locate a scan, given the end points (n, 2) m of its beams, in beam order.

        They are in base_link, and the lidar is at `laser` (2,) m there. Leave out beams without a range.

        Raises
        ------
        ShapeError
            If an argument has another shape, or is not finite.
        ConfigError
            If the hint is no `Near`, or its radius is not positive.
        """
        ends = numeric("points", points)
        check_shape("points", ends, None, 2)
        if not np.isfinite(ends).all():
            raise ShapeError("points: some are not finite; leave out beams without a range")
        return self.find(points_view(ends, finite("laser", laser, 2)), near)

    def find(self, view: View, near: Near | None = None) -> Answer:
        """Locate a scan."""
        return self.find_query(query([view], np.zeros((1, 3))), near)

    def find_query(
        self, scans: Query, near: Near | None = None, followed: Sequence[Array] = ()
    ) -> Answer:
        """Locate the newest of several scans.

        The poses (3,) in `followed` are tried as well, unless a hint is given.
        """
        near = None if near is None else _checked(near)
        if len(scans.features) < MIN_POINTS:
            return Answer(Verdict.AMBIGUOUS, ())
        allowed = None if near is None else _allowed_near(self.search_map, near)
        centred = scans.features.copy()
        centred[:, :2] -= scans.laser.astype(np.float32)
        places = search_everywhere(self.search_map, centred, allowed)
        starts = [*_base_poses(places.poses, scans.laser), *(followed if near is None else ())]
        explained = self._evaluate(scans, starts)
        # The scans of a drive see the same walls: the points of k of them count as those of sqrt(k).
        points = len(scans.features) / math.sqrt(scans.scans)
        return answer(explained, points, complete=places.complete, whole=near is None)

    def _evaluate(self, scans: Query, starts: Sequence[Array]) -> list[tuple[Explanation, Array]]:
        """Return the distinct places (3,) after alignment with their scores, best first."""
        poses = [self.align(scans, start) for start in starts]
        explained = [(self.explain(scans, pose), pose) for pose in poses]
        explained.sort(key=lambda each: -each[0].score)
        return list(_distinct(explained))

    def explain(self, scans: Query, pose: Array) -> Explanation:
        """Return how well the map explains scans at a pose (3,)."""
        return explain(self.search_map, scans.beams, pose)

    def align(self, scans: Query, start: Array) -> Array:
        """Return the pose (3,) after alignment of scans with the map's surfaces from a start."""
        pose = np.array(start)
        how = FINE._replace(step=max(1, len(scans.features) // ALIGN_POINTS))
        align(self.search_map.surfaces, scans.features, pose, FINE_PRIOR, how, no_evidence())
        return pose


def query(views: Sequence[View], poses: Array) -> Query:
    """Return the query of views at poses (k, 3) of base_link in one frame, the newest one last."""
    merged = gather(views, poses, poses[-1], QUERY_CELL, MAX_RANGE)
    parts = [_evenly(view.features, BEAMS) for view in views]
    starts = np.repeat(merged.vantages[:, :2], [len(part) for part in parts], axis=0)
    ends = np.concatenate(
        [
            transform(T, part[:, :2] - view.laser)
            for T, part, view in zip(merged.vantages, parts, views, strict=True)
        ]
    )
    is_single = np.concatenate(parts)[:, 4] == 0.0
    return Query(merged.features, views[-1].laser, Beams(starts, ends, is_single), len(views))


def answer(
    explained: Sequence[tuple[Explanation, Array]], points: float, *, complete: bool, whole: bool
) -> Answer:
    """Return hypotheses with probabilities and the verdict, from distinct places, best first.

    Beams that end in unknown space at the best place say nothing, and are left out. The other places count
    as if the map showed as much of them as of the best one, and beams ended on walls there.

    Parameters
    ----------
    explained : explanations, and places (3,)
    points : number of independent points of the scans
    complete, whole : whether the search ended within its budget, and was one of the whole map
    """
    if not explained:
        return Answer(Verdict.NOWHERE if complete else Verdict.AMBIGUOUS, ())
    best = explained[0][0]
    others = (e.score + max(e.unknown - best.unknown, 0.0) for e, _ in explained[1:])
    sums = np.array([best.score, *(min(score, best.score) for score in others)])
    found = np.minimum(sums / max(best.known, 1e-9), 1.0)
    is_clear = whole and len(found) > 1 and found[0] - found[1:].max() > CLEAR_LEAD
    is_clear = is_clear and best.contradicting <= MAX_MISFIT * best.known
    chance = WRONG_SCORE + CHANCE_GAIN / math.sqrt(max(points * best.known, 1.0))
    scores = np.array([MIN_CHANCE if is_clear else max(chance, MIN_CHANCE), *found])
    weights = np.exp(EVIDENCE * (scores - scores.max()))
    probabilities = weights / weights.sum()
    hypotheses = tuple(
        PlaceHypothesis(pose, e.score, float(share))
        for (e, pose), share in zip(explained, probabilities[1:], strict=True)
    )
    verdict = Verdict.AMBIGUOUS
    if complete and probabilities[1] >= FOUND_PROBABILITY:
        verdict = Verdict.FOUND
    elif complete and probabilities[0] >= FOUND_PROBABILITY:
        verdict = Verdict.NOWHERE
    return Answer(verdict, hypotheses)


def _evenly(rows: Features, count: int) -> Features:
    """Return at most `count` rows, evenly spaced."""
    count = min(count, len(rows))
    return rows[np.arange(count) * len(rows) // max(count, 1)]


def _base_poses(lidar: Array, laser: Array) -> Array:
    """Return poses (k, 3) of base_link from those of the lidar, which is at laser (2,) m in it."""
    return compose(lidar, np.array([-laser[0], -laser[1], 0.0]))


def _distinct(
    explained: Iterable[tuple[Explanation, Array]],
) -> Iterator[tuple[Explanation, Array]]:
    """Yield the places that are not close to a better one."""
    kept: list[Array] = []
    for explanation, pose in explained:
        if not any(_are_close(pose, other) for other in kept):
            kept.append(pose)
            yield explanation, pose


def _are_close(one: Array, other: Array) -> bool:
    """Return whether two hypotheses (3,) count as one; see `SEPARATION`."""
    turn = abs(float(wrap(one[2] - other[2])))
    return math.dist(one[:2], other[:2]) <= SEPARATION and turn <= HEADING_SEPARATION


def _checked(near: object) -> Near:
    """Return a hint with arrays; raise an `ImpError` if it is none."""
    if not isinstance(near, Near):
        raise ConfigError(f"near = {shorten(near)}: expected Near(place, radius)")
    place, radius = numeric("near.place", near.place), numeric("near.radius", near.radius)
    check_shape("near.radius", radius)
    place = finite("near.place", place, 3 if place.shape == (3,) else 2)
    if not 0.0 < radius < math.inf:
        raise ConfigError(f"near.radius = {radius:g}: give a positive number of metres")
    return Near(place, float(radius))


def _allowed_near(search_map: SearchMap, near: Near) -> Bytes:
    """Return the allowed lidar positions near a place; see `SearchMap.allowed`."""
    rows, columns = np.indices(search_map.allowed[0].shape, sparse=True)
    x = search_map.corner[0] + (columns + 0.5) * CELL - near.place[0]
    y = search_map.corner[1] + (rows + 0.5) * CELL - near.place[1]
    allowed = search_map.allowed.copy()
    allowed[0][x * x + y * y > near.radius**2] = 0
    pool(allowed)
    return allowed
