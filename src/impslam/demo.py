"""How far a map lies from the truth, landmark by landmark: what `imp demo` prints.

A point's error is its distance from the truth. A wall's is the largest distance of its estimated ends
from the true wall's line, so that an error of its angle counts by how much of the wall it displaces.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from impslam.observers.base import Observer
from impslam.simulation.world import TrueLandmark
from impslam.types import Array, Landmark, StepResult, TruePose

NEAR = 0.5
"""m; an estimate farther than this from every true landmark of its kind shows none of them."""


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """A true landmark, what the map has for it (None: missed), and the error in m."""

    true: TrueLandmark
    found: Landmark | None
    error: float


def compare(truth: Sequence[TrueLandmark], found: Iterable[Landmark]) -> list[Pair]:
    """Return the nearest estimate for every true landmark, each estimate used once."""
    left = list(found)
    near = sorted(
        (error, i, j)
        for i, true in enumerate(truth)
        for j, landmark in enumerate(left)
        if (error := distance(true, landmark)) <= NEAR
    )
    pairs: dict[int, Pair] = {}
    used: set[int] = set()
    for error, i, j in near:
        if i not in pairs and j not in used:
            used.add(j)
            pairs[i] = Pair(truth[i], left[j], error)
    return [pairs.get(i, Pair(true, None, math.inf)) for i, true in enumerate(truth)]


def distance(true: TrueLandmark, landmark: Landmark) -> float:
    """Return how far an estimate is off, in m; infinite for another kind."""
    if true.kind != landmark.kind:
        return math.inf
    if true.end_points is None or landmark.end_points is None:
        return math.dist(true.position, landmark.position)
    if not _beside(true.end_points, landmark.end_points):
        return math.inf
    start, end = true.end_points
    along = (end - start) / math.dist(start, end)
    offsets = (landmark.end_points - start) @ np.array([-along[1], along[0]])
    return float(np.abs(offsets).max())


def _beside(true: Array, found: Array) -> bool:
    """Tell whether a wall's middle lies between the ends of another, or nearly so."""
    start, end = true
    length = math.dist(start, end)
    middle = float((found.mean(axis=0) - start) @ (end - start)) / length
    return -NEAR <= middle <= length + NEAR


def corners(truth: Sequence[TrueLandmark]) -> list[TrueLandmark]:
    """Return where two true walls meet, as landmarks of the kind corner."""
    walls = [wall for wall in truth if wall.end_points is not None]
    found = []
    for one, other in combinations(walls, 2):
        assert one.end_points is not None
        assert other.end_points is not None
        for place in one.end_points:
            if any(np.allclose(place, end, atol=1e-6) for end in other.end_points):
                name = f"corner of {one.name} and {other.name}"
                values = {"x": float(place[0]), "y": float(place[1])}
                found.append(TrueLandmark(name, "corner", place, values))
    return found


class EndOfRun(Observer):
    """Keeps the last pose, and the true pose at its stamp."""

    def __init__(self) -> None:
        self.pose: Array | None = None
        self.odometry: Array | None = None
        self._stamp = math.nan
        self._truth: dict[float, Array] = {}

    def truth(self, pose: TruePose) -> None:
        """Keep the true poses since the last scan."""
        self._truth[pose.stamp] = pose.pose

    def step(self, result: StepResult) -> None:
        """Move on."""
        self.pose, self.odometry, self._stamp = result.pose, result.odometry, result.stamp
        self._truth = {t: pose for t, pose in self._truth.items() if t >= result.stamp}

    @property
    def true(self) -> Array | None:
        """The true pose (3,) at the last scan's stamp, if the log tells it."""
        return self._truth.get(self._stamp)
