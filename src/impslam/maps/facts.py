"""Statistics of a map."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from impslam.continuing import logs_of
from impslam.map import Map
from impslam.maps.direction import Direction
from impslam.maps.files import FREE, MapImage

MIN_UNIX_TIME = datetime(1990, 1, 1, tzinfo=UTC).timestamp()
"""s: earlier stamps are not Unix time, but count from a robot's start."""


@dataclass(frozen=True, slots=True)
class MapFacts:
    """Statistics of a map.

    Attributes
    ----------
    logs : names of its logs
    scans, keyframes : their numbers
    unplaced : number of keyframes that are not located in the map
    path : m, distance driven
    motions, closures : edges of the pose graph
    landmarks : number by kind
    extent : m, left, right, bottom and top of the known area
    free : m^2, free area
    first, last : s, the first and the last stamp
    age : s since the last stamp; NaN if stamps are not Unix time
    direction : main direction of the walls
    """

    logs: tuple[str, ...]
    scans: int
    keyframes: int
    unplaced: int
    path: float
    motions: int
    closures: int
    landmarks: dict[str, int]
    extent: tuple[float, float, float, float]
    free: float
    first: float
    last: float
    age: float
    direction: Direction


def facts(known: Map, image: MapImage, now: float) -> MapFacts:
    """Return the statistics of a map; `image` is its grid, `now` the Unix time, s."""
    steps = np.diff(known.path()[:, 1:3], axis=0)
    steps = steps[np.diff(known.keyframes.sessions[known.anchors[known.placed()]]) == 0]
    closures = int(np.isfinite(known.edges.kernel).sum())
    first = last = math.nan
    if len(known.stamps):
        first, last = float(known.stamps.min()), float(known.stamps.max())
    return MapFacts(
        logs=tuple(str(log.get("log", "")) for log in logs_of(known)),
        scans=len(known.stamps),
        keyframes=len(known.keyframes),
        unplaced=int((~known.keyframes.placed).sum()),
        path=float(np.hypot(steps[:, 0], steps[:, 1]).sum()),
        motions=len(known.edges.i) - closures,
        closures=closures,
        landmarks=dict(sorted(Counter(mark.kind for mark in known.landmarks).items())),
        extent=image.extent,
        free=float((image.pixels == FREE).sum()) * image.resolution**2,
        first=first,
        last=last,
        age=now - last if last > MIN_UNIX_TIME else math.nan,
        direction=known.direction(),
    )
