"""The true and the spurious detections of extractors in simulated scans."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from operator import not_
from typing import TypeAlias

import numpy as np

from impslam.component import build
from impslam.config import load
from impslam.extractors.base import Extractor
from impslam.extractors.filtered_jump import FilteredJump
from impslam.extractors.hough import Hough
from impslam.extractors.jump import Jump, candidates, derivative
from impslam.extractors.readings import usable
from impslam.geometry.se2 import transform
from impslam.simulation.scene import distance_to_segments
from impslam.studies.chapter4_scans import SceneSnapshot
from impslam.studies.corridor_truth import MAX_WALL_TURN
from impslam.types import Array, Ints, Observation, Scan

MAX_DISTANCE = 0.15
"""m: a detection further from all true things is spurious: the radius of a cylinder."""
LONG = 1.0
"""m: a longer spurious wall joins several things: boxes and cylinders are shorter."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanDetections:
    """The true and the spurious detections of an extractor in a scan."""

    snapshot: SceneSnapshot
    true: tuple[Observation, ...]
    spurious: tuple[Observation, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Jumps:
    """Ranges, their derivative, and candidate objects of the jump extractor.

    `angles`, `ranges` (n,) rad and m, 0 without an echo; `slopes` (n - 1,) m/rad, at the angles `between`
    (n - 1,) rad; `objects` (m, 2) are the first and last beam of each object.
    """

    angles: Array
    ranges: Array
    between: Array
    slopes: Array
    objects: Ints

    @property
    def falls(self) -> Ints:
        """Indices (m,) of the slopes at which the objects begin."""
        return self.objects[:, 0] - 1

    @property
    def rises(self) -> Ints:
        """Indices (m,) of the slopes at which the objects end."""
        return self.objects[:, 1]


def jumps(scan: Scan, threshold: float) -> Jumps:
    """Return the candidates of the jump extractor (thesis 4.1.2) in a scan, before any selection."""
    ranges = np.where(usable(scan), scan.ranges, 0.0)
    slopes = derivative(scan.angles, ranges)
    objects = np.array(candidates(slopes, threshold), dtype=np.int64).reshape(-1, 2)
    middles = 0.5 * (scan.angles[:-1] + scan.angles[1:])
    return Jumps(scan.angles, ranges, middles, slopes, objects)


def extractor(preset: str, kind: str, *settings: str) -> Extractor:
    """Return an extractor ("walls", "cylinders") of a preset's lidar, with additional settings."""
    where = f"sensors.lidar.extractors.{kind}"
    config = load(preset, [f"{where}.{setting}" for setting in settings])
    made: Extractor = build("extractor", config.sensors["lidar"]["extractors"][kind])
    return made


def detect(snapshot: SceneSnapshot, extractor: Extractor, seed: int = 0) -> ScanDetections:
    """Run an extractor on a scan; its random draws depend only on the seed and the scan's number."""
    found = extractor.extract(snapshot.scan, np.random.default_rng([seed, snapshot.number]))
    true = [true_thing(snapshot, finding) >= 0 for finding in found]
    return ScanDetections(
        snapshot, tuple(compress(found, true)), tuple(compress(found, map(not_, true)))
    )


FoundByExtractor: TypeAlias = Mapping[str, list[ScanDetections]]
"""Detections in the scans of a run, by the extractor's field in `ThesisExtractors`."""


@dataclass(frozen=True, slots=True)
class ThesisExtractors:
    """The thesis's extractors with its presets' parameters.

    `low` is the plain jump extractor with the low threshold of the filtered one.
    """

    jump: Jump
    low: Jump
    filtered: FilteredJump
    ransac: Extractor
    hough: Hough

    @classmethod
    def presets(cls) -> ThesisExtractors:
        """Return the extractors of the presets `thesis-points` and `thesis-lines`."""
        jump = extractor("thesis-points", "cylinders", "kind=jump")
        filtered = extractor("thesis-points", "cylinders")
        hough = extractor("thesis-lines", "walls")
        assert isinstance(jump, Jump)
        assert isinstance(filtered, FilteredJump)
        assert isinstance(hough, Hough)
        low = jump.model_copy(update={"threshold": filtered.threshold})
        return cls(jump, low, filtered, extractor("thesis-lines", "walls", "kind=ransac"), hough)

    def detect(self, scans: list[SceneSnapshot]) -> FoundByExtractor:
        """Return the detections of each extractor in the scans."""
        return {
            name: [detect(snapshot, extractor) for snapshot in scans]
            for name, extractor in self.by_name().items()
        }

    def by_name(self) -> dict[str, Extractor]:
        """Return the extractors by the names of their fields."""
        return {name: getattr(self, name) for name in self.__slots__}


def true_thing(snapshot: SceneSnapshot, finding: Observation) -> int:
    """Return the index of the true thing that a detection is of, -1 if there is none.

    For a cylinder it is the nearest one of `scene.circles` within `MAX_DISTANCE` of its centre. For a wall
    it is the nearest one of `Snapshot.surfaces` within `MAX_DISTANCE` of the middle of its readings,
    projected to its line, and within `MAX_WALL_TURN` of its direction.
    """
    if finding.end_points is None:
        centre = transform(snapshot.pose, finding.z[None])[0]
        return _nearest(np.hypot(*(snapshot.scene.circles[:, :2] - centre).T))
    start, end = transform(snapshot.pose, finding.end_points)
    heading = math.atan2(end[1] - start[1], end[0] - start[0])
    readings = snapshot.scan.points[finding.beams] if len(finding.beams) else finding.end_points
    direction = np.array([math.cos(heading), math.sin(heading)])
    middle = (
        start + ((transform(snapshot.pose, readings).mean(axis=0) - start) @ direction) * direction
    )
    along = snapshot.surfaces[:, 2:] - snapshot.surfaces[:, :2]
    turn = np.arctan2(along[:, 1], along[:, 0]) - heading
    distances = distance_to_segments(middle, snapshot.surfaces)
    return _nearest(np.where(np.abs(np.sin(turn)) <= math.sin(MAX_WALL_TURN), distances, np.inf))


def _nearest(distances: Array) -> int:
    if len(distances) == 0 or distances.min() > MAX_DISTANCE:
        return -1
    return int(distances.argmin())


def doubles(detections: ScanDetections) -> int:
    """Return the number of true detections of things that were detected before."""
    things = [true_thing(detections.snapshot, finding) for finding in detections.true]
    return len(things) - len(set(things))


def first_or_nearest(
    found: Sequence[ScanDetections],
    rule: Callable[[ScanDetections], bool],
    nearest: Callable[[ScanDetections], float],
) -> tuple[ScanDetections, bool]:
    """Return the first element that satisfies the rule and True, else the one with maximal `nearest`."""
    for detections in found:
        if rule(detections):
            return detections, True
    return max(found, key=nearest), False


def rates(found: Iterable[ScanDetections]) -> dict[str, float]:
    """Return the number of scans, and of true, spurious and long spurious detections per scan."""
    scans = list(found)
    return {
        "scans": len(scans),
        "true_per_scan": sum(len(s.true) for s in scans) / len(scans),
        "spurious_per_scan": sum(len(s.spurious) for s in scans) / len(scans),
        "long_spurious_per_scan": sum(len(long_ones(s)) for s in scans) / len(scans),
    }


def long_ones(detections: ScanDetections) -> list[Observation]:
    """Return the spurious walls of length `LONG` or more."""
    walls = [(o, o.end_points) for o in detections.spurious]
    return [o for o, ends in walls if ends is not None and math.dist(*ends) >= LONG]


def on_people(detections: ScanDetections) -> int:
    """Return the number of spurious cylinders with a leg within `MAX_DISTANCE` of their centre."""
    legs = detections.snapshot.legs[:, :2]
    centres = [
        transform(detections.snapshot.pose, o.z[None])[0]
        for o in detections.spurious
        if o.end_points is None
    ]
    return sum(bool((np.hypot(*(legs - centre).T) <= MAX_DISTANCE).any()) for centre in centres)
