"""The corridor of the thesis (5.2.4), driven with a seed, mapped in several ways, and judged."""

from __future__ import annotations

import functools
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from impslam.component import build
from impslam.config import load
from impslam.evaluation.landmarks import score_landmarks
from impslam.extractors.base import Extractor
from impslam.geometry.se2 import between, log
from impslam.pipeline import Pipeline
from impslam.sensors.lidar2d import Lidar2D
from impslam.simulation.robot import SimulatedRobot
from impslam.simulation.simulate import simulate
from impslam.simulation.world import World, load_world
from impslam.studies.arena_runs import Way
from impslam.studies.corridor_truth import Truth, Verdict, false_landmarks, judge
from impslam.types import (
    Array,
    Landmark,
    LaserScan,
    Message,
    TruePose,
)

WORLD = "corridor"
ROBOT = SimulatedRobot(imu=None, truth_rate=1.0)
"""The robot of the arena; nobody asks for its gyro, or the truth between scans."""
DEFAULT, HOUGH, LIKELY, RANSAC = "default", "thesis, Hough", "Hough by likelihood", "thesis, RANSAC"
_WALLS = "sensors.lidar.extractors.walls"
WAYS = {
    DEFAULT: Way("imp"),
    HOUGH: Way("thesis-lines"),
    LIKELY: Way("thesis-lines", ("association.kind=mahalanobis",)),
    RANSAC: Way("thesis-lines", (f"{_WALLS}.kind=ransac",)),
}
"""The default; the thesis's lines as in the arena; these with the default's association in place of
feet and angles, and nothing else changed; and with the thesis's other extractor."""
READINGS = {
    "gate 2.00 m": Way("thesis-lines", ("association.max_distance=2.0",)),
    "gate 0.50 m": Way("thesis-lines", ("association.max_distance=0.5",)),
    "threshold 100 px": Way("thesis-lines", (f"{_WALLS}.threshold=100",)),
    "bins of 1 degree": Way("thesis-lines", (f"{_WALLS}.angle_bin={math.radians(1.0)}",)),
}
"""Other readings of what the thesis leaves open about its lines by Hough."""
EVERY = 10
"""Of so many scans one is given to the extractors alone: a second, 0.6 m of way."""
EXTRACTORS = {
    "split and merge": {"kind": "split_merge"},
    "Hough, threshold 40 px": {"kind": "hough", "threshold": 40},
    "Hough, threshold 20 px": {"kind": "hough"},
    "RANSAC": {"kind": "ransac"},
}
"""Of the Hough transform the thesis prints the bins but no threshold, of RANSAC no parameter."""
SEES = dict(zip(WAYS, (list(EXTRACTORS)[i] for i in (0, 1, 1, 3)), strict=True))
"""The extractor of walls of each way."""


@dataclass(frozen=True, slots=True)
class Birth:
    """A landmark's entry into the map: what its observation was."""

    id: int
    kind: str
    stamp: float
    verdict: Verdict


@dataclass(frozen=True, slots=True)
class Tally:
    """Walls that an extractor saw.

    Attributes
    ----------
    scans, walls : looked at, and seen in them
    spurious : walls that are none; see `corridor_truth.is_wall`
    people : of these, the ones that rest on people
    marred : scans with a spurious wall
    """

    scans: int = 0
    walls: int = 0
    spurious: int = 0
    people: int = 0
    marred: int = 0

    def __add__(self, other: Tally) -> Tally:
        """Return both together."""
        return Tally(
            self.scans + other.scans,
            self.walls + other.walls,
            self.spurious + other.spurious,
            self.people + other.people,
            self.marred + other.marred,
        )


@dataclass(frozen=True, slots=True, eq=False)
class CorridorRun:
    """One drive, mapped in one way.

    Attributes
    ----------
    path, odometry, truth : (n, 3) poses in map at the stamps of the n scans
    landmarks : the map at the end
    births : all landmarks that were ever in the map
    false : ids of landmarks of the map at the end where nothing of their kind stands
    missing : walls and cylinders with a name that are not in it, of the kinds that it is made of
    """

    path: Array
    odometry: Array
    truth: Array
    landmarks: tuple[Landmark, ...]
    births: tuple[Birth, ...]
    false: tuple[int, ...]
    missing: tuple[str, ...]

    @property
    def way(self) -> float:
        """How far the robot drove, m."""
        return float(np.hypot(*np.diff(self.truth[:, :2], axis=0).T).sum())

    @property
    def end(self) -> float:
        """How far the estimate ends from the truth, m."""
        return float(math.dist(self.path[-1, :2], self.truth[-1, :2]))

    @property
    def wheels(self) -> float:
        """How far dead reckoning ends from the truth, m."""
        return float(math.dist(self.odometry[-1, :2], self.truth[-1, :2]))

    @property
    def errors(self) -> Array:
        """Distances (n,) to the truth, m; both begin at one pose, and nothing is aligned."""
        return np.asarray(np.hypot(*(self.path - self.truth)[:, :2].T))

    @property
    def ate(self) -> float:
        """Their root mean square, m."""
        return rms(self.path, self.truth)

    def holds(self, off: float) -> float:
        """Return how far the robot drove before the path was so far off for the first time, m."""
        lost = np.flatnonzero(self.errors > off)
        steps = np.hypot(*np.diff(self.truth[:, :2], axis=0).T)
        return float(steps[: lost[0]].sum()) if len(lost) else self.way

    @property
    def people(self) -> int:
        """How many landmarks that were ever in the map were people."""
        return sum(birth.verdict.person for birth in self.births)

    @property
    def touched(self) -> int:
        """How many had any beam on people when they entered the map."""
        return sum(birth.verdict.touched for birth in self.births)

    @property
    def false_births(self) -> int:
        """How many were nothing of their kind when they entered the map."""
        return sum(birth.verdict.false for birth in self.births)


def rms(path: Array, truth: Array) -> float:
    """Return the root mean square distance of poses (n, 3) from the true ones, m."""
    return float(np.sqrt(np.mean(((path - truth)[:, :2] ** 2).sum(axis=1))))


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """One seed: the runs by their ways, and what the extractors saw by themselves."""

    seed: int
    runs: Mapping[str, CorridorRun]
    extractors: Mapping[str, Tally]


@functools.cache
def corridor_world() -> World:
    """Return the world."""
    return load_world(WORLD)


@functools.cache
def corridor_truth() -> Truth:
    """Return what is there, for the lidar of the robot that drives."""
    assert ROBOT.lidar is not None
    return Truth(corridor_world(), ROBOT.lidar)


def drive_corridor(seed: int, ways: Sequence[str] = tuple(WAYS)) -> Drive:
    """Simulate one seed, map it in several ways, and judge the extractors by themselves."""
    messages = list(simulate(corridor_world(), ROBOT, seed))
    runs = {name: map_corridor(messages, WAYS[name], seed) for name in ways}
    return Drive(seed, runs, judge_extractors(messages, seed))


def read_otherwise(seed: int) -> dict[str, CorridorRun]:
    """Simulate one seed, and map it by the other readings of the thesis."""
    messages = list(simulate(corridor_world(), ROBOT, seed))
    return {name: map_corridor(messages, way, seed) for name, way in READINGS.items()}


def map_corridor(messages: Sequence[Message], way: Way, seed: int) -> CorridorRun:
    """Map what the robot recorded."""
    pipeline = Pipeline(load(way.preset, [f"seed={seed}", *way.settings]))
    begin = messages[0].stamp
    births: list[Birth] = []
    truth = {m.stamp: m.pose for m in messages if isinstance(m, TruePose)}
    rows = []
    for step in pipeline.play(messages):
        rows.append((step.pose, step.odometry, truth[step.stamp]))
        if step.new:
            moment = corridor_truth().moment(step.stamp - begin)
            began = [step.observations[i] for i in step.born]
            births += [
                Birth(number, seen.kind, step.stamp, judge(moment, seen))
                for number, seen in zip(step.new, began, strict=True)
            ]
    path, odometry, true = (np.array(column) for column in zip(*rows, strict=True))
    landmarks = pipeline.slam.landmarks()
    false = false_landmarks(corridor_truth(), landmarks)
    missing = _missing(landmarks, {birth.kind for birth in births})
    return CorridorRun(path, odometry, true, landmarks, tuple(births), false, missing)


def _missing(landmarks: Sequence[Landmark], kinds: Collection[str]) -> tuple[str, ...]:
    known = [mark for mark in corridor_world().landmarks() if mark.kind in kinds]
    return score_landmarks(landmarks, known).missing


def count(walls: Sequence[Verdict]) -> Tally:
    """Return the tally of one scan."""
    spurious = [wall for wall in walls if wall.false]
    people = sum(wall.person for wall in spurious)
    return Tally(1, len(walls), len(spurious), people, int(bool(spurious)))


def judge_extractors(
    messages: Sequence[Message], seed: int, every: int = EVERY
) -> dict[str, Tally]:
    """Give one of so many scans to every extractor, de-skewed with the true motion."""
    extractors: dict[str, Extractor] = {
        name: build("extractor", table) for name, table in EXTRACTORS.items()
    }
    tallies = dict.fromkeys(extractors, Tally())
    truth, rng = corridor_truth(), np.random.default_rng(seed)
    sensor = load("imp").make_robot().sensors["lidar"]
    assert isinstance(sensor, Lidar2D)
    scans = [message for message in messages if isinstance(message, LaserScan)][::every]
    for message in scans:
        time = message.stamp - messages[0].stamp
        begin, end = truth.path.at(time + np.array([0.0, truth.sweep]))
        scan = sensor.scan(message, log(between(begin, end)) / truth.sweep)
        moment = truth.moment(time)
        for name, extractor in extractors.items():
            tallies[name] += count([judge(moment, o) for o in extractor.extract(scan, rng)])
    return tallies
